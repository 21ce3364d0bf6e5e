"""Generate segments of a closed loop along paths, under perturbations ν."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.data._generation import (
    Conditions,
    benchmark_roads,
    from_switching,
    log_uniform,
)
from sfkd_jax.data._splits import scenario_labels
from sfkd_jax.geometry import path_state
from sfkd_jax.plants import Vehicle
from sfkd_jax.ranges import Interval, Positive, Span
from sfkd_jax.rollout import in_batches
from sfkd_jax.scenarios import held_road, random_switching
from sfkd_jax.types import Control, Environment, Key, Scalar, State, Trajectory

SafetyFilter: TypeAlias = Callable[
    [State, Float[Array, "time 4"], Float[Array, "time environment"]],
    Float[Array, "time 4"],
]
"""(first path state, w, e) -> w of a whole drive, with ν replaced by admissible ν."""
Sensors: TypeAlias = Callable[[Key, State, Control, Environment], Control]
"""(key, path state, w, e) -> what the law adds to ν because its sensors are noisy."""

BURN_IN = 20
"""Steps simulated before a drive starts, so that the start has no influence."""
SENSORS = 3
"""Folded into a drive's key, which is also split for road, ν and start."""
BATCH = 500
"""Drives simulated at once."""
SWITCHES = (1.5, 6.0)
"""Range of times between switches in the data [s]."""


def drive_along_path(
    loop: Vehicle,
    envs: Float[Array, "drive time environment"],
    key: Key,
    *,
    speed: tuple[float | Scalar, float | Scalar] = (8.0, 10.5),
    peak_curvature: float = 0.02,
    wavelengths: tuple[float, float] = (50.0, 200.0),
    lateral_acceleration: float = 2.0,
    steering_excitation: tuple[float, float] = (0.002, 0.025),
    speed_excitation: tuple[float, float] = (0.05, 0.6),
    offset: tuple[float, float, float] = (0.1, 0.02, 0.5),
    burn_in: int = BURN_IN,
    safety_filter: SafetyFilter | None = None,
    sensors: Sensors | None = None,
) -> Trajectory:
    """Simulate drives in given environments, one schedule per drive.

    The speed varies slowly within its range. A third of the roads are circles, the
    curvature of the others is a sum of three sinusoids; none exceeds `peak_curvature`
    or `lateral_acceleration`. ν of a drive is an AR(1) process, as of a planner, or its
    sign (bang-bang), with a log-uniform spread, clipped to the limits of the loop.

    Args:
        loop: of `vehicle.along_path`.
        envs: of the plant.
        key: consumed.
        speed: range of v_ref [m/s].
        peak_curvature: [1/m].
        wavelengths: of the road [m].
        lateral_acceleration: largest v_ref² |κ| [m/s²].
        steering_excitation: range of the spread of ν_1 [rad].
        speed_excitation: of ν_2 [m/s² or m/s].
        offset: largest e_y [m], e_ψ [rad] and v − v_ref [m/s] at the start.
        burn_in: steps simulated before a drive starts.
        safety_filter: replaces ν by admissible ν; sees the drive's conditions, not the
            car.
        sensors: noise of the law's sensors; it is not part of w.
    """
    limits = jnp.asarray([steering_excitation, speed_excitation])
    road = partial(
        _profile,
        dt=loop.dt,
        speed=speed,
        peak=peak_curvature,
        wavelengths=wavelengths,
        most=lateral_acceleration,
    )

    def one(given: tuple[Array, Key]) -> Trajectory:
        envs = jnp.concatenate([jnp.repeat(given[0][:1], burn_in, axis=0), given[0]])
        road_key, nu_key, start_key = jax.random.split(given[1], 3)
        sensor_keys = jax.random.split(
            jax.random.fold_in(given[1], SENSORS), envs.shape[0]
        )
        speeds, curvatures = road(road_key, steps=envs.shape[0])
        nus = _perturbations(nu_key, steps=envs.shape[0], spread=limits)
        nus = jnp.clip(
            nus, jnp.asarray(loop.control_low[:2]), jnp.asarray(loop.control_high[:2])
        )
        inputs = jnp.concatenate([nus, curvatures[:, None], speeds[:, None]], axis=1)
        beside = jax.random.uniform(start_key, (3,), minval=-1.0) * jnp.asarray(offset)
        start = path_state(
            jnp.zeros(len(loop.state_names) - 3).at[:3].set(beside.at[2].add(speeds[0]))
        )
        inputs = inputs if safety_filter is None else safety_filter(start, inputs, envs)

        def step(
            state: State, given: tuple[Control, Environment, Key]
        ) -> tuple[State, State]:
            inputs, env, key = given
            if sensors is not None:
                inputs = inputs.at[:2].add(sensors(key, state, inputs, env))
            after = loop.step(state, inputs, env)
            return after, after

        _, states = jax.lax.scan(step, start, (inputs, envs, sensor_keys))
        states = jnp.concatenate([start[None], states])
        return Trajectory(states[burn_in:], inputs[burn_in:], envs[burn_in:])

    keys = jax.random.split(key, envs.shape[0])
    return in_batches(one, (envs, keys), size=BATCH)


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
    return benchmark_roads(steps, dt) | {
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
    conditions = from_switching(steps, loop.dt)
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


def _profile(
    key: Key,
    *,
    steps: int,
    dt: float,
    speed: tuple[float | Scalar, float | Scalar],
    peak: float,
    wavelengths: tuple[float, float],
    most: float,
) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
    """Draw v_ref [m/s] and κ [1/m] at every step."""
    level_key, swing_key, wave_key, phase_key, size_key, kind_key, circle_key = (
        jax.random.split(key, 7)
    )
    level = jax.random.uniform(level_key, (), minval=speed[0], maxval=speed[1])
    swing, period, begins = jax.random.uniform(swing_key, (3,))
    time = jnp.arange(steps) * dt
    speeds = level + 0.8 * swing * jnp.sin(
        2 * jnp.pi * (time / (5.0 + 15.0 * period) + begins)
    )
    speeds = jnp.clip(speeds, *speed)
    waves = jax.random.uniform(
        wave_key, (3, 1), minval=wavelengths[0], maxval=wavelengths[1]
    )
    phases = jax.random.uniform(phase_key, (3, 1), maxval=2 * jnp.pi)
    along = jnp.cumsum(speeds) * dt
    bends = jnp.mean(jnp.sin(2 * jnp.pi * along / waves + phases), axis=0)
    # Three sinusoids seldom peak together: twice their mean, clipped, stays at the
    # extremes for a while as well.
    bends = jnp.sqrt(jax.random.uniform(size_key)) * jnp.clip(2.0 * bends, -1.0, 1.0)
    circle = jnp.clip(
        jax.random.uniform(circle_key, minval=-1.5, maxval=1.5), -1.0, 1.0
    )
    wanted = peak * jnp.where(jax.random.uniform(kind_key) < 1.0 / 3.0, circle, bends)
    tightest = jnp.minimum(peak, most / speeds**2)
    return speeds, jnp.clip(wanted, -tightest, tightest)


def _perturbations(
    key: Key, *, steps: int, spread: Float[Array, "2 2"]
) -> Float[Array, "time 2"]:
    """Draw ν: an AR(1) process or its sign, its spread log-uniform per channel."""
    spread_key, white_key, kind_key = jax.random.split(key, 3)
    size = log_uniform(spread_key, spread)
    white = jax.random.normal(white_key, (steps, 2))

    def follow(noise: Array, fresh: Array) -> tuple[Array, Array]:
        noise = 0.85 * noise + jnp.sqrt(1.0 - 0.85**2) * fresh
        return noise, noise

    noise = jax.lax.scan(follow, white[0], white)[1]
    bang = jax.random.uniform(kind_key) < 0.25
    return size * jnp.where(bang, jnp.sign(noise), noise)
