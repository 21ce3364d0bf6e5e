"""The data set of a run and its law: loaded if they exist, made if they do not."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import build, models, store
from sfkd_jax.build import LoggedVehicleSettings
from sfkd_jax.control import (
    TEXTBOOK,
    PathLaw,
    derive_path_law,
    law_from_arrays,
    textbook_law,
)
from sfkd_jax.data import (
    PARTS,
    SCENARIOS,
    Dataset,
    check_on_path,
    environment_box,
    fingerprint,
    generate,
    generate_along_path,
    generate_open_loop,
    segment_scenarios,
    split,
)
from sfkd_jax.experiment import identified
from sfkd_jax.experiment.options import LogSettings, Settings
from sfkd_jax.plants import Vehicle, along_path, check_step
from sfkd_jax.settings import arguments
from sfkd_jax.types import BODY, Key, Step, Trajectory

DATASET, LAW = "dataset", "law"
SWITCHING, OPEN_LOOP, ALONE = 2, 3, 4
"""Streams folded into the data set's seed; simulation and split use 0 and 1."""
QUIET = (1e-6, 2e-6)
"""Excitation of the law alone: none, but with a logarithm."""
LOST = 1.0
"""Largest lateral error that counts when laws are compared [m]."""
STRAYS, SLACK = 1.5, 5.0
"""A law is accepted up to this factor of what its model promises, and so many mm."""


def config(settings: Settings) -> dict[str, Any]:
    """Return what the data set of a run depends on; runs of equal values share it."""
    dataset, environment = store.plain(settings.dataset), settings.environment
    if logs := settings.logs:
        # Contents instead of the path: the same logs elsewhere make the same data set.
        del dataset["path"]
        dataset["contents"] = fingerprint(logs.path)
        dataset["environment_known"] = environment.is_known
    box = {"low": environment.low, "high": environment.high}
    vehicle = store.plain(settings.vehicle)
    if isinstance(settings.vehicle, LoggedVehicleSettings):
        # `contents` say what the vehicle is; where that lies is no matter.
        del vehicle["path"], vehicle["identified"]
    return store.plain({"vehicle": vehicle, "environment": box, "dataset": dataset})


def dataset_path(settings: Settings) -> Path:
    """Return the path of the data set of a run."""
    name = f"{settings.vehicle.name}-{store.sha256(config(settings))[:8]}"
    return Path(settings.root) / "datasets" / name / "dataset.safetensors"


def ensure_dataset(settings: Settings) -> tuple[Dataset, str]:
    """Return the data set and its hash; simulate or read it if it is missing."""
    path = dataset_path(settings)
    if not path.is_file():
        with store.locked(path.parent, wait=True):  # other runs share the data set
            # Another run may have made it while this one waited for the lock.
            if not path.is_file():
                logs = settings.logs
                made = _read_logs(settings, logs) if logs else _simulate(settings)
                write(settings, made)
    # Read back even if just made: every run trains on what is stored.
    return read(settings)


def _simulate(settings: Settings) -> Dataset:
    """Simulate a data set with the vehicle of the settings."""
    environments = len(settings.environment.low or (0, 0))
    check_step(build.build_vehicle(settings.vehicle), environments)
    options: Any = settings.dataset
    # A key each: other shares of the split leave the trajectories as they are.
    drive_key, split_key = jax.random.split(jax.random.key(options.seed))
    store.print_message(f"generating {options.segments} segments")
    trajectories = jax.jit(_generator(settings))(drive_key)
    along = bool(settings.along_path)
    labels = segment_scenarios(options.segments, along_path=along)
    trajectories, labels = _without_faults(settings, trajectories, labels)
    if along:
        check_on_path(trajectories)
    return split(
        trajectories,
        split_key,
        shares=options.shares,
        scenarios=jnp.asarray(labels),
        **settings.environment.box,
    )


def _without_faults(settings: Settings, runs: Trajectory, *more: Any) -> Any:
    """Drop the runs in which a simulator failed, and say how many they are."""
    states = np.asarray(runs.states)
    kept = np.flatnonzero(np.isfinite(states).all(axis=(1, 2)))
    lost = len(states) - len(kept)
    # Of a function of jax it is a fault of the vehicle, which others report.
    if not lost or not getattr(settings.vehicle, "env", None):
        return runs, *more
    failed = f"the simulator failed in {lost} of {len(states)} runs"
    if not len(kept):
        raise ValueError(f"{failed}; the warnings above say how")
    store.print_message(f"{failed}, which are dropped")
    return jax.tree.map(lambda leaf: leaf[kept], (runs, *more))


def _generator(
    settings: Settings, *, switching: bool = False, **changes: int
) -> Callable[[Key], Trajectory]:
    """Return key -> the runs of a data set, or as many under the switching of S3."""
    changes["held_out"] = switching
    box = settings.environment.box
    if settings.along_path:
        options = settings.along_path.options | changes
        return partial(generate_along_path, closed_loop(settings), **options, **box)
    plant = build.build_vehicle(settings.vehicle)
    options = arguments(settings.dataset, generate) | changes
    return partial(generate, plant, build.build_driver(plant), **options, **box)


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
        arrays |= {f"{part}/scenario": dataset.scenarios[part] for part in PARTS}
    about = config(settings)
    store.write_arrays(dataset_path(settings), arrays, kind=DATASET, config=about)


def read(settings: Settings) -> tuple[Dataset, str]:
    """Return a data set and its hash."""
    path, scenarios = dataset_path(settings), None
    arrays, manifest = store.read_arrays(path, kind=DATASET, config=config(settings))

    def named(name: str) -> list[jax.Array]:
        return jax.device_put([arrays[f"{part}/{name}"] for part in PARTS])

    with store.as_artefact_error(path):
        fields = map(named, Trajectory._fields)
        parts = [Trajectory(*own) for own in zip(*fields, strict=True)]
        if settings.logs is None:
            scenarios = dict(zip(PARTS, named("scenario"), strict=True))
    # Over all parts: E does not depend on how they were split.
    envs = np.concatenate([np.asarray(part.envs) for part in parts])
    known = settings.logs is None or settings.environment.is_known
    box = settings.environment.box.values() if known else (None, None)
    low, high = environment_box(envs, *box, known=known)
    runs = None
    if (counts := arrays.get("runs")) is not None:
        runs = dict(zip(PARTS, map(int, counts), strict=True))
    dataset = Dataset(
        *parts, env_low=low, env_high=high, runs=runs, scenarios=scenarios
    )
    return dataset, manifest["sha256"]


def ensure_law(settings: Settings) -> PathLaw | None:
    """Return the law of the data set, derived if it is missing; None in the world."""
    if settings.along_path is None:
        return None
    path, about = dataset_path(settings).with_name("law.safetensors"), config(settings)
    if not path.is_file():
        law = jax.device_get(derive_law(settings))
        store.write_arrays(path, law._asdict(), kind=LAW, config=about)
    return law_from_arrays(store.read_arrays(path, kind=LAW, config=about)[0])


def derive_law(settings: Settings) -> PathLaw:
    """Derive the law of the data set from the model that its settings name.

    Raises:
        ValueError: the law of a learned model does not hold the vehicle on its paths.
    """
    along: Any = settings.along_path
    plant = build.build_vehicle(settings.vehicle)
    name, step = along.law.model, plant.step
    if name in ("nominal", *TEXTBOOK):
        step = plant.nominal
    # A model of logs is a learned one already.
    elif name == "learned" and not isinstance(settings.vehicle, LoggedVehicleSettings):
        step = _learned_step(settings, plant)
    store.print_message(
        f"deriving the law of vehicle {plant.name} from its {name} model"
    )
    box = settings.environment.box
    derive = partial(
        derive_path_law,
        step,
        coordinates=len(plant.state_names) - 1,
        **{corner: tuple(map(float, ends)) for corner, ends in box.items()},
        **arguments(along.law, derive_path_law),
    )
    law = jax.jit(derive)()
    if name in TEXTBOOK:
        stray, about = _strays(settings, plant, plant.step), TEXTBOOK[name]
        made = [textbook_law(law, name, k, wheelbase=plant.wheelbase) for k in about]
        found = [stray(one) for one in made]
        law = made[int(np.argmin(found))]
        store.print_message(
            f"the best of {len(made)} laws of {name} keeps vehicle {plant.name} within "
            f"{min(found):.1f} mm (RMS) of its paths"
        )
    # Beside itself a model of logs would find nothing.
    elif name != "plant" and step is not plant.step:
        _check_law(settings, plant, law, step)
    return law


def _strays(
    settings: Settings, plant: Vehicle, step: Step
) -> Callable[[PathLaw], float]:
    """Return law -> how far from its paths a step drives under it alone [mm, RMS]."""
    quiet = dict.fromkeys(("steering_excitation", "speed_excitation"), QUIET)
    along: Any = settings.along_path
    options, excited = along.options | quiet, along.law.perturbation
    options |= {"segments": 240, "steps": 100, **settings.environment.box}
    seed = jax.random.fold_in(jax.random.key(settings.dataset.seed), ALONE)

    @jax.jit
    def drive(law: PathLaw) -> Trajectory:
        loop = along_path(plant._replace(step=step), law, perturbation=excited)
        return generate_along_path(loop, seed, **options)

    def lateral(law: PathLaw) -> float:
        (runs,) = _without_faults(settings, drive(law))
        # A vehicle that leaves its path is lost, however far.
        off = jnp.clip(runs.states[..., BODY.start], -LOST, LOST)
        found = 1e3 * float(jnp.sqrt(jnp.mean(off**2)))
        return found if np.isfinite(found) else np.inf

    return lateral


def _check_law(settings: Settings, plant: Vehicle, law: PathLaw, step: Step) -> None:
    """Drive the vehicle by the law alone, beside the model that it was derived from.

    Where the vehicle strays much farther than the model, the model is not that of the
    vehicle: a learned one is refused, the textbook's is what was asked for.
    """
    found, promised = (_strays(settings, plant, one)(law) for one in (plant.step, step))
    name = settings.along_path.law.model  # pyright: ignore
    line = (
        f"the law of the {name} model keeps vehicle {plant.name} within {found:.1f} mm "
        f"(RMS) of its paths, the model promises {promised:.1f} mm"
    )
    # Not `>`: NaN is no law.
    if not found <= STRAYS * promised + SLACK and name == "learned":
        raise ValueError(
            f"{line}: it was fitted badly; narrow dataset.law.speed or "
            "dataset.law.lateral_acceleration, or pass dataset.law.model=plant"
        )
    store.print_message(line)


def _learned_step(settings: Settings, plant: Vehicle) -> Step:
    """The step of a regression of runs without a law, over the axes of the law."""
    box = settings.environment.box
    law: Any = settings.along_path and settings.along_path.law
    seed = jax.random.fold_in(jax.random.key(settings.dataset.seed), OPEN_LOOP)
    run_key, split_key, start_key, fit_key = jax.random.split(seed, 4)
    begun = time.perf_counter()
    drive = partial(
        generate_open_loop,
        plant,
        # A little beyond the axes, at whose ends steady turns are sought.
        speed=(0.8 * law.speed[0], 1.1 * law.speed[1]),
        lateral_acceleration=1.2 * law.lateral_acceleration,
        **box,
    )
    (runs,) = _without_faults(settings, jax.jit(drive)(run_key))
    dataset = split(runs, split_key, shares=(0.9, 0.05, 0.025, 0.025), **box)
    model, _, params = identified.regression(dataset, start_key, fit_key)
    store.print_message(
        f"fitted a model of vehicle {plant.name} to {runs.controls.shape[0]} runs in "
        f"{time.perf_counter() - begun:.0f} s"
    )
    return models.step_of(model, params)


def closed_loop(settings: Settings) -> Vehicle:
    """Return the closed loop of vehicle and law, in path coordinates."""
    law: Any = ensure_law(settings)
    return build.build_loop(build.build_vehicle(settings.vehicle), law)


def boxes(dataset: Dataset) -> dict[str, list[list[float]]]:
    """Return the box of the measurements, as lower and upper corners.

    Those of body state and control are hulls over training and calibration parts; that
    of the environment is E.
    """

    def hull(*values: Any) -> list[list[float]]:
        flat = np.concatenate([np.reshape(one, (-1, one.shape[-1])) for one in values])
        return [flat.min(axis=0).tolist(), flat.max(axis=0).tolist()]

    train, calibration = dataset.train, dataset.calibration
    corners = dataset.env_low, dataset.env_high
    return {
        "state": hull(train.states[..., BODY], calibration.states[..., BODY]),
        "control": hull(train.controls, calibration.controls),
        "env": [np.asarray(corner).tolist() for corner in corners],
    }


def held_out_parts(settings: Settings, dataset: Dataset) -> dict[str, Trajectory]:
    """Return the trajectories on which coverage is measured, by name.

    These are the test part, its segments of each scenario, and as many runs of S3,
    which training never uses. Of logged runs, without scenarios, it is the test part.
    """
    parts = {"test": dataset.test}
    if dataset.scenarios is None:
        return parts
    key = dataset_path(settings), dataset.test.controls.shape[0]
    if key not in _SWITCHING:
        simulate = jax.jit(_generator(settings, switching=True, segments=key[1]))
        seed = jax.random.key(settings.dataset.seed)
        # A stream of its own: S3 must not repeat what the training data drew.
        runs = simulate(jax.random.fold_in(seed, SWITCHING))
        (_SWITCHING[key],) = _without_faults(settings, runs)
    parts["s3"] = _SWITCHING[key]
    for code, name in enumerate(SCENARIOS):
        if (chosen := dataset.scenarios["test"] == code).any():
            parts[name] = jax.tree.map(
                lambda leaf, chosen=chosen: leaf[chosen], dataset.test
            )
    return parts


_SWITCHING: dict[tuple[Path, int], Trajectory] = {}
"""Runs under S3 by data set and number, which rows of a comparison share."""
