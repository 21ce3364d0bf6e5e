"""The corridor of a closed loop: calibrated on whole runs, tested and attacked.

The runs are those of the conditions that a certificate states: e switches in its box
with at least the dwell time, roads and perturbations ν are those of the data set, and
the law reads the state through the sensors. The bounds are measured on these runs; only
α, L and P behind them are proved.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal

import jax
import numpy as np

from sfkd_jax.certificate import Coverage, OutputMetric
from sfkd_jax.certification import (
    conformal_bounds,
    rows,
)
from sfkd_jax.driving.certificate import (
    Bounds,
    Conditions,
    Corridor,
    GroupBounds,
    Innovations,
    JointBounds,
    LateCorridor,
    Recorded,
    RecordedConditions,
)
from sfkd_jax.driving.corridor._alarms import (
    Observed,
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
from sfkd_jax.driving.corridor._closed_loop import Loop
from sfkd_jax.driving.corridor._margins import law_margins
from sfkd_jax.driving.corridor._runs import (
    EXCITATION,
    LATE_PARTS,
    ROAD_SETTINGS,
    Driver,
    Part,
    drivers_of,
    measure_runs,
    simulated_steps,
    steps_of_part,
)
from sfkd_jax.driving.corridor._worst_runs import WorstRuns, attack_corridor
from sfkd_jax.driving.drives import Reading
from sfkd_jax.driving.scenarios import DRIVES
from sfkd_jax.latency import Delays
from sfkd_jax.progress import Progress
from sfkd_jax.ranges import Interval, Span
from sfkd_jax.types import Key, Trajectory

STREAM = 4
"""Number that is folded into the data set's seed for the corridor. The data set itself
uses the streams 0 to 2.
"""
ALARM_STREAM = 5
"""The same for the test of innovations."""
LATE_STREAM = 6
"""The same for the corridors of vehicles that are later than stated."""


def _counted(progress: Progress, steps: int, driver: Driver) -> Driver:
    """Return a driver that counts the steps of the vehicle in its runs."""

    def driven(key: Key) -> tuple[Trajectory, Reading | None]:
        made = jax.block_until_ready(driver(key))
        progress.advance(steps)
        return made

    return driven


def _measure_parts(
    loop: Loop,
    claims: Mapping[str, OutputMetric],
    drivers: tuple[Driver, ...],
    run_keys: list[Key],
    sensor_key: Key,
) -> list[Part]:
    """Measure runs for units, bounds and coverage, and those of S3.

    Args:
        loop: of the policy.
        claims: proved metrics by the names of the outputs.
        drivers: under the conditions, and on S3.
        run_keys: of the runs of each part; consumed.
        sensor_key: of what the nominal models start from; consumed.
    """
    simulate = jax.jit(partial(simulate_nominal, loop))
    drive, drive_s3 = drivers
    sensor_keys = jax.random.split(sensor_key, len(run_keys))
    return [
        measure_runs(loop, claims, simulate, driver(run_key)[0], key)
        for driver, run_key, key in zip(
            (drive, drive, drive, drive_s3), run_keys, sensor_keys, strict=True
        )
    ]


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
    later: Delays = (),
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
        later: delays beyond the latency of the loop, for each of which the corridor is
            measured as well [s].
        identified_from: hash of the logs if the plant is a model of logs.

    Raises:
        ValueError: too few runs for the level.
        CertificateContradicted: the attack contradicts a bound.
    """
    began = time.perf_counter()
    # Streams of their own: runs of the data set must not reappear in its certificate.
    stream = partial(jax.random.fold_in, jax.random.key(data["seed"]))
    *run_keys, sensor_key, attack_key = jax.random.split(stream(STREAM), 6)
    of_part = steps_of_part(loop.plant.dt, runs, duration)
    total = simulated_steps(loop.plant.dt, runs, duration, attack_steps, later)
    with Progress("steps of the vehicle", total) as progress:

        def drivers_of_loop(loop: Loop) -> tuple[Driver, ...]:
            counted = partial(_counted, progress, of_part)
            return tuple(map(counted, drivers_of(loop, data, runs, duration, dwell)))

        drivers = drivers_of_loop(loop)
        measured = _measure_parts(loop, claims, drivers, run_keys, sensor_key)
        *known, s3 = measured
        bounds, groups = _bounds_of_groups([part.scores for part in known], level)
        tube = bounds.vehicle_to_nominal_position
        # The shortest dwell: an attack switches as often as the conditions allow.
        shortest = max(1, round(dwell[0] / loop.plant.dt))
        search = WorstRuns(loop, claims["position"], tube, data, shortest, attack_steps)
        alarms = _alarms(loop, drivers, stream(ALARM_STREAM), duration)
        attack = attack_corridor(search, attack_key, bounds.nominal, horizon)
        progress.advance(attack_steps)
        late = partial(_late_corridors, loop, later, claims, level, drivers_of_loop)
        late_sensors = late("sensors", stream(LATE_STREAM))
        late_controls = late("controls", stream(LATE_STREAM))
    return Corridor(
        conditions=_conditions(loop, data, duration, dwell, identified_from),
        level=level,
        runs=runs,
        bounds=bounds,
        corridor_m=bounds.nominal + tube,
        coverage=_coverage_of_worst(groups),
        by_group=groups,
        # No part of the claim, since S3 does not meet the conditions.
        by_scenario={"s3": corridor_coverage(bounds, s3.scores)},
        seen=known[-1].largest(),
        attack=attack,
        innovations=alarms,
        failed_runs=sum(part.failed for part in measured),
        shield_horizon=horizon,
        margins=law_margins(loop, data),
        late_sensors=late_sensors,
        late_controls=late_controls,
        seconds=time.perf_counter() - began,
    )


def _late_corridors(
    loop: Loop,
    delays: Delays,
    claims: Mapping[str, OutputMetric],
    level: float,
    drivers: Callable[[Loop], tuple[Driver, ...]],
    late: Literal["sensors", "controls"],
    key: Key,
) -> tuple[LateCorridor, ...]:
    """Return the corridors of a loop that is later, and compensates it.

    Args:
        loop: of the policy.
        delays: in addition to the latency of the loop [s].
        claims: proved metrics by the names of the outputs.
        level: 1 − δ.
        drivers: loop -> its drivers under the conditions, and on S3.
        late: what is later.
        key: used anew for every delay, so that all meet the same roads; consumed.
    """
    corridors = []
    for delay in sorted(delays):
        longer = tuple(delay + one for one in getattr(loop.latency, late))
        later = loop._replace(latency=replace(loop.latency, **{late: longer}))
        driver, _ = drivers(later)
        simulate = jax.jit(partial(simulate_nominal, later))
        scores = []
        for part in range(LATE_PARTS):
            run_key, sensor_key = jax.random.split(jax.random.fold_in(key, part))
            runs, _ = driver(run_key)
            measured = measure_runs(later, claims, simulate, runs, sensor_key)
            scores.append(measured.scores)
        bounds, groups = _bounds_of_groups(scores, level)
        corridors.append(
            LateCorridor(
                later_s=delay,
                bounds=JointBounds(**{name: getattr(bounds, name) for name in JOINT}),
                coverage=_coverage_of_worst(groups),
            )
        )
    return tuple(corridors)


def _coverage_of_worst(groups: Mapping[str, GroupBounds]) -> Coverage:
    """Return the coverage of the group whose runs leave the bounds most often."""
    coverages = [group.coverage for group in groups.values()]
    return min(coverages, key=lambda coverage: coverage.share)


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


def _bounds_of_groups(
    scores: list[np.ndarray], level: float
) -> tuple[Bounds, dict[str, GroupBounds]]:
    """Return the bounds of the worst group, and bounds and coverage of every group.

    Args:
        scores: of the runs that fix the units, of those that set the bounds, and of
            those on which the coverage is counted; each group after group.
        level: 1 − δ.
    """
    units, calibration, test = scores
    units_of_groups = np.split(units, len(DRIVES))
    calibration_of_groups = np.split(calibration, len(DRIVES))
    test_of_groups = np.split(test, len(DRIVES))
    bounds_of_groups = {}
    for name, unit_scores, run_scores in zip(
        DRIVES, units_of_groups, calibration_of_groups, strict=True
    ):
        # Runs in which a simulator failed fix no units.
        finite = unit_scores[np.isfinite(unit_scores[:, 0])]
        bounds_of_groups[name] = calibrate_corridor(finite, run_scores, level=level)
    worst = {
        name: max(getattr(bounds, name) for bounds in bounds_of_groups.values())
        for name in (*JOINT, *ALONE)
    }
    bounds = Bounds(**worst)
    groups = {
        name: GroupBounds(
            bounds=bounds_of_groups[name],
            coverage=corridor_coverage(bounds, run_scores),
        )
        for name, run_scores in zip(DRIVES, test_of_groups, strict=True)
    }
    return bounds, groups


def _alarms(
    loop: Loop, drivers: tuple[Driver, ...], key: Key, duration: float
) -> Innovations:
    """Return the calibration of the alarms of a loop.

    Args:
        loop: of the policy.
        drivers: under the conditions, and on S3.
        key: of the runs; consumed.
        duration: of a run [s].
    """
    compiled = jax.jit(partial(innovations, loop))
    observe, observe_s3 = (partial(_observed, compiled, driver) for driver in drivers)
    return calibrate_innovations(observe, observe_s3, key, duration)


def _observed(
    innovations_of: Callable[[Reading], Any],
    driver: Driver,
    key: Key,
) -> Observed:
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
