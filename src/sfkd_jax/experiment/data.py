"""The data set of a run and its law: loaded if they exist, made if they do not."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, store
from sfkd_jax.control import PathLaw, law_from_arrays
from sfkd_jax.data import (
    SCENARIOS,
    Columns,
    Dataset,
    check_on_path,
    environment_box,
    fingerprint,
    from_logs,
    generate,
    generate_along_path,
    generate_s3_along_path,
    generate_switching,
    segment_scenarios,
    segment_scenarios_along_path,
    split,
)
from sfkd_jax.experiment.options import (
    AlongPathSettings,
    CertificationSettings,
    DatasetSettings,
    EnvironmentSettings,
    LogSettings,
    Settings,
    SimulatedSettings,
)
from sfkd_jax.plants import Vehicle, check_step
from sfkd_jax.settings import arguments, plain
from sfkd_jax.types import BODY, Key, Trajectory

DATASET, LAW = "dataset", "law"
PARTS = Dataset._fields[:4]
SWITCHING = 2
"""Stream folded into the data set's seed; simulation and split use streams 0 and 1."""


class Source(NamedTuple):
    """What a data set depends on; runs of equal settings share it.

    Attributes:
        root: of all store.
        vehicle: that is simulated, or that the logs are of.
        environment: its box, and whether e is known.
        dataset: how it is made.
    """

    root: str
    vehicle: build.VehicleSettings
    environment: EnvironmentSettings
    dataset: DatasetSettings

    @property
    def logs(self) -> LogSettings | None:
        """The settings of logs; None if the data are simulated."""
        return self.dataset if isinstance(self.dataset, LogSettings) else None

    @property
    def along_path(self) -> AlongPathSettings | None:
        """The settings of path coordinates; None for those of the world."""
        return self.dataset if isinstance(self.dataset, AlongPathSettings) else None

    @property
    def knows_env(self) -> bool:
        """Whether the environment is measured or estimated."""
        return self.environment.source != "none"

    @property
    def config(self) -> dict[str, Any]:
        """The settings as plain values, with the contents of logs for their path."""
        options = plain(self.dataset)
        if self.logs:
            # Contents instead of the path: the same
            # logs elsewhere make the same data set.
            options["contents"] = fingerprint(options.pop("path"))
            options["environment_known"] = self.knows_env
        box = plain({"low": self.environment.low, "high": self.environment.high})
        return {
            "vehicle": plain(self.vehicle),
            "environment": box,
            "dataset": options,
        }

    @property
    def path(self) -> Path:
        """Of the data set."""
        digest = store.sha256(self.config)[:8]
        name = f"{self.vehicle.name}-{digest}"
        return Path(self.root) / "datasets" / name / "dataset.safetensors"

    @property
    def columns(self) -> dict[str, list[str]]:
        """Columns of the logs by box; an unused environment has none."""
        named = self.logs.columns if self.logs else Columns()
        return {
            "state": list(named.state[BODY]),
            "control": list(named.control),
            "env": list(named.environment) if self.knows_env else [],
        }


def source_of(settings: Settings) -> Source:
    """Return what the data set of a run depends on."""
    return Source(
        settings.root, settings.vehicle, settings.environment, settings.dataset
    )


def ensure_dataset(source: Source) -> tuple[Dataset, str]:
    """Return the data set and its hash; simulate or read it if it is missing."""
    path = source.path
    if not path.is_file():
        with store.locked(path.parent, wait=True):  # other runs share the data set
            # Another run may have made it while this one waited for the lock.
            if not path.is_file():
                logs = source.logs
                made = _read_logs(source, logs) if logs else _simulate(source)
                write(source, made)
    # Read back even if just made: every run trains on what is stored.
    return read(source)


def _simulate(source: Source) -> Dataset:
    """Simulate a data set with the vehicle of the settings.

    Raises:
        ValueError: the vehicle has no step, or one that does not return a state.
    """
    check_step(build.build_vehicle(source.vehicle))
    options, box = source.dataset, source.environment
    assert isinstance(options, SimulatedSettings)
    # A key each: other shares of the split leave the trajectories as they are.
    drive_key, split_key = jax.random.split(jax.random.key(options.seed))
    store.print_message(f"generating {options.segments} segments")
    trajectories = jax.jit(_generator(source))(drive_key)
    labels = segment_scenarios
    if source.along_path:
        check_on_path(trajectories)
        labels = segment_scenarios_along_path
    return split(
        trajectories,
        split_key,
        shares=options.shares,
        env_low=jnp.asarray(box.low),
        env_high=jnp.asarray(box.high),
        scenarios=jnp.asarray(labels(options.segments)),
    )


def _generator(
    source: Source, *, switching: bool = False, **changes: Any
) -> Callable[[Key], Trajectory]:
    """Return key -> the runs of a data set, or as many under the switching of S3.

    Args:
        source: simulated.
        switching: whether the environment follows S3.
        changes: of options of the generator.
    """
    plant = build.build_vehicle(source.vehicle)
    if source.along_path is None:
        make = generate_switching if switching else generate
        options = arguments(source.dataset, make) | changes
        return partial(make, plant, build.build_driver(plant), **options)
    loop = closed_loop(source)
    options = arguments(source.dataset, generate_along_path) | changes
    if switching:
        return partial(generate_s3_along_path, loop, **options)
    box: Any = source.environment.box
    return partial(generate_along_path, loop, **options, **box)


def _read_logs(source: Source, logs: LogSettings) -> Dataset:
    """Read a data set from logs, and write what it covers beside it.

    Raises:
        ValueError: the columns do not match the state of the vehicle.
    """
    plant = build.build_vehicle(source.vehicle)
    columns = Columns(**arguments(logs.columns, Columns))
    if len(columns.state) != len(plant.state_names):
        raise ValueError(
            f"dataset.columns.state names {len(columns.state)} columns, "
            f"vehicle {plant.name} has {', '.join(plant.state_names)}; "
            "name as many, in this order"
        )
    store.print_message(f"reading {logs.path}")
    logged = from_logs(
        logs.path,
        columns,
        report=store.print_message,
        dt=plant.dt,
        wheelbase=plant.wheelbase,
        needs_environment=source.knows_env,
        limits=(plant.control_low or None, plant.control_high or None),
        **source.environment.box,
        **arguments(logs, from_logs),
    )
    store.write_json(source.path.with_name("coverage.json"), logged.coverage)
    return logged.dataset


def write(source: Source, dataset: Dataset) -> None:
    """Write the four parts of a data set."""
    arrays = {
        f"{part}/{name}": np.asarray(leaf)
        for part in PARTS
        for name, leaf in getattr(dataset, part)._asdict().items()
    }
    if dataset.drives is not None:
        arrays["drives"] = np.asarray([dataset.drives[part] for part in PARTS])
    if dataset.scenarios is not None:
        labels = dataset.scenarios
        arrays |= {f"{part}/scenario": np.asarray(labels[part]) for part in PARTS}
    source.path.parent.mkdir(parents=True, exist_ok=True)
    store.write_arrays(source.path, arrays, kind=DATASET, config=source.config)


def read(source: Source) -> tuple[Dataset, str]:
    """Return a data set and its hash.

    Raises:
        ArtefactError: missing, damaged, or made with other settings.
    """
    arrays, manifest = store.read_arrays(
        source.path, kind=DATASET, config=source.config
    )
    with store.as_artefact_error(source.path):
        parts = [
            Trajectory(
                *(jnp.asarray(arrays[f"{part}/{name}"]) for name in Trajectory._fields)
            )
            for part in PARTS
        ]
        scenarios = None
        if source.logs is None:
            scenarios = {
                part: jnp.asarray(arrays[f"{part}/scenario"]) for part in PARTS
            }
    # Over all parts: E does not depend on how they were split.
    envs = np.concatenate([np.asarray(part.envs) for part in parts])
    low, high = environment_box(envs, *source.environment.box.values())
    counts = arrays.get("drives")
    drives = (
        None
        if counts is None
        else {part: int(count) for part, count in zip(PARTS, counts, strict=True)}
    )
    dataset = Dataset(
        *parts, env_low=low, env_high=high, drives=drives, scenarios=scenarios
    )
    return dataset, manifest["sha256"]


def ensure_law(source: Source) -> PathLaw | None:
    """Return the law of the data set; derive it if it is missing.

    Returns:
        The law, or None if the data set is not in path coordinates.
    """
    if source.along_path is None:
        return None
    path = source.path.with_name("law.safetensors")
    if not path.is_file():
        plant = build.build_vehicle(source.vehicle)
        store.print_message(f"deriving the law of vehicle {plant.name}")
        settings, box = source.along_path.law, source.environment.box
        derive: Any = partial(build.build_law, settings, plant, **box)  # pyright: ignore
        path.parent.mkdir(parents=True, exist_ok=True)
        plain_arrays = {
            name: np.asarray(array)
            for name, array in jax.jit(derive)()._asdict().items()
        }
        store.write_arrays(path, plain_arrays, kind=LAW, config=source.config)
    arrays, _ = store.read_arrays(path, kind=LAW, config=source.config)
    return law_from_arrays(arrays)


def closed_loop(source: Source) -> Vehicle:
    """Return the closed loop of vehicle and law, in the coordinates of `path_frame`.

    Raises:
        ValueError: the data set is not in path coordinates.
    """
    law = ensure_law(source)
    if law is None:
        raise ValueError("a loop along a path needs dataset=path")
    return build.build_loop(build.build_vehicle(source.vehicle), law)


def boxes(dataset: Dataset) -> dict[str, list[list[float]]]:
    """Return the box of the measurements, as lower and upper corners.

    Those of body state and control are hulls over training and calibration parts; that
    of the environment is E.
    """

    def hull(pick: Callable[[Trajectory], jax.Array]) -> list[list[float]]:
        values = np.concatenate(
            [np.asarray(pick(part)) for part in (dataset.train, dataset.calibration)]
        )
        flat = values.reshape(-1, values.shape[-1])
        return [flat.min(axis=0).tolist(), flat.max(axis=0).tolist()]

    return {
        "state": hull(lambda part: part.states[..., BODY]),
        "control": hull(lambda part: part.controls),
        "env": [
            np.asarray(dataset.env_low).tolist(),
            np.asarray(dataset.env_high).tolist(),
        ],
    }


def held_out_parts(source: Source, dataset: Dataset) -> dict[str, Trajectory]:
    """Return the trajectories on which coverage is measured, by name.

    These are the test part, its segments of each scenario, and as many runs of S3,
    which training never uses. Logged runs have no scenario: of them it is the test part
    only.

    Args:
        source: of the data set.
        dataset: all of its parts.
    """
    if dataset.scenarios is None:
        return {"test": dataset.test}
    labels = dataset.scenarios["test"]
    segments = dataset.test.controls.shape[0]
    parts = {"test": dataset.test, "s3": _switching(source, segments)}
    for code, name in enumerate(SCENARIOS):
        if (chosen := labels == code).any():
            parts[name] = jax.tree.map(
                lambda leaf, chosen=chosen: leaf[chosen], dataset.test
            )
    return parts


@lru_cache(maxsize=4)
def _switching(source: Source, segments: int) -> Trajectory:
    """Simulate runs under S3; cached for rows of a comparison."""
    simulate = jax.jit(_generator(source, switching=True, segments=segments))
    seed = jax.random.key(source.dataset.seed)
    # A stream of its own: S3 must not repeat what the training data drew.
    return simulate(jax.random.fold_in(seed, SWITCHING))


def check_calibration_size(
    dataset: Dataset, certification: CertificationSettings
) -> None:
    """Check before training that the calibration part supports the level.

    Raises:
        ValueError: naming the setting, and the largest level that is possible.
    """
    count = dataset.calibration.controls.shape[0]
    level = certification.level
    # As `conformal_quantile` will ask, but before the training.
    if math.ceil((count + 1) * level) > count:
        # Rounded down, so that the proposed level is accepted.
        highest = math.floor(100 * count / (count + 1)) / 100
        raise ValueError(
            f"{count} calibration segments are too few for "
            f"certification.level={level:g}: "
            f"record more, or pass certification.level={highest:g}"
        )
