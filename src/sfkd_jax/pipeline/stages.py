"""Data set and policy of a run: loaded if they exist, made if they do not."""

from __future__ import annotations

import json
import math
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax import build, policy, store
from sfkd_jax.data import (
    SCENARIOS,
    Columns,
    Dataset,
    check_on_path,
    from_logs,
    split,
)
from sfkd_jax.pipeline import path_law, runs
from sfkd_jax.pipeline.train_policy import train_policy
from sfkd_jax.plants import check_step
from sfkd_jax.ranges import imported
from sfkd_jax.types import Trajectory

SPLIT = ("shares", "env_low", "env_high", "seed")
SWITCHING = 2
"""Stream folded into the data set's seed; simulation and split use streams 0 and 1."""


def ensure_dataset(settings: dict[str, Any]) -> tuple[Dataset, str]:
    """Return the data set and its hash; simulate or read it if it is missing."""
    path = runs.dataset_path(settings)
    if not store.exists(path):
        with store.locked(path.parent, wait=True):  # other runs share the data set
            if not store.exists(path):
                make = _read_logs if runs.is_logged(settings) else _simulate
                runs.write_dataset(settings, make(settings))
    return runs.read_dataset(settings)


def _simulate(settings: dict[str, Any]) -> Dataset:
    """Simulate a data set with the vehicle of the settings.

    Raises:
        ValueError: the vehicle has no step, or one that does not return a state.
    """
    check_step(build.build_vehicle(settings["vehicle"]))
    options = settings["dataset"]
    drive_key, split_key = jax.random.split(jax.random.key(options["seed"]))
    generate = path_law.generator(settings, build.as_kwargs(options, *SPLIT, "law"))
    store.print_message(f"generating {options['segments']} segments")
    trajectories = jax.jit(generate)(drive_key)
    if runs.is_along_path(settings):
        check_on_path(trajectories)
    low, high = jnp.asarray(options["env_low"]), jnp.asarray(options["env_high"])
    return split(
        trajectories,
        split_key,
        shares=tuple(options["shares"]),
        env_low=low,
        env_high=high,
        scenarios=jnp.asarray(path_law.generated_scenarios(settings)),
    )


def _read_logs(settings: dict[str, Any]) -> Dataset:
    """Read a data set from logs, and write what it covers beside it.

    Raises:
        ValueError: the columns do not match the state of the vehicle.
    """
    options, plant = settings["dataset"], build.build_vehicle(settings["vehicle"])
    columns = Columns(**build.as_kwargs(options["columns"]))
    if len(columns.state) != len(plant.state_names):
        raise ValueError(
            f"dataset.columns.state names {len(columns.state)} columns, "
            f"vehicle {plant.name} has {', '.join(plant.state_names)}; "
            "name as many, in this order"
        )
    store.print_message(f"reading {options['path']}")
    logged = from_logs(
        options["path"],
        columns,
        report=store.print_message,
        dt=plant.dt,
        wheelbase=plant.wheelbase,
        needs_environment=runs.has_environment(settings),
        limits=(plant.control_low or None, plant.control_high or None),
        **build.as_kwargs(options, "path", "columns"),
    )
    store.write_json(
        runs.dataset_path(settings).with_name("coverage.json"), logged.coverage
    )
    return logged.dataset


def _check_calibration_size(settings: dict[str, Any]) -> None:
    """Check before training that the calibration part supports the levels.

    Raises:
        ValueError: naming the settings, and the largest levels that are possible.
    """
    count = ensure_dataset(settings)[0].calibration.controls.shape[0]
    levels = {
        name: settings["certification"][name] for name in ("level", "monitor_level")
    }
    too_high = [
        name for name, level in levels.items() if math.ceil((count + 1) * level) > count
    ]
    if too_high:
        given = " ".join(f"certification.{name}={levels[name]:g}" for name in too_high)
        highest = math.floor(100 * count / (count + 1)) / 100
        possible = " ".join(f"certification.{name}={highest:g}" for name in too_high)
        raise ValueError(
            f"{count} calibration segments are too few for {given}: "
            f"record more, or pass {possible}"
        )


def held_out_parts(settings: dict[str, Any], dataset: Dataset) -> dict[str, Trajectory]:
    """Return the trajectories on which coverage is measured, by name.

    These are the test part, its segments of each scenario, and as many drives of S3,
    which training never uses. Logged drives have no scenario: of them it is the test
    part only.

    Args:
        settings: of the run.
        dataset: of the run.
    """
    if dataset.scenarios is None:
        return {"test": dataset.test}
    labels = dataset.scenarios["test"]
    options = {name: settings[name] for name in ("vehicle", "dataset", "root")}
    options |= {"segments": dataset.test.controls.shape[0]}
    parts = {"test": dataset.test, "s3": _switching(json.dumps(options))}
    for code, name in enumerate(SCENARIOS):
        if (chosen := labels == code).any():
            parts[name] = jax.tree.map(
                lambda leaf, chosen=chosen: leaf[chosen], dataset.test
            )
    return parts


@lru_cache(maxsize=4)
def _switching(options: str) -> Trajectory:
    """Simulate drives under S3; cached by settings as JSON for rows of a comparison."""
    settings = json.loads(options)
    data = settings["dataset"] | {"segments": settings["segments"]}
    kwargs = build.as_kwargs(data, *SPLIT, "law", "fixed_levels")
    generate = jax.jit(path_law.generator(settings, kwargs, switching=True))
    return generate(jax.random.fold_in(jax.random.key(data["seed"]), SWITCHING))


def ensure_policy(settings: dict[str, Any]) -> policy.TrainedModel:
    """Return the policy of the run; train it, or continue training, if it is missing.

    Raises:
        ArtefactError: the run was made with other settings, is damaged, or is being
            trained by another process.
        ValueError: the logs are too few for the levels of the certificate.
    """
    run_dir = runs.run_directory(settings)
    if factory := settings["model"].get("factory"):
        imported(factory, "model.factory")
    if not store.exists(run_dir / "policy.npz"):
        if runs.is_logged(settings):
            _check_calibration_size(settings)
        with store.locked(run_dir):
            runs.claim(settings)
            if not store.exists(run_dir / "policy.npz"):
                train_policy(settings, *ensure_dataset(settings))
    runs.claim(settings)
    return policy.restore(run_dir)
