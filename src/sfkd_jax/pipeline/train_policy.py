"""Train a model and write the policy of a run."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import numpy as np

from sfkd_jax import build, policy, store
from sfkd_jax.certification import contraction_metrics
from sfkd_jax.data import (
    SCENARIOS,
    Dataset,
    first_share,
    measure_space,
    random_windows,
    spread_windows,
)
from sfkd_jax.evaluation import baselines, open_loop
from sfkd_jax.pipeline import path_law, runs
from sfkd_jax.rollout import fold
from sfkd_jax.training import fit, multi_step_loss
from sfkd_jax.types import Key, Model, Params, Space, Trajectory

STARTS = ("random", "identified")
SCORED_SCENARIOS = ("s1", "s2")
"""Of the validation drives that trainings are compared on: S3 stays unseen."""
START = 1
"""Stream folded into the run's seed; initial weights and windows use stream 0."""


def train_policy(settings: dict[str, Any], dataset: Dataset, data_hash: str) -> None:
    """Train, then write the best weights and their prediction error on the test part.

    Args:
        settings: of the run.
        dataset: all of its parts.
        data_hash: of the data set.
    """
    run_dir, options = runs.run_directory(settings), dict(settings["training"])
    recorded = runs.policy_settings(settings, dataset)
    dataset = dataset._replace(
        train=first_share(dataset.train, options.pop("data_share"))
    )
    space = measure_space(dataset)
    model = build.build_model(
        settings["model"], space, build.build_vehicle(settings["vehicle"])
    )
    horizon = options["window"]
    key = jax.random.fold_in(jax.random.key(settings["seed"]), 0)
    if model.fitting.identify is not None:
        store.print_message(f"identifying {settings['model']['system']} in {run_dir}")
        params, best = (
            model.fitting.identify(dataset.train, dataset.validation, key),
            None,
        )
    else:
        params, best = _fit(settings, options, model, space, dataset, key)
    predict = jax.jit(
        lambda params, data: open_loop(
            model, fold(model, params), data, horizon=horizon
        )
    )
    errors = predict(params, dataset.test)
    document = runs.open_loop_document(
        errors,
        dataset.test,
        settings["vehicle"]["dt"],
        _baselines(settings, dataset, horizon),
    )
    document["validation_score"] = _validation_score(
        model, params, space, dataset, horizon
    )
    store.write_json(run_dir / "open_loop.json", document)
    recorded |= {"controller": settings["controller"], "experiment": settings["name"]}
    recorded |= {"space": build.space_to_settings(space), "best_step": best}
    policy.save(
        run_dir / "policy.npz",
        params,
        recorded,
        made_from={"dataset": data_hash},
        law=path_law.ensure_law(settings),
    )


def _validation_score(
    model: Model, params: Params, space: Space, dataset: Dataset, horizon: int
) -> float:
    """Prediction loss on validation drives of S1 and S2, or on all recorded ones.

    Its weights are the defaults whatever was trained with, so that trainings with
    different weights can be compared.
    """
    held_out = dataset.validation
    if dataset.scenarios is not None:
        wanted = [SCENARIOS.index(name) for name in SCORED_SCENARIOS]
        rows = np.isin(dataset.scenarios["validation"], wanted)
        held_out = jax.tree.map(lambda leaf: leaf[rows], held_out)
    score = multi_step_loss(
        model, space, consistency=0.0, reconstruction=0.0, transport=0.0
    )
    return float(jax.jit(score)(params, spread_windows(held_out, length=horizon))[0])


def _baselines(
    settings: dict[str, Any], dataset: Dataset, horizon: int
) -> dict[str, jax.Array]:
    """Open-loop errors of naive predictors on the test part."""
    along_path = runs.is_along_path(settings)
    plant = (
        path_law.closed_loop(settings)
        if along_path
        else build.build_vehicle(settings["vehicle"])
    )
    errors = baselines(
        dataset.train,
        nominal=plant.nominal,
        dt=plant.dt,
        horizon=horizon,
        along_path=along_path,
    )
    return {name: jax.jit(error)(dataset.test) for name, error in errors.items()}


def _fit(
    settings: dict[str, Any],
    options: dict[str, Any],
    model: Model,
    space: Space,
    dataset: Dataset,
    key: Key,
) -> tuple[Params, int | None]:
    """Fit a model by gradient descent; return the best weights and their step."""
    run_dir, options = runs.run_directory(settings), dict(options)
    length, start = options.pop("window"), options.pop("start", "random")
    loss = multi_step_loss(model, space, **options.pop("loss"))
    draw = partial(random_windows, batch=options.pop("batch"), length=length)
    held_out = spread_windows(dataset.validation, length=length)
    store.print_message(
        f"training {settings['model']['system']}, {options['steps']} steps, "
        f"in {run_dir}"
    )
    options["inspect"] = partial(contraction_metrics, model)
    started = with_start(model, start, dataset.train, settings["seed"])
    return fit(started, loss, draw, dataset.train, held_out, key, run_dir, **options)


def with_start(model: Model, start: str, train: Trajectory, seed: int) -> Model:
    """Return the model with the initial weights of `training.start`.

    Args:
        model: to train.
        start: "random", or "identified" for a linear part obtained by regression.
        train: data of the regression.
        seed: of the run.

    Raises:
        ValueError: an unknown start, or one that this model does not have.
    """
    if start not in STARTS:
        raise ValueError(
            f"training.start must be one of {', '.join(STARTS)}, got {start!r}"
        )
    if start == "random":
        return model
    if model.fitting.start is None:
        raise ValueError(
            "training.start=identified needs a model=sfkd…, "
            "whose linear part can be identified"
        )
    start_from, key = (
        model.fitting.start,
        jax.random.fold_in(jax.random.key(seed), START),
    )
    return model._replace(init=lambda drawn: start_from(model.init(drawn), train, key))
