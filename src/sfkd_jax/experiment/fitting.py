"""Fit the model of a run; write its weights, and their errors on the test part."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sfkd_jax import policy, store
from sfkd_jax.data import Dataset, measure_space, random_windows, spread_windows
from sfkd_jax.driving.drives import SCENARIOS
from sfkd_jax.evaluation import open_loop
from sfkd_jax.experiment import identified
from sfkd_jax.experiment.loggers import logger
from sfkd_jax.experiment.options import TrainingSettings
from sfkd_jax.experiment.source import DataSource
from sfkd_jax.models import physics
from sfkd_jax.ranges import in_words
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.settings import arguments
from sfkd_jax.training import Loss, descend, fit, multi_step_loss, planning_loss
from sfkd_jax.types import Frame, Key, Model, Params, Space, Trajectory

SCORED_SCENARIOS = ("uniform", "wet")
"""Scenarios of the validation runs that trainings are compared on: S3 stays unseen."""
PLANNING_BATCH = 256
"""Single time steps in a batch, when the residual g of planners is trained."""
PLANNING_RATE = 0.01
"""Learning rate of g."""
PLANNING_STEPS = 2
"""Optimiser steps of g for each of those of the model."""


def train_policy(
    directory: Path,
    recorded: dict[str, Any],
    source: DataSource,
    training: TrainingSettings,
    *,
    system: str,
    seed: int,
) -> None:
    """Train, then write the best weights and their errors on the test part.

    Args:
        directory: of the run.
        recorded: the settings to store with the policy, as plain values.
        source: of the data that it is trained on.
        training: how it is trained.
        system: name of the model in messages.
        seed: of the initial weights and of the training windows.
    """
    dataset = source.dataset
    space = measure_space(dataset)
    recorded["space"] = space._asdict()
    # The same model as that of `restore`, for which everything is then compiled.
    plant, model = policy.built(recorded)
    environment = source.environment
    if environment.is_known and not source.logs:
        labels = [entry.label for entry in plant.environment]
        names = environment.names or labels
        box = in_words(names, dataset.env_low, dataset.env_high)
        store.print_message(f"the model reads e: {box}")
    key = jax.random.fold_in(jax.random.key(seed), 0)
    loss = multi_step_loss(model, space, **arguments(training.loss, multi_step_loss))
    message = f"training {system}, {training.steps} steps, in {directory}"
    if model.fitting.identify is not None:
        message = f"identifying {system} in {directory}"
    store.print_message(message)
    params, best_step = _fit_model(directory, training, model, loss, dataset, key)
    recorded["best_step"] = best_step
    if model.planning is not None:
        planning_key = jax.random.fold_in(key, 1)
        residual = fit_planning(
            model,
            params,
            space,
            dataset.train,
            planning_key,
            steps=training.steps,
            size=training.loss.size,
        )
        params = {**params, "planning": residual}
    document = _open_loop_document(source, model, params, horizon=training.window)
    document["validation_score"] = _validation_score(training, loss, params, dataset)
    store.write_json(directory / "open_loop.json", document)
    policy.save(
        policy.policy_file(directory),
        params,
        recorded,
        made_from={"dataset": source.dataset_sha256},
        law=source.law,
    )


def _fit_model(
    directory: Path,
    training: TrainingSettings,
    model: Model,
    loss: Loss,
    dataset: Dataset,
    key: Key,
) -> tuple[Params, int | None]:
    """Return the weights of a model, and the optimiser step that they are from.

    A model that is identified by regression has no such step.
    """
    if model.fitting.identify is not None:
        params = model.fitting.identify(dataset.train, dataset.validation, key)
        return params, None
    with logger(training.logger, directory, store.plain(training)) as callback:
        return fit(
            model,
            loss,
            partial(random_windows, batch=training.batch, length=training.window),
            dataset.train,
            _validation_windows(training, dataset),
            key,
            directory,
            callback=callback,
            **arguments(training, fit),
        )


def fit_planning(
    model: Model,
    params: Params,
    space: Space,
    data: Trajectory,
    key: Key,
    *,
    steps: int,
    size: float = 1.0,
) -> Params:
    """Return the weights of the residual g that planners add to the model's steps.

    Args:
        model: with a residual for planners.
        params: of the model.
        space: its scales.
        data: the training trajectories.
        key: for the batches; consumed.
        steps: optimiser steps of the model itself.
        size: of the system, see `training.multi_step_loss`.
    """
    store.print_message("training what planners add to its steps")
    return descend(
        params["planning"],
        planning_loss(model, params, space, size),
        partial(random_windows, batch=PLANNING_BATCH, length=1),
        data,
        key,
        steps=PLANNING_STEPS * steps,
        learning_rate=PLANNING_RATE,
    )


def _validation_windows(training: TrainingSettings, dataset: Dataset) -> Trajectory:
    """Return the windows of the validation part on which losses are compared."""
    # Fixed windows: validation losses at different steps are comparable.
    return spread_windows(dataset.validation, length=training.window)


def _validation_score(
    training: TrainingSettings, loss: Loss, params: Params, dataset: Dataset
) -> float:
    """Return the mean validation loss over `SCORED_SCENARIOS`, for a search."""
    windows = _validation_windows(training, dataset)
    _, _, scores = loss.validate(params, windows)
    scores = np.asarray(scores)
    if dataset.scenarios is not None:
        codes = [SCENARIOS.index(name) for name in SCORED_SCENARIOS]
        scored_runs = np.isin(dataset.scenarios["validation"], codes)
        # Several windows of every run, of one position in all runs after another.
        scores = scores.reshape(-1, scored_runs.size)[:, scored_runs]
    return float(scores.mean())


def _open_loop_document(
    source: DataSource, model: Model, params: Params, *, horizon: int
) -> dict[str, Any]:
    """Return the content of open_loop.json: errors by steps ahead, beside baselines."""
    dataset = source.dataset
    is_along_path = source.along_path is not None
    plant = source.loop if is_along_path else source.plant
    steps = {"kinematic_bicycle": plant.nominal}
    # Controls along a path are perturbations of a law, which is not linear.
    if not is_along_path:
        steps["least_squares"] = identified.least_squares(dataset)
    baselines = {name: physics(step, frame=model.frame) for name, step in steps.items()}

    @jax.jit
    def errors(params: Params, test: Trajectory) -> tuple[jax.Array, dict[str, Any]]:
        of_model = open_loop(model, params, test, horizon=horizon)
        of_baselines = {
            name: open_loop(baseline, {}, test, horizon=horizon)
            for name, baseline in baselines.items()
        }
        return of_model, of_baselines

    of_model, of_baselines = errors(fold(model, params, on_host), dataset.test)
    one_step = np.asarray(of_model, np.float64)[0]
    return {
        "steps": list(range(1, horizon + 1)),
        "dt": plant.dt,
        "trajectories": dataset.test.controls.shape[0],
        **_error_columns(model.frame, of_model),
        "one_step_rmse": one_step.tolist(),
        "baselines": {
            name: _error_columns(model.frame, errors)
            for name, errors in of_baselines.items()
        },
    }


def _error_columns(frame: Frame, errors: jax.Array) -> dict[str, list[float]]:
    """Return errors by coordinate as lists over the steps ahead.

    Args:
        frame: of the model.
        errors: of `open_loop`.
    """
    columns = np.asarray(errors, dtype=np.float64)
    if not frame.has_pose:
        # A model in path coordinates does not predict the position along the path.
        columns = np.pad(columns, ((0, 0), (1, 0)))
    longitudinal, lateral, yaw, speed, *_ = columns.T
    return {
        "position_rmse_m": np.hypot(longitudinal, lateral).tolist(),
        "longitudinal_rmse_m": longitudinal.tolist(),
        "lateral_rmse_m": lateral.tolist(),
        "yaw_rmse_rad": yaw.tolist(),
        "speed_rmse_m_per_s": speed.tolist(),
    }
