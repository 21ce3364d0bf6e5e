"""Generate drives of a closed loop in path coordinates under perturbations ν."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.core.path_frame import is_valid, path_state
from sfkd_jax.core.rollouts import in_batches
from sfkd_jax.datasets._path_excitation import perturbations, profile
from sfkd_jax.datasets._splits import scenario_labels
from sfkd_jax.scenarios import (
    held_road,
    random_switching,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.types import BODY, Control, Environment, Key, Scalar, State, Trajectory
from sfkd_jax.vehicle import Vehicle

Conditions: TypeAlias = Callable[[Key], Float[Array, "time environment"]]
SafetyFilter: TypeAlias = Callable[
    [State, Float[Array, "time 4"], Float[Array, "time environment"]],
    Float[Array, "time 4"],
]
"""(first path state, w, e) -> w of a whole drive, with ν replaced by admissible ν."""
Sensors: TypeAlias = Callable[[Key, State, Control, Environment], Control]
"""(key, path state, w, e) -> what the law adds to ν because its sensors are noisy."""

SWITCHES = (1.5, 6.0)
"""Range of times between switches in the data [s]."""
BURN_IN = 20
"""Steps simulated before a drive starts, so that the start has no influence."""
SENSORS = 3
"""Folded into a drive's key, which is also split for road, ν and start."""
BATCH = 500
"""Drives simulated at once."""


def generate_along_path(
    loop: Vehicle,
    key: Key,
    *,
    segments: int = 8000,
    steps: int = 50,
    speed: tuple[float, float] = (8.0, 10.5),
    peak_curvature: float = 0.02,
    wavelengths: tuple[float, float] = (50.0, 200.0),
    lateral_acceleration: float = 2.0,
    steering_excitation: tuple[float, float] = (0.002, 0.025),
    speed_excitation: tuple[float, float] = (0.05, 0.6),
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
    """Generate drives in given environments, one schedule per drive.

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
        profile,
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
        nus = perturbations(nu_key, steps=envs.shape[0], spread=limits)
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


def check_on_path(trajectories: Trajectory) -> None:
    """Refuse drives that left their path.

    Raises:
        ValueError: the number of drives with 1 − κ e_y ≤ 0.2 or states that are not
            finite.
    """
    lateral, curvature = (
        trajectories.states[..., :-1, BODY.start],
        trajectories.controls[..., 2],
    )
    valid = jnp.all(is_valid(lateral, curvature), axis=-1) & jnp.all(
        jnp.isfinite(trajectories.states), axis=(-2, -1)
    )
    if not bool(jnp.all(valid)):
        lost, total = int(jnp.sum(~valid)), valid.size
        raise ValueError(
            f"{lost} of {total} drives left their path (1 - kappa e_y <= 0.2): "
            "dataset.law does not stabilise the car"
        )
