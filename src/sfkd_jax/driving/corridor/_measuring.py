"""The corridor of a closed loop: calibrated on whole runs, tested and attacked.

The runs are those of the conditions that a certificate states: e switches in its box
with at least the dwell time, roads and perturbations ν are those of the data set, and
the law reads the state through the sensors. The bounds are measured on these runs; only
α, L and P behind them are proved.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.certificate import OutputMetric
from sfkd_jax.certification import (
    FORMS,
    OUTPUTS,
    conformal_bounds,
    radii,
    residuals,
    rows,
)
from sfkd_jax.driving.certificate import (
    Bounds,
    Conditions,
    Corridor,
    GroupBounds,
    JointBounds,
    Recorded,
    RecordedConditions,
    Seen,
)
from sfkd_jax.driving.corridor._alarms import (
    calibrate_innovations,
    innovations,
    simulate_nominal,
)
from sfkd_jax.driving.corridor._bounds import (
    ALONE,
    JOINT,
    calibrate_corridor,
    corridor_coverage,
)
from sfkd_jax.driving.corridor._closed_loop import Loop, law_sensors
from sfkd_jax.driving.corridor._margins import law_margins
from sfkd_jax.driving.corridor._worst_runs import WorstRuns, attack_corridor
from sfkd_jax.driving.drives import Reading, drive_along_path, from_s3
from sfkd_jax.driving.path_coordinates import LATERAL
from sfkd_jax.driving.scenarios import DRIVES, DriveClass, random_switching
from sfkd_jax.ranges import Interval, Span
from sfkd_jax.types import BODY, Key, Trajectory

ROAD_SETTINGS = DriveClass._fields
"""Settings of the data set that say which class its drives are of."""
EXCITATION = ("steering_excitation", "speed_excitation")
"""Settings of the data set that say how ν is drawn."""
STREAM = 4
"""Number that is folded into the data set's seed for the corridor. The data set itself
uses the streams 0 to 2.
"""
ALARM_STREAM = 5
"""The same for the test of innovations."""
Driver: TypeAlias = Callable[[Key], tuple[Trajectory, Reading | None]]
"""key -> runs, and what the law has read on them."""


def measure_corridor(
    loop: Loop,
    claims: Mapping[str, OutputMetric],
    data: Mapping[str, Any],
    level: float,
    *,
    runs: int = 150,
    duration: Annotated[float, Interval("(2, inf)")] = 60.0,
    dwell: Span = (3.0, 6.0),
    horizon: int = 20,
    attack_steps: int = 200_000,
    identified_from: str | None = None,
) -> Corridor:
    """Return the corridor of a policy, measured on simulated runs.

    Of each group of drives one part of `runs` fixes the units, one calibrates and one
    tests. The bounds are those of the worst group. Runs of S3 are tested too, although
    they do not meet the conditions.

    Args:
        loop: of the policy.
        claims: proved metrics by the names of the outputs.
        data: settings of the data set: `ROAD_SETTINGS`, `EXCITATION`, env_low,
            env_high, seed and law.
        level: 1 − δ.
        runs: number of runs of each part.
        duration: of a run [s].
        dwell: range of times between switches [s].
        horizon: preview of the shield [steps].
        attack_steps: number of steps of the search for runs that leave the corridor.
        identified_from: hash of the logs if the plant is a model of logs.

    Raises:
        ValueError: too few runs for the level.
        CertificateContradicted: the attack contradicts a bound.
    """
    began = time.perf_counter()
    # Streams of their own: runs of the data set must not reappear in its certificate.
    stream = partial(jax.random.fold_in, jax.random.key(data["seed"]))
    *run_keys, sensor_key, attack_key = jax.random.split(stream(STREAM), 6)
    drive, drive_s3 = _drivers(loop, data, runs, duration, dwell)
    simulate = jax.jit(partial(simulate_nominal, loop))
    drivers = (drive, drive, drive, drive_s3)
    sensor_keys = jax.random.split(sensor_key, len(drivers))
    units, calibration, test, s3 = (
        _measure(loop, claims, simulate, driver(run_key)[0], key)
        for driver, run_key, key in zip(drivers, run_keys, sensor_keys, strict=True)
    )
    bounds, groups = _bounds_of_groups(
        units.scores, calibration.scores, test.scores, level
    )
    tube = bounds.vehicle_to_nominal_position
    # The shortest dwell: an attack switches as often as the conditions allow.
    dwell_steps = max(1, round(dwell[0] / loop.plant.dt))
    search = WorstRuns(loop, claims["position"], tube, data, dwell_steps, attack_steps)
    observe = partial(_observed, jax.jit(partial(innovations, loop)))
    observers = (partial(observe, drive), partial(observe, drive_s3))
    alarms = calibrate_innovations(*observers, stream(ALARM_STREAM), duration=duration)
    coverages = [group.coverage for group in groups.values()]
    return Corridor(
        conditions=_conditions(loop, data, duration, dwell, identified_from),
        level=level,
        runs=runs,
        bounds=bounds,
        corridor_m=bounds.nominal + tube,
        coverage=min(coverages, key=lambda coverage: coverage.share),
        by_group=groups,
        # Reported beside the claim and no part of it, since S3 does not meet the
        # conditions.
        by_scenario={"s3": corridor_coverage(bounds, s3.scores)},
        seen=test.largest(),
        attack=attack_corridor(search, attack_key, bounds.nominal, horizon),
        innovations=alarms,
        failed_runs=sum(part.failed for part in (units, calibration, test, s3)),
        shield_horizon=horizon,
        margins=law_margins(loop, data),
        seconds=time.perf_counter() - began,
    )


def _conditions(
    loop: Loop,
    data: Mapping[str, Any],
    duration: float,
    dwell: tuple[float, float],
    identified_from: str | None,
) -> Conditions:
    """Return the conditions that the runs of a corridor meet."""
    settings = {name: data[name] for name in (*ROAD_SETTINGS, *EXCITATION)}
    # Pairs of numbers come as lists, from JSON.
    known: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in settings.items()
    }
    return Conditions(
        **known,
        env_box=rows((data["env_low"], data["env_high"])),
        dwell_s=dwell,
        duration_s=duration,
        sensor_noise=loop.noise,
        perturbation=rows(np.asarray(loop.law.perturbation)),
        law_model=data["law"]["model"],
        identified_from=identified_from,
        latency=loop.latency,
    )


def _drivers(
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
    measured = _measure(loop, claims, simulate, runs, jax.random.key(0))
    return measured.scores, measured.lateral


def calibrate_on_runs(
    simulated: Bounds,
    scores: np.ndarray,
    level: float,
    conditions: RecordedConditions,
) -> Recorded:
    """Return the corridor of recorded runs.

    The units are the bounds of simulated runs, which these runs have not made. The
    nominal corridor is not narrower than there, because the shield keeps the width with
    which these runs were driven.

    Args:
        simulated: bounds of the certificate.
        scores: of `scores_of_runs`.
        level: 1 − δ.
        conditions: of the runs.
    """
    units = np.asarray([[getattr(simulated, name) for name in JOINT]])
    joint = conformal_bounds(units, scores[:, : len(JOINT)], level=level)
    by_name = dict(zip(JOINT, joint.tolist(), strict=True))
    by_name["nominal"] = max(by_name["nominal"], simulated.nominal)
    bounds = JointBounds(**by_name)
    return Recorded(
        bounds=bounds,
        corridor_m=bounds.nominal + bounds.vehicle_to_nominal_position,
        level=level,
        conditions=conditions,
    )


def drive_class(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a data set that say which drives a corridor is about."""
    return {name: data[name] for name in ROAD_SETTINGS}


def _bounds_of_groups(
    units: np.ndarray,
    calibration: np.ndarray,
    test: np.ndarray,
    level: float,
) -> tuple[Bounds, dict[str, GroupBounds]]:
    """Return the bounds of the worst group, and bounds and coverage of every group.

    Args:
        units: scores of the runs that fix the units, group after group.
        calibration: of those that set the bounds.
        test: of those on which the coverage is counted.
        level: 1 − δ.
    """
    units_of_groups = np.split(units, len(DRIVES))
    calibration_of_groups = np.split(calibration, len(DRIVES))
    test_of_groups = np.split(test, len(DRIVES))
    bounds_of_groups = {}
    for name, unit_scores, scores in zip(
        DRIVES, units_of_groups, calibration_of_groups, strict=True
    ):
        # Runs in which a simulator failed fix no units.
        finite = unit_scores[np.isfinite(unit_scores[:, 0])]
        bounds_of_groups[name] = calibrate_corridor(finite, scores, level=level)
    worst = {
        name: max(getattr(bounds, name) for bounds in bounds_of_groups.values())
        for name in (*JOINT, *ALONE)
    }
    bounds = Bounds(**worst)
    groups = {
        name: GroupBounds(
            bounds=bounds_of_groups[name], coverage=corridor_coverage(bounds, scores)
        )
        for name, scores in zip(DRIVES, test_of_groups, strict=True)
    }
    return bounds, groups


class _Part(NamedTuple):
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


def _measure(
    loop: Loop,
    claims: Mapping[str, OutputMetric],
    simulate: Callable[..., Any],
    runs: Trajectory,
    key: Key,
) -> _Part:
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
    return _Part(states[:, 1:, BODY][..., LATERAL], nominal, scores)


def _observed(
    innovations_of: Callable[[Reading], Any],
    driver: Driver,
    key: Key,
) -> Any:
    """Return innovations and levels of runs.

    A run in which a simulator failed is replaced by another run.

    Args:
        innovations_of: readings of the law -> innovations and levels; compiled.
        driver: key -> runs.
        key: of the runs; consumed.
    """
    runs, readings = driver(key)
    assert readings is not None
    succeeded = np.isfinite(np.asarray(runs.states)).all(axis=(1, 2))
    count = len(runs.states)
    replacements = np.resize(np.flatnonzero(succeeded), count)
    rows = np.where(succeeded, np.arange(count), replacements)
    return jax.tree.map(lambda leaf: leaf[rows], innovations_of(readings))
