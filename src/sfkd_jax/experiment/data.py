"""The data set of a run: loaded if it exists, simulated or read if it does not."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, store
from sfkd_jax.data import (
    PARTS,
    SCENARIOS,
    Dataset,
    check_on_path,
    environment_box,
    generate,
    generate_along_path,
    segment_scenarios,
    split,
)
from sfkd_jax.experiment import identified
from sfkd_jax.experiment.dataset_files import dataset_config, dataset_path
from sfkd_jax.experiment.laws import closed_loop, without_faults
from sfkd_jax.experiment.options import LogSettings, Settings
from sfkd_jax.plants import check_step
from sfkd_jax.settings import arguments
from sfkd_jax.types import Key, Trajectory

DATASET = "dataset"
"""The kind of the file of a data set."""
SWITCHING_STREAM = 2
"""The stream of runs of S3, folded into the data set's seed. Simulation and split use 0
and 1, laws use 3 and 4.
"""


def ensure_dataset(settings: Settings) -> tuple[Dataset, str]:
    """Return the data set and its hash; simulate or read it if it is missing."""
    path = dataset_path(settings)
    if not path.is_file():
        with store.locked(path.parent, wait=True):  # other runs share the data set
            # Another run may have made it while this one waited for the lock.
            if not path.is_file():
                if logs := settings.logs:
                    dataset = _read_logs(settings, logs)
                else:
                    dataset = _simulate(settings)
                write(settings, dataset)
    # Read back even if it is new: every run trains on what is stored.
    return read(settings)


def _simulate(settings: Settings) -> Dataset:
    """Simulate a data set with the vehicle of the settings."""
    environments = len(settings.environment.low or (0, 0))
    check_step(build.build_vehicle(settings.vehicle), environments)
    options: Any = settings.dataset
    # Two keys: other shares of the split leave the trajectories as they are.
    drive_key, split_key = jax.random.split(jax.random.key(options.seed))
    store.print_message(f"generating {options.segments} segments")
    trajectories = jax.jit(_generator(settings))(drive_key)
    is_along_path = settings.along_path is not None
    labels = segment_scenarios(options.segments, along_path=is_along_path)
    trajectories, labels = without_faults(settings, trajectories, labels)
    if is_along_path:
        check_on_path(trajectories)
    return split(
        trajectories,
        split_key,
        shares=options.shares,
        scenarios=jnp.asarray(labels),
        **settings.environment.box,
    )


def _generator(
    settings: Settings, *, switching: bool = False, **changes: int
) -> Callable[[Key], Trajectory]:
    """Return key -> the runs of a data set.

    Args:
        settings: of the run.
        switching: whether the runs are under the switching of S3, which training never
            uses.
        changes: other arguments of the generator, in place of those of the settings.
    """
    changes = {**changes, "held_out": switching}
    box = settings.environment.box
    if settings.along_path:
        options = {**settings.along_path.options, **changes, **box}
        return partial(generate_along_path, closed_loop(settings), **options)
    plant = build.build_vehicle(settings.vehicle)
    options = {**arguments(settings.dataset, generate), **changes, **box}
    return partial(generate, plant, build.build_driver(plant), **options)


def _read_logs(settings: Settings, logs: LogSettings) -> Dataset:
    """Read a data set from logs, and write what it covers beside it."""
    logged = identified.read(settings.vehicle, settings.environment, logs)
    store.write_json(dataset_path(settings).with_name("coverage.json"), logged.coverage)
    return logged.dataset


def write(settings: Settings, dataset: Dataset) -> None:
    """Write the four parts of a data set."""
    arrays: dict[str, Any] = {
        f"{part}/{name}": leaf
        for part in PARTS
        for name, leaf in getattr(dataset, part)._asdict().items()
    }
    if dataset.runs is not None:
        arrays["runs"] = [dataset.runs[part] for part in PARTS]
    if dataset.scenarios is not None:
        for part in PARTS:
            arrays[f"{part}/scenario"] = dataset.scenarios[part]
    config = dataset_config(settings)
    store.write_arrays(dataset_path(settings), arrays, kind=DATASET, config=config)


def read(settings: Settings) -> tuple[Dataset, str]:
    """Return a data set and its hash."""
    path = dataset_path(settings)
    config = dataset_config(settings)
    arrays, manifest = store.read_arrays(path, kind=DATASET, config=config)

    def of_all_parts(name: str) -> list[jax.Array]:
        return jax.device_put([arrays[f"{part}/{name}"] for part in PARTS])

    scenarios = None
    with store.as_artefact_error(path):
        fields = map(of_all_parts, Trajectory._fields)
        parts = [Trajectory(*leaves) for leaves in zip(*fields, strict=True)]
        if settings.logs is None:
            scenarios = dict(zip(PARTS, of_all_parts("scenario"), strict=True))
    # Over all parts: E does not depend on how they were split.
    envs = np.concatenate([np.asarray(part.envs) for part in parts])
    env_low, env_high = _environment_box(settings, envs)
    runs = None
    counts = arrays.get("runs")
    if counts is not None:
        runs = dict(zip(PARTS, map(int, counts), strict=True))
    dataset = Dataset(
        *parts, env_low=env_low, env_high=env_high, runs=runs, scenarios=scenarios
    )
    return dataset, manifest["sha256"]


def _environment_box(settings: Settings, envs: np.ndarray) -> tuple[Any, Any]:
    """Return the lower and the upper corner of E for the environments of a data set."""
    if settings.logs is not None and not settings.environment.is_known:
        return environment_box(envs, None, None, known=False)
    environment = settings.environment
    return environment_box(envs, environment.low, environment.high, known=True)


def held_out_parts(settings: Settings, dataset: Dataset) -> dict[str, Trajectory]:
    """Return the trajectories on which coverage is measured, by name.

    These are the test part, its segments of each scenario, and as many runs of S3,
    which training never uses. Of logged runs, without scenarios, it is the test part.
    """
    parts = {"test": dataset.test}
    if dataset.scenarios is None:
        return parts
    parts["s3"] = _switching_runs(settings, dataset.test.controls.shape[0])
    for code, name in enumerate(SCENARIOS):
        chosen = dataset.scenarios["test"] == code
        if chosen.any():
            parts[name] = jax.tree.map(
                lambda leaf, chosen=chosen: leaf[chosen], dataset.test
            )
    return parts


def _switching_runs(settings: Settings, count: int) -> Trajectory:
    """Return so many runs under the switching of S3; they are simulated once."""
    key = (dataset_path(settings), count)
    if key not in _SWITCHING:
        simulate = jax.jit(_generator(settings, switching=True, segments=count))
        seed = jax.random.key(settings.dataset.seed)
        # A stream of its own: S3 must not repeat what the training data drew.
        runs = simulate(jax.random.fold_in(seed, SWITCHING_STREAM))
        (_SWITCHING[key],) = without_faults(settings, runs)
    return _SWITCHING[key]


_SWITCHING: dict[tuple[Path, int], Trajectory] = {}
"""Runs under S3 by data set and number, which rows of a comparison share."""
