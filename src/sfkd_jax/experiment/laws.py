"""The law of a data set along a path, derived from a model of the vehicle."""

from __future__ import annotations

import math
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
from sfkd_jax.driving.path_coordinates import (
    CURVATURE,
    LATERAL,
    REFERENCE_SPEED,
    is_valid,
)
from sfkd_jax.driving.path_following import (
    TEXTBOOK,
    PathLaw,
    checked_law,
    derive_path_law,
    law_from_arrays,
    textbook_law,
    unsettled_coordinates,
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
TIGHTEST_CIRCLES = 0.675
"""Curvature of the tightest circles without a law, times the wheelbase [-]. For a car
it is 0.25 1/m.
"""
LOST = 1.0 / 2.7
"""Largest lateral error that counts when laws are compared, in wheelbases: 1 m for a
car. A vehicle that leaves its path is lost, however far.
"""
LARGEST_RATIO = 1.5
"""A law of a learned model is accepted if its lateral error is at most this times what
its model promises, and `SLACK_MM`.
"""
SLACK_MM = 5.0
LARGEST_ERROR = 0.1
"""A law is accepted if its lateral error is at most this [wheelbases, RMS]."""
LARGEST_SHARE_DROPPED = 0.1
"""Share of the runs that a simulator may fail in."""


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
        unsettled=_unsettled(simulate, step),
        **{corner: tuple(map(float, ends)) for corner, ends in box.items()},
        **arguments(drives.law, derive_path_law),
    )
    law = jax.jit(derive)()
    steering = min(abs(plant.control_low[0]), abs(plant.control_high[0]))
    tightest = math.tan(min(steering, 1.5)) / plant.wheelbase
    law, findings = checked_law(law, tightest=tightest)
    for finding in findings:
        store.print_message(f"vehicle {plant.name}: {finding}")
    if name in TEXTBOOK:
        return _best_textbook_law(simulate, law, name)
    _check_law(simulate, law, step)
    return law


def _unsettled(simulate: _Simulation, step: Step) -> tuple[int, ...]:
    """Return the path coordinates that no steady turn fixes.

    Those of the vehicle are printed. In the textbook's model further states are
    constant, which is no finding.

    Args:
        simulate: what the law is for.
        step: of the model that the law is derived from.
    """
    plant = simulate.plant
    drives = simulate.drives
    # A learned model has no zeros, so the vehicle is asked.
    asked = plant.forgetting().step if drives.law.model == "learned" else step
    low, high = (np.asarray(end, float) for end in simulate.box.values())
    found = unsettled_coordinates(
        asked,
        coordinates=len(plant.state_names) - 1,
        speed=float(np.mean(drives.law.speed)),
        env=tuple((0.5 * (low + high)).tolist()),
    )
    if found and asked is plant.step:
        names = ", ".join(plant.state_names[coordinate + 1] for coordinate in found)
        store.print_message(
            f"vehicle {plant.name}: {names} never settle, so no steady turn fixes "
            "them; leave them out of state_names if no other state depends on them"
        )
    return found


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
    if plant.hidden:
        raise ValueError(
            f"vehicle {plant.name} has hidden states, which no law can know: "
            "dataset.law.model=learned"
        )
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
        tightest=TIGHTEST_CIRCLES / plant.wheelbase,
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

    Where the vehicle strays much farther than a learned model, the model was fitted
    badly. Where both stray far, the law does not suit the vehicle. The law of the
    textbook's model is what the settings ask for, however far it strays.

    Raises:
        ValueError: the vehicle strays too far; says which of the two it is.
    """
    plant = simulate.plant
    name = simulate.drives.law.model
    error = _lateral_error(simulate, plant.step)(law)
    line = (
        f"the law of the {name} model keeps vehicle {plant.name} within {error:.1f} mm "
        "(RMS) of its paths"
    )
    promised = error
    # Beside itself a plant, or a model of logs, would find nothing.
    if step is not plant.step:
        promised = _lateral_error(simulate, step)(law)
        line = f"{line}, the model promises {promised:.1f} mm"
    store.print_message(line)
    if name == "nominal":
        return
    # Not `>`: NaN is no law.
    if not error <= LARGEST_RATIO * promised + SLACK_MM:
        raise ValueError(
            f"{line}: the model was fitted badly; narrow dataset.law.speed or "
            "dataset.law.lateral_acceleration, or pass dataset.law.model=plant"
        )
    largest = 1e3 * LARGEST_ERROR * plant.wheelbase
    if error <= largest:
        return
    cause = (
        "the weights dataset.law.curvature, lateral and heading do not suit the "
        "vehicle, or its roads need more than tyres and steering give"
    )
    if step is not plant.step:
        cause = f"its model is rough (dataset.law.model=plant has none), or {cause}"
    raise ValueError(
        f"{line}, more than {largest:.0f} mm, a tenth of its wheelbase: {cause}"
    )


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
        vehicle = simulate.plant
        # Only the vehicle itself has hidden states; a model of it has none.
        if step is not vehicle.step:
            vehicle = vehicle._replace(step=step, hidden=0)
        loop = along_path(vehicle, law, perturbation=perturbation)
        return generate_along_path(loop, key, **options)

    def lateral_error(law: PathLaw) -> float:
        (runs,) = without_faults(drive(law), simulator=simulate.simulator)
        lateral = np.abs(np.asarray(runs.states, float)[..., BODY.start + LATERAL])
        lost = LOST * simulate.plant.wheelbase
        # NaN is far from the path, too.
        lateral = np.where(lateral <= lost, lateral, lost)
        return 1e3 * float(np.sqrt(np.mean(lateral**2)))

    return lateral_error


def without_faults(runs: Trajectory, *labels: Any, simulator: bool) -> Any:
    """Drop the runs in which a simulator failed, and print how many they are.

    A run that has left its path before it is not finite is no failure of the simulator,
    and is kept: path coordinates are not meaningful there.

    Args:
        runs: simulated, (run, …).
        labels: arrays with an entry for each run.
        simulator: whether the vehicle is one on the host. In a function of jax it is a
            fault of the vehicle, which others report.

    Returns:
        (runs, *labels) without the runs that failed.

    Raises:
        ValueError: the simulator failed in more than `LARGEST_SHARE_DROPPED` of them.
    """
    finite = np.isfinite(np.asarray(runs.states)).all(axis=(1, 2))
    failed = ~finite & ~_left_path(runs)
    if not simulator or not failed.any():
        return runs, *labels
    line = f"the simulator failed in {failed.sum()} of {len(failed)} runs"
    if failed.mean() > LARGEST_SHARE_DROPPED:
        raise ValueError(
            f"{line}, and no more than {LARGEST_SHARE_DROPPED:.0%} may be dropped; the "
            "warnings above say how it failed"
        )
    store.print_message(f"{line}, which are dropped; the warnings above say how")
    kept = np.flatnonzero(~failed)
    return jax.tree.map(lambda leaf: leaf[kept], (runs, *labels))


def _left_path(runs: Trajectory) -> np.ndarray:
    """Return which runs were where path coordinates are not meaningful.

    No run was, if the runs are not in path coordinates.
    """
    controls = jnp.asarray(runs.controls)
    if controls.shape[-1] <= REFERENCE_SPEED:
        return np.zeros(len(controls), bool)
    lateral = jnp.asarray(runs.states)[:, :-1, BODY.start + LATERAL]
    beyond = ~is_valid(lateral, controls[..., CURVATURE])
    return np.asarray(jnp.any(jnp.isfinite(lateral) & beyond, axis=1))
