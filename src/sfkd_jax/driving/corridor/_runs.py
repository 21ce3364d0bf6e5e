"""Whole runs of a closed loop, and the smallest bounds that hold on each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.certificate import OutputMetric
from sfkd_jax.certification import FORMS, radii, residuals
from sfkd_jax.driving.certificate import Seen
from sfkd_jax.driving.corridor._alarms import BATCHES, simulate_nominal
from sfkd_jax.driving.corridor._closed_loop import Loop, law_sensors
from sfkd_jax.driving.drives import Reading, drive_along_path, from_s3
from sfkd_jax.driving.path_coordinates import LATERAL
from sfkd_jax.driving.scenarios import DRIVES, DriveClass
from sfkd_jax.latency import Delays
from sfkd_jax.schedules import random_switching
from sfkd_jax.types import BODY, Key, Trajectory

ROAD_SETTINGS = DriveClass._fields
"""Settings of the data set that say which class its drives are of."""
OUTPUTS = ("position", "yaw")
"""Outputs whose distances to the nominal model a corridor bounds: e_y and e_ψ."""
EXCITATION = ("steering_excitation", "speed_excitation")
"""Settings of the data set that say how ν is drawn."""
PARTS = 4 + 2 + BATCHES
"""Parts of the runs: for units, bounds, coverage and S3, and those of the alarms."""
LATE_PARTS = 3
"""Parts of the runs that are later than stated: for units, bounds and coverage."""
Driver: TypeAlias = Callable[[Key], tuple[Trajectory, Reading | None]]
"""key -> runs, and what the law has read on them."""


def steps_of_part(dt: float, runs: int, duration: float) -> int:
    """Return the number of steps of the vehicle in a part of the runs.

    Args:
        dt: sampling period of the vehicle [s].
        runs: of every group.
        duration: of a run [s].
    """
    return len(DRIVES) * runs * round(duration / dt)


def simulated_steps(
    dt: float, runs: int, duration: float, attack_steps: int, later: Delays
) -> int:
    """Return the number of steps of the vehicle in `measure_corridor`.

    Args:
        dt: sampling period of the vehicle [s].
        runs: as of `measure_corridor`.
        duration: of a run [s].
        attack_steps: as there.
        later: as there.
    """
    parts = PARTS + 2 * LATE_PARTS * len(later)
    return parts * steps_of_part(dt, runs, duration) + attack_steps


def drivers_of(
    loop: Loop,
    data: Mapping[str, Any],
    runs: int,
    duration: float,
    dwell: tuple[float, float],
) -> tuple[Driver, Driver]:
    """Return drivers under the conditions, and on S3; compiled.

    Each makes `runs` runs of every group, group after group.
    """
    low = data["env_low"]
    high = data["env_high"]
    dt = loop.plant.dt
    steps = round(duration / dt)
    switching = partial(
        random_switching, steps=steps, dt=dt, low=low, high=high, dwell=dwell
    )
    groups = jnp.repeat(jnp.arange(len(DRIVES)), runs)
    driver = partial(_driver, loop, data, groups)
    return driver(switching), driver(from_s3(steps, dt, low, high))


def _driver(
    loop: Loop,
    data: Mapping[str, Any],
    groups: Int[Array, " run"],
    conditions: Callable[[Key], Array],
) -> Driver:
    """Return key -> runs of the groups, each in an environment of its own; compiled."""
    drive = partial(
        drive_along_path,
        loop.plant,
        limits=DriveClass(**drive_class(data)),
        sensors=law_sensors(loop),
        offset=(0.0, 0.0, 0.0),
        burn_in=0,
        **{name: data[name] for name in EXCITATION},
    )

    def driven(key: Key) -> tuple[Trajectory, Reading | None]:
        env_key, run_key = jax.random.split(key)
        envs = jax.vmap(conditions)(jax.random.split(env_key, len(groups)))
        return drive(envs, run_key, groups=groups)

    return jax.jit(driven)


def scores_of_runs(
    loop: Loop, claims: Mapping[str, OutputMetric], runs: Trajectory
) -> tuple[np.ndarray, np.ndarray]:
    """Return the scores of recorded runs and their e_y (run, time).

    They are computed as those of simulated runs. The state of the vehicle is what its
    sensors show, for the nominal model too.
    """
    simulate = jax.jit(partial(simulate_nominal, loop))
    measured = measure_runs(loop, claims, simulate, runs, jax.random.key(0))
    return measured.scores, measured.lateral


def drive_class(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a data set that say which drives a corridor is about."""
    return {name: data[name] for name in ROAD_SETTINGS}


class Part(NamedTuple):
    """What is measured on a part of the runs.

    Attributes:
        lateral: e_y of the car [m].
        nominal: ê_y of the nominal model [m].
        scores: the smallest bounds that would have held on each run, in the order of
            `JOINT` and `ALONE`. They are infinite where a simulator failed: such a run
            counts as one outside of every bound.
    """

    lateral: Float[np.ndarray, "run time"]
    nominal: Float[np.ndarray, "run time"]
    scores: Float[np.ndarray, "run 5"]

    @property
    def failed(self) -> int:
        """Number of runs in which a simulator failed."""
        return int(np.isinf(self.scores[:, 0]).sum())

    def largest(self) -> Seen:
        """Return how far the car came from the nominal model and from the path."""
        return Seen(
            distance_m=float(np.nanmax(np.abs(self.lateral - self.nominal))),
            lateral_m=float(np.nanmax(np.abs(self.lateral))),
        )


def measure_runs(
    loop: Loop,
    claims: Mapping[str, OutputMetric],
    simulate: Callable[..., Any],
    runs: Trajectory,
    key: Key,
) -> Part:
    """Measure a part of the runs.

    Args:
        loop: that drove the runs.
        claims: proved metrics by the names of the outputs.
        simulate: `simulate_nominal` of the loop, compiled once for all parts of the
            same size.
        runs: of this part.
        key: of the sensors of the nominal model; consumed.
    """
    nominal, start = (np.asarray(part, np.float64) for part in simulate(runs, key))
    errors = residuals(loop.model, loop.params, runs)
    bounds = [radii(errors, name, claims[name], start) for name in OUTPUTS]
    alone, together = ([of_output[form] for of_output in bounds] for form in FORMS)
    largest_nominal = np.max(np.abs(nominal), axis=1)
    scores = np.column_stack([*together, largest_nominal, *alone])
    scores[np.isnan(scores).any(axis=1)] = np.inf
    states = np.asarray(runs.states, dtype=np.float64)
    return Part(states[:, 1:, BODY][..., LATERAL], nominal, scores)
