"""The law of a data set along a path, derived from a model of the vehicle."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax import models, store
from sfkd_jax.assembly import LOGGED
from sfkd_jax.data import split
from sfkd_jax.driving.drives import generate_along_path, generate_open_loop
from sfkd_jax.driving.path_following import (
    TEXTBOOK,
    PathLaw,
    derive_path_law,
    law_from_arrays,
    textbook_law,
)
from sfkd_jax.driving.plants import Vehicle, along_path
from sfkd_jax.experiment import identified
from sfkd_jax.experiment.options import AlongPathSettings
from sfkd_jax.settings import arguments
from sfkd_jax.types import BODY, Key, Step, Trajectory

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


def write(path: Path, law: PathLaw, config: dict[str, Any]) -> None:
    """Write a law, with the settings that it depends on."""
    tables = jax.device_get(law)._asdict()
    store.write_arrays(path, tables, kind=LAW, config=config)


def read(path: Path, config: dict[str, Any]) -> PathLaw:
    """Return the law in a file, which must have been made with these settings."""
    arrays, _ = store.read_arrays(path, kind=LAW, config=config)
    return law_from_arrays(arrays)


def derive_law(
    plant: Vehicle,
    drives: AlongPathSettings,
    box: dict[str, Any],
    *,
    simulator: bool = False,
) -> PathLaw:
    """Derive the law of a data set from the model that its settings name.

    Args:
        plant: that the law drives.
        drives: settings of the data set and of its law.
        box: the corners of E.
        simulator: whether the plant is one on the host, whose failed runs are dropped.

    Raises:
        ValueError: the law of a learned model does not hold the vehicle on its paths.
    """
    name = drives.law.model
    simulate = _Simulation(plant, drives, box, simulator)
    step = _step_of_model(simulate, name)
    store.print_message(
        f"deriving the law of vehicle {plant.name} from its {name} model"
    )
    derive = partial(
        derive_path_law,
        step,
        coordinates=len(plant.state_names) - 1,
        **{corner: tuple(map(float, ends)) for corner, ends in box.items()},
        **arguments(drives.law, derive_path_law),
    )
    law = jax.jit(derive)()
    if name in TEXTBOOK:
        return _best_textbook_law(simulate, law, name)
    # Beside itself a model of logs would find nothing.
    if name != "plant" and step is not plant.step:
        _check_law(simulate, law, step)
    return law


class _Simulation(NamedTuple):
    """What a law is derived for: see `derive_law`."""

    plant: Vehicle
    drives: AlongPathSettings
    box: dict[str, Any]
    simulator: bool

    def key(self, stream: int) -> Key:
        """Return the key of a stream of the data set's seed."""
        return jax.random.fold_in(jax.random.key(self.drives.seed), stream)


def _step_of_model(simulate: _Simulation, name: str) -> Step:
    """Return the step of the model that a law is derived from.

    Args:
        simulate: what the law is for.
        name: of the model, one of `assembly.LAW_MODELS`.
    """
    plant = simulate.plant
    if name in ("nominal", *TEXTBOOK):
        return plant.nominal
    # A model of logs is a learned one already.
    if name == "learned" and plant.name != LOGGED:
        return _learned_step(simulate)
    return plant.step


def _learned_step(simulate: _Simulation) -> Step:
    """Return the step of a regression of runs without a law, over the law's axes."""
    plant = simulate.plant
    law = simulate.drives.law
    box = simulate.box
    seed = simulate.key(OPEN_LOOP_STREAM)
    run_key, split_key, start_key, fit_key = jax.random.split(seed, 4)
    began = time.perf_counter()
    # A little beyond the axes, at whose ends steady turns are sought.
    slowest, fastest = law.speed
    drive = partial(
        generate_open_loop,
        plant,
        speed=(0.8 * slowest, 1.1 * fastest),
        lateral_acceleration=1.2 * law.lateral_acceleration,
        **box,
    )
    driven = jax.jit(drive)(run_key)
    (runs,) = without_faults(driven, simulator=simulate.simulator)
    dataset = split(runs, split_key, shares=(0.9, 0.05, 0.025, 0.025), **box)
    model, _, params = identified.regression(dataset, start_key, fit_key)
    store.print_message(
        f"fitted a model of vehicle {plant.name} to {runs.controls.shape[0]} runs in "
        f"{time.perf_counter() - began:.0f} s"
    )
    return models.step_of(model, params)


def _best_textbook_law(simulate: _Simulation, law: PathLaw, name: str) -> PathLaw:
    """Return the law of a textbook whose constant keeps the vehicle nearest its paths.

    Args:
        simulate: what the law is for.
        law: whose steady turns the law of the textbook shares.
        name: of the textbook's law, in `path_following.TEXTBOOK`.
    """
    plant = simulate.plant
    lateral_error = _lateral_error(simulate, plant.step)
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


def _check_law(simulate: _Simulation, law: PathLaw, step: Step) -> None:
    """Drive the vehicle by the law alone, beside the model that it was derived from.

    Where the vehicle strays much farther than the model, the model is not that of the
    vehicle: a learned one is refused, the textbook's is what the settings ask for.
    """
    plant = simulate.plant
    name = simulate.drives.law.model
    error = _lateral_error(simulate, plant.step)(law)
    promised = _lateral_error(simulate, step)(law)
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


def _lateral_error(simulate: _Simulation, step: Step) -> Callable[[PathLaw], float]:
    """Return law -> the lateral error of a step under it alone [mm, RMS]."""
    drives = simulate.drives
    perturbation = drives.law.perturbation
    options = {
        **drives.options,
        "steering_excitation": NO_EXCITATION,
        "speed_excitation": NO_EXCITATION,
        "segments": 240,
        "steps": 100,
        **simulate.box,
    }
    key = simulate.key(LAW_ALONE_STREAM)

    @jax.jit
    def drive(law: PathLaw) -> Trajectory:
        vehicle = simulate.plant._replace(step=step)
        loop = along_path(vehicle, law, perturbation=perturbation)
        return generate_along_path(loop, key, **options)

    def lateral_error(law: PathLaw) -> float:
        (runs,) = without_faults(drive(law), simulator=simulate.simulator)
        # A vehicle that leaves its path is lost, however far.
        lateral = jnp.clip(runs.states[..., BODY.start], -LOST_M, LOST_M)
        error = 1e3 * float(jnp.sqrt(jnp.mean(lateral**2)))
        return error if np.isfinite(error) else np.inf

    return lateral_error


def without_faults(runs: Trajectory, *labels: Any, simulator: bool) -> Any:
    """Drop the runs in which a simulator failed, and print how many they are.

    Args:
        runs: simulated, (run, …).
        labels: arrays with an entry for each run.
        simulator: whether the vehicle is one on the host. In a function of jax it is a
            fault of the vehicle, which others report.

    Returns:
        (runs, *labels) without the runs that failed.

    Raises:
        ValueError: the simulator failed in every run.
    """
    states = np.asarray(runs.states)
    kept = np.flatnonzero(np.isfinite(states).all(axis=(1, 2)))
    num_failed = len(states) - len(kept)
    if not num_failed or not simulator:
        return runs, *labels
    failed = f"the simulator failed in {num_failed} of {len(states)} runs"
    if not len(kept):
        raise ValueError(f"{failed}; the warnings above say how")
    store.print_message(f"{failed}, which are dropped")
    return jax.tree.map(lambda leaf: leaf[kept], (runs, *labels))
