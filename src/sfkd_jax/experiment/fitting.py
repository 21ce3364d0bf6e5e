"""Fit the model of a run; write its weights, and their errors on the test part."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np

from sfkd_jax import build, policy, store
from sfkd_jax.data import (
    SCENARIOS,
    Dataset,
    measure_space,
    random_windows,
    spread_windows,
)
from sfkd_jax.evaluation import open_loop
from sfkd_jax.experiment import identified, laws, runs
from sfkd_jax.experiment.options import Settings
from sfkd_jax.models import physics
from sfkd_jax.ranges import in_words
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.settings import arguments
from sfkd_jax.training import Loss, descend, fit, multi_step_loss, planning_loss
from sfkd_jax.types import Key, Model, Params, Space, Trajectory

SCORED_SCENARIOS = ("uniform", "wet")
"""Scenarios of the validation runs that trainings are compared on: S3 stays unseen."""
PLANNING_BATCH = 256
"""Single time steps in a batch, when the residual g of planners is trained."""
PLANNING_RATE = 0.01
"""Learning rate of g."""
PLANNING_STEPS = 2
"""Optimiser steps of g for each of those of the model."""


def train_policy(settings: Settings, dataset: Dataset, data_hash: str) -> None:
    """Train, then write the best weights and their errors on the test part."""
    recorded = runs.policy_settings(settings, dataset)
    space = measure_space(dataset)
    recorded["space"] = space._asdict()
    # The same model as that of `restore`, for which everything is then compiled.
    plant, model = policy.built(recorded)
    if settings.environment.is_known and not settings.logs:
        labels = [entry.label for entry in plant.environment]
        names = settings.environment.names or labels
        box = in_words(names, dataset.env_low, dataset.env_high)
        store.print_message(f"the model reads e: {box}")
    key = jax.random.fold_in(jax.random.key(settings.seed), 0)
    loss = multi_step_loss(
        model, space, **arguments(settings.training.loss, multi_step_loss)
    )
    params, best_step = _fit_model(settings, model, loss, dataset, key)
    recorded["best_step"] = best_step
    if model.planning is not None:
        planning_key = jax.random.fold_in(key, 1)
        residual = _fit_planning(settings, model, params, space, dataset, planning_key)
        params = {**params, "planning": residual}
    document = _open_loop_document(settings, model, params, dataset)
    document["validation_score"] = _validation_score(settings, loss, params, dataset)
    store.write_json(settings.run_dir / "open_loop.json", document)
    policy.save(
        settings.policy_path,
        params,
        recorded,
        made_from={"dataset": data_hash},
        law=laws.ensure_law(settings),
    )


def _fit_model(
    settings: Settings, model: Model, loss: Loss, dataset: Dataset, key: Key
) -> tuple[Params, int | None]:
    """Return the weights of a model, and the optimiser step that they are from.

    A model that is identified by regression has no such step.
    """
    run_dir = settings.run_dir
    system = settings.model.system
    if model.fitting.identify is not None:
        store.print_message(f"identifying {system} in {run_dir}")
        params = model.fitting.identify(dataset.train, dataset.validation, key)
        return params, None
    options = settings.training
    store.print_message(f"training {system}, {options.steps} steps, in {run_dir}")
    return fit(
        model,
        loss,
        partial(random_windows, batch=options.batch, length=options.window),
        dataset.train,
        _validation_windows(settings, dataset),
        key,
        run_dir,
        **arguments(options, fit),
    )


def _fit_planning(
    settings: Settings,
    model: Model,
    params: Params,
    space: Space,
    dataset: Dataset,
    key: Key,
) -> Params:
    """Return the weights of the residual g that planners add to the model's steps."""
    store.print_message("training what planners add to its steps")
    return descend(
        params["planning"],
        planning_loss(model, params, space),
        partial(random_windows, batch=PLANNING_BATCH, length=1),
        dataset.train,
        key,
        steps=PLANNING_STEPS * settings.training.steps,
        learning_rate=PLANNING_RATE,
    )


def _validation_windows(settings: Settings, dataset: Dataset) -> Trajectory:
    """Return the windows of the validation part on which losses are compared."""
    # Fixed windows: validation losses at different steps are comparable.
    return spread_windows(dataset.validation, length=settings.training.window)


def _validation_score(
    settings: Settings, loss: Loss, params: Params, dataset: Dataset
) -> float:
    """Return the mean validation loss over `SCORED_SCENARIOS`, for a search."""
    windows = _validation_windows(settings, dataset)
    _, _, scores = loss.validate(params, windows)
    scores = np.asarray(scores)
    if dataset.scenarios is not None:
        codes = [SCENARIOS.index(name) for name in SCORED_SCENARIOS]
        scored_runs = np.isin(dataset.scenarios["validation"], codes)
        # Several windows of every run, of one position in all runs after another.
        scores = scores.reshape(-1, scored_runs.size)[:, scored_runs]
    return float(scores.mean())


def _open_loop_document(
    settings: Settings, model: Model, params: Params, dataset: Dataset
) -> dict[str, Any]:
    """Return the content of open_loop.json: errors by steps ahead, beside baselines."""
    horizon = settings.training.window
    is_along_path = settings.along_path is not None
    plant = build.build_vehicle(settings.vehicle)
    if is_along_path:
        plant = laws.closed_loop(settings)
    steps = {"kinematic_bicycle": plant.nominal}
    # Controls along a path are perturbations of a law, which is not linear.
    if not is_along_path:
        steps["least_squares"] = identified.least_squares(dataset)
    baselines = {
        name: physics(step, along_path=is_along_path) for name, step in steps.items()
    }

    @jax.jit
    def errors(params: Params, test: Trajectory) -> tuple[jax.Array, dict[str, Any]]:
        of_model = open_loop(model, params, test, horizon=horizon)
        of_baselines = {
            name: open_loop(baseline, {}, test, horizon=horizon)
            for name, baseline in baselines.items()
        }
        return of_model, of_baselines

    of_model, of_baselines = errors(fold(model, params, on_host), dataset.test)
    # Of ξ, as `control.Adaptation.model_error` takes them, or of all states.
    first_coordinate = 1 if is_along_path else 0
    one_step = np.asarray(of_model, np.float64)[0, first_coordinate:]
    return {
        "steps": list(range(1, horizon + 1)),
        "dt": plant.dt,
        "trajectories": dataset.test.controls.shape[0],
        **_error_columns(of_model),
        "one_step_rmse": one_step.tolist(),
        "baselines": {
            name: _error_columns(errors) for name, errors in of_baselines.items()
        },
    }


def _error_columns(errors: jax.Array) -> dict[str, list[float]]:
    """Return errors by coordinate as lists over the steps ahead.

    Args:
        errors: RMS errors along, across, of yaw and of the body state, (step, state).
    """
    longitudinal, lateral, yaw, speed, *_ = np.asarray(errors, dtype=np.float64).T
    return {
        "position_rmse_m": np.hypot(longitudinal, lateral).tolist(),
        "longitudinal_rmse_m": longitudinal.tolist(),
        "lateral_rmse_m": lateral.tolist(),
        "yaw_rmse_rad": yaw.tolist(),
        "speed_rmse_m_per_s": speed.tolist(),
    }
