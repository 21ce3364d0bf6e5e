"""Generate segments of a closed loop along paths, by scenario."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.data._path_drives import drive_along_path
from sfkd_jax.data._splits import scenario_labels
from sfkd_jax.plants import Vehicle
from sfkd_jax.ranges import Interval, Positive, Span
from sfkd_jax.scenarios import (
    held_road,
    random_switching,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.types import Environment, Key, Trajectory

Conditions: TypeAlias = Callable[[Key], Float[Array, "time environment"]]

SWITCHES = (1.5, 6.0)
"""Range of times between switches in the data [s]."""


def generate_along_path(
    loop: Vehicle,
    key: Key,
    *,
    segments: Annotated[int, Interval("[4, inf)")] = 8000,
    steps: int = 50,
    speed: Span = (8.0, 10.5),
    peak_curvature: Positive = 0.02,
    wavelengths: Span = (50.0, 200.0),
    lateral_acceleration: Positive = 2.0,
    steering_excitation: Span = (0.002, 0.025),
    speed_excitation: Span = (0.05, 0.6),
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
) -> Trajectory:
    """Generate independent drives: a quarter each of S1, S2, held e and switching e.

    In the last two quarters a third of every entry of e lies at an end of its range, so
    that the corners of E are covered; switches are `SWITCHES` apart. Roads and ν are
    those of `drive_along_path`.

    Args:
        loop: of `vehicle.along_path`.
        key: consumed.
        segments: their number.
        steps: of a segment.
        speed: see `drive_along_path`.
        peak_curvature: see there.
        wavelengths: see there.
        lateral_acceleration: see there.
        steering_excitation: see there.
        speed_excitation: see there.
        env_low: lower corner of E.
        env_high: upper corner of E.

    Returns:
        A batch of trajectories, states (segment, steps + 1, 3 + coordinate), controls w
        (segment, steps, 4); their scenarios are those of
        `segment_scenarios_along_path`.
    """
    schedules = _conditions(steps, loop.dt, (env_low, env_high))
    counts = _counts(segments)
    env_key, drive_key = jax.random.split(key)
    envs = [
        jax.vmap(schedules[name])(
            jax.random.split(jax.random.fold_in(env_key, index), count)
        )
        for index, (name, count) in enumerate(counts.items())
    ]
    return drive_along_path(
        loop,
        jnp.concatenate(envs),
        drive_key,
        speed=speed,
        peak_curvature=peak_curvature,
        wavelengths=wavelengths,
        lateral_acceleration=lateral_acceleration,
        steering_excitation=steering_excitation,
        speed_excitation=speed_excitation,
    )


def segment_scenarios_along_path(segments: int) -> Int[np.ndarray, " segment"]:
    """Return the scenario of every segment of `generate_along_path`."""
    return scenario_labels(_counts(segments))


def _counts(segments: int) -> dict[str, int]:
    """Number of segments by scenario, in the order in which they are generated."""
    quarter = segments // 4
    return {
        "s1": quarter,
        "s2": quarter,
        "held": quarter,
        "switching": segments - 3 * quarter,
    }


def _conditions(
    steps: int, dt: float, box: tuple[tuple[float, ...], tuple[float, ...]]
) -> dict[str, Conditions]:
    """Schedules of e by scenario."""
    low, high = box
    return {
        "s1": partial(uniform_road, steps=steps, friction=(0.3, 0.9)),
        "s2": partial(
            wet_road,
            steps=steps,
            dt=dt,
            before=(0.55, 0.9),
            after=(0.3, 0.5),
            drop_time=(0.0, steps * dt),
        ),
        "held": partial(held_road, steps=steps, low=low, high=high),
        "switching": partial(
            random_switching, steps=steps, dt=dt, low=low, high=high, dwell=SWITCHES
        ),
    }


def generate_s3_along_path(
    loop: Vehicle, key: Key, *, segments: int, steps: int = 50, **options: Any
) -> Trajectory:
    """Generate drives of S3's switching, from a random time of its schedule.

    They are for tests, never for training.

    Args:
        loop: of `vehicle.along_path`.
        key: consumed.
        segments: their number.
        steps: of a segment.
        options: of `drive_along_path`.
    """

    def conditions(key: Key) -> Float[Array, "time 2"]:
        road_key, moment_key = jax.random.split(key)
        schedule = switching_road(road_key, steps=4 * steps, dt=loop.dt)
        return jax.lax.dynamic_slice_in_dim(
            schedule, jax.random.randint(moment_key, (), 0, 3 * steps), steps
        )

    env_key, drive_key = jax.random.split(key)
    envs = jax.vmap(conditions)(jax.random.split(env_key, segments))
    return drive_along_path(loop, envs, drive_key, **options)


def drive_switching(
    loop: Vehicle,
    key: Key,
    *,
    drives: int,
    steps: int,
    env_low: tuple[float, ...] | Environment,
    env_high: tuple[float, ...] | Environment,
    dwell: tuple[float, float] = (3.0, 6.0),
    **options: Any,
) -> Trajectory:
    """Generate drives with e switching anywhere in E, as `random_switching` draws it.

    Args:
        loop: see `drive_along_path`.
        key: consumed.
        drives: their number.
        steps: of a drive.
        env_low: lower corner of E.
        env_high: upper corner of E.
        dwell: range of the times between switches [s].
        options: of `drive_along_path`.
    """
    env_key, drive_key = jax.random.split(key)
    conditions = partial(
        random_switching,
        steps=steps,
        dt=loop.dt,
        low=env_low,
        high=env_high,
        dwell=dwell,
    )
    envs = jax.vmap(conditions)(jax.random.split(env_key, drives))
    return drive_along_path(loop, envs, drive_key, **options)
