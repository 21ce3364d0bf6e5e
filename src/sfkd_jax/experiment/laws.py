"""The law of a run along a path: loaded if it exists, derived if it does not."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
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
from sfkd_jax.data import generate_along_path, generate_open_loop, split
from sfkd_jax.experiment import identified
from sfkd_jax.experiment.dataset_files import dataset_config, dataset_path
from sfkd_jax.experiment.options import Settings
from sfkd_jax.plants import Vehicle, along_path
from sfkd_jax.settings import arguments
from sfkd_jax.types import BODY, Step, Trajectory

LAW = "law"
"""The kind of the file of a law."""
OPEN_LOOP_STREAM = 3
LAW_ALONE_STREAM = 4
"""Streams folded into the data set's seed: for runs without a law, and for runs of the
law alone. Simulation and split use 0 and 1, runs of S3 use 2.
"""
NO_EXCITATION = (1e-6, 2e-6)
"""Excitation of the law alone: none, but with a logarithm."""
LOST_M = 1.0
"""Largest lateral error that counts when laws are compared [m]."""
LARGEST_RATIO = 1.5
"""A law is accepted if its lateral error is at most this times what its model promises,
and `SLACK_MM`.
"""
SLACK_MM = 5.0


def ensure_law(settings: Settings) -> PathLaw | None:
    """Return the law of the data set, derived if it is missing; None in the world."""
    if settings.along_path is None:
        return None
    path = dataset_path(settings).with_name("law.safetensors")
    config = dataset_config(settings)
    if not path.is_file():
        law = jax.device_get(derive_law(settings))
        store.write_arrays(path, law._asdict(), kind=LAW, config=config)
    arrays, _ = store.read_arrays(path, kind=LAW, config=config)
    return law_from_arrays(arrays)


def closed_loop(settings: Settings) -> Vehicle:
    """Return the closed loop of vehicle and law, in path coordinates."""
    law: Any = ensure_law(settings)
    return build.build_loop(build.build_vehicle(settings.vehicle), law)


def derive_law(settings: Settings) -> PathLaw:
    """Derive the law of the data set from the model that its settings name.

    Raises:
        ValueError: the law of a learned model does not hold the vehicle on its paths.
    """
    along: Any = settings.along_path
    plant = build.build_vehicle(settings.vehicle)
    name = along.law.model
    step = _step_of_model(settings, plant, name)
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
        return _best_textbook_law(settings, plant, law, name)
    # Beside itself a model of logs would find nothing.
    if name != "plant" and step is not plant.step:
        _check_law(settings, plant, law, step)
    return law


def _step_of_model(settings: Settings, plant: Vehicle, name: str) -> Step:
    """Return the step of the model that a law is derived from.

    Args:
        settings: of the run.
        plant: its vehicle.
        name: of the model, one of `build.LAW_MODELS`.
    """
    if name in ("nominal", *TEXTBOOK):
        return plant.nominal
    # A model of logs is a learned one already.
    if name == "learned" and not isinstance(settings.vehicle, LoggedVehicleSettings):
        return _learned_step(settings, plant)
    return plant.step


def _learned_step(settings: Settings, plant: Vehicle) -> Step:
    """Return the step of a regression of runs without a law, over the law's axes."""
    along: Any = settings.along_path
    box = settings.environment.box
    seed = jax.random.fold_in(jax.random.key(settings.dataset.seed), OPEN_LOOP_STREAM)
    run_key, split_key, start_key, fit_key = jax.random.split(seed, 4)
    began = time.perf_counter()
    # A little beyond the axes, at whose ends steady turns are sought.
    slowest, fastest = along.law.speed
    drive = partial(
        generate_open_loop,
        plant,
        speed=(0.8 * slowest, 1.1 * fastest),
        lateral_acceleration=1.2 * along.law.lateral_acceleration,
        **box,
    )
    (runs,) = without_faults(settings, jax.jit(drive)(run_key))
    dataset = split(runs, split_key, shares=(0.9, 0.05, 0.025, 0.025), **box)
    model, _, params = identified.regression(dataset, start_key, fit_key)
    store.print_message(
        f"fitted a model of vehicle {plant.name} to {runs.controls.shape[0]} runs in "
        f"{time.perf_counter() - began:.0f} s"
    )
    return models.step_of(model, params)


def _best_textbook_law(
    settings: Settings, plant: Vehicle, law: PathLaw, name: str
) -> PathLaw:
    """Return the law of a textbook whose constant keeps the vehicle nearest its paths.

    Args:
        settings: of the run.
        plant: its vehicle.
        law: whose steady turns the law of the textbook shares.
        name: of the textbook's law, in `control.TEXTBOOK`.
    """
    lateral_error = _lateral_error(settings, plant, plant.step)
    laws = [
        textbook_law(law, name, constant, wheelbase=plant.wheelbase)
        for constant in TEXTBOOK[name]
    ]
    errors = [lateral_error(law) for law in laws]
    store.print_message(
        f"the best of {len(laws)} laws of {name} keeps vehicle {plant.name} within "
        f"{min(errors):.1f} mm (RMS) of its paths"
    )
    return laws[int(np.argmin(errors))]


def _check_law(settings: Settings, plant: Vehicle, law: PathLaw, step: Step) -> None:
    """Drive the vehicle by the law alone, beside the model that it was derived from.

    Where the vehicle strays much farther than the model, the model is not that of the
    vehicle: a learned one is refused, the textbook's is what the settings ask for.
    """
    along: Any = settings.along_path
    name = along.law.model
    error = _lateral_error(settings, plant, plant.step)(law)
    promised = _lateral_error(settings, plant, step)(law)
    line = (
        f"the law of the {name} model keeps vehicle {plant.name} within {error:.1f} mm "
        f"(RMS) of its paths, the model promises {promised:.1f} mm"
    )
    # Not `>`: NaN is no law.
    if not error <= LARGEST_RATIO * promised + SLACK_MM and name == "learned":
        raise ValueError(
            f"{line}: it was fitted badly; narrow dataset.law.speed or "
            "dataset.law.lateral_acceleration, or pass dataset.law.model=plant"
        )
    store.print_message(line)


def _lateral_error(
    settings: Settings, plant: Vehicle, step: Step
) -> Callable[[PathLaw], float]:
    """Return law -> the lateral error of a step under it alone [mm, RMS]."""
    along: Any = settings.along_path
    perturbation = along.law.perturbation
    options = {
        **along.options,
        "steering_excitation": NO_EXCITATION,
        "speed_excitation": NO_EXCITATION,
        "segments": 240,
        "steps": 100,
        **settings.environment.box,
    }
    key = jax.random.fold_in(jax.random.key(settings.dataset.seed), LAW_ALONE_STREAM)

    @jax.jit
    def drive(law: PathLaw) -> Trajectory:
        vehicle = plant._replace(step=step)
        loop = along_path(vehicle, law, perturbation=perturbation)
        return generate_along_path(loop, key, **options)

    def lateral_error(law: PathLaw) -> float:
        (runs,) = without_faults(settings, drive(law))
        # A vehicle that leaves its path is lost, however far.
        lateral = jnp.clip(runs.states[..., BODY.start], -LOST_M, LOST_M)
        error = 1e3 * float(jnp.sqrt(jnp.mean(lateral**2)))
        return error if np.isfinite(error) else np.inf

    return lateral_error


def without_faults(settings: Settings, runs: Trajectory, *labels: Any) -> Any:
    """Drop the runs in which a simulator failed, and print how many they are.

    Args:
        settings: of the run.
        runs: simulated, (run, …).
        labels: arrays with an entry for each run.

    Returns:
        (runs, *labels) without the runs that failed.

    Raises:
        ValueError: the simulator failed in every run.
    """
    states = np.asarray(runs.states)
    kept = np.flatnonzero(np.isfinite(states).all(axis=(1, 2)))
    num_failed = len(states) - len(kept)
    # In a function of jax it is a fault of the vehicle, which others report.
    has_simulator = bool(getattr(settings.vehicle, "env", None))
    if not num_failed or not has_simulator:
        return runs, *labels
    failed = f"the simulator failed in {num_failed} of {len(states)} runs"
    if not len(kept):
        raise ValueError(f"{failed}; the warnings above say how")
    store.print_message(f"{failed}, which are dropped")
    return jax.tree.map(lambda leaf: leaf[kept], (runs, *labels))
