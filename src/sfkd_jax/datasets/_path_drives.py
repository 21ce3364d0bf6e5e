"""Drives of a closed loop in path coordinates: roads, speeds, environments and what a planner may add."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.core.path_frame import is_valid, path_state
from sfkd_jax.core.rollouts import in_batches
from sfkd_jax.datasets._path_excitation import perturbations, profile
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
Admit: TypeAlias = Callable[
    [State, Float[Array, "time 4"], Float[Array, "time environment"]],
    Float[Array, "time 4"],
]
"""(first path state, w, e) -> w: what a filter lets through of the perturbations of a
whole drive.
"""
Sensors: TypeAlias = Callable[[Key, State, Control, Environment], Control]
"""(key, path state, w, e) -> what the law adds to ν because it sees a measurement of
the state.
"""

SWITCHES = (1.5, 6.0)
"""Range of times between switches in the data [s]."""
BURN_IN = 20
"""Steps driven before a drive starts, so that the car is where the law brings it and
not where it was put.
"""
SENSORS = 3
"""Folded into a drive's key, of which road, ν and start take a split each."""
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
    """Independent drives under any ν: a quarter each on S1, on S2, with e held anywhere in E, and under any switching.

    Of the last two a third of every entry of e lies at an end of its range, so that the
    corners of E are driven; switches are `SWITCHES` apart. Roads and ν are those of
    `drive_along_path`.

    Args:
        loop: of `vehicle.along_path`.
        key: consumed.
        segments, steps: how many, how long.
        speed, peak_curvature, wavelengths, lateral_acceleration, steering_excitation,
            speed_excitation: see `drive_along_path`.
        env_low, env_high: E.

    Returns:
        A batch of trajectories, states (segment, steps + 1, 3 + coordinate), controls w
        (segment, steps, 4).
    """
    during = (0.0, steps * loop.dt)
    kinds: list[tuple[Conditions, int]] = [
        (partial(uniform_road, steps=steps, friction=(0.3, 0.9)), segments // 4),
        (
            partial(
                wet_road,
                steps=steps,
                dt=loop.dt,
                before=(0.55, 0.9),
                after=(0.3, 0.5),
                drop_time=during,
            ),
            segments // 4,
        ),
        (partial(held_road, steps=steps, low=env_low, high=env_high), segments // 4),
        (
            partial(
                random_switching,
                steps=steps,
                dt=loop.dt,
                low=env_low,
                high=env_high,
                dwell=SWITCHES,
            ),
            segments - 3 * (segments // 4),
        ),
    ]
    env_key, drive_key = jax.random.split(key)
    envs = [
        jax.vmap(conditions)(
            jax.random.split(jax.random.fold_in(env_key, index), count)
        )
        for index, (conditions, count) in enumerate(kinds)
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
    admit: Admit | None = None,
    sensors: Sensors | None = None,
) -> Trajectory:
    """Drives in environments of one's own, one schedule a drive.

    Speed varies slowly within its range. A third of the roads is one circle, the others
    bend as a sum of three sinusoids; none asks for more than `peak_curvature` or
    `lateral_acceleration`. ν is, drive by drive, what a planner does (an AR(1) process)
    or what nobody should (its sign alone, held for random times: bang-bang), the spread
    drawn log-uniformly and ν held within the limits of the loop.

    Args:
        loop: of `vehicle.along_path`.
        envs: what is met.
        key: consumed.
        speed: range of v_ref [m/s].
        peak_curvature: [1/m].
        wavelengths: of the road [m].
        lateral_acceleration: largest v_ref² |κ| [m/s²].
        steering_excitation: range of the spread of ν_1 [rad].
        speed_excitation: of ν_2 [m/s² or m/s].
        offset: largest e_y [m], e_ψ [rad] and v − v_ref [m/s] at the start.
        burn_in: steps before a drive starts.
        admit: a filter of ν that sees the drive's conditions and not the car; what it
            lets through is w.
        sensors: of the law; what they add to ν is not part of w.
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
        inputs = inputs if admit is None else admit(start, inputs, envs)

        def step(
            state: State, given: tuple[Control, Environment, Key]
        ) -> tuple[State, State]:
            wanted, env, key = given
            seen = (
                wanted
                if sensors is None
                else wanted.at[:2].add(sensors(key, state, wanted, env))
            )
            after = loop.step(state, seen, env)
            return after, after

        _, states = jax.lax.scan(step, start, (inputs, envs, sensor_keys))
        states = jnp.concatenate([start[None], states])
        return Trajectory(states[burn_in:], inputs[burn_in:], envs[burn_in:])

    keys = jax.random.split(key, envs.shape[0])
    return in_batches(one, (envs, keys), size=BATCH)


def generate_s3_along_path(
    loop: Vehicle, key: Key, *, segments: int, steps: int = 50, **options: Any
) -> Trajectory:
    """The same driving under S3's switching, from a random moment of its schedule: never for training.

    Args:
        loop, key, segments, steps: as for `generate_along_path`.
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
    """Drives under any switching in E: levels drawn anew, a third of every entry at an end, held for `dwell` [s].

    Args:
        loop, key: see `drive_along_path`.
        drives, steps: how many, how long.
        env_low, env_high: E.
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
        ValueError: how many came nearer than a fifth of the radius to a centre of
            curvature, or are not finite.
    """
    lateral, curvature = (
        trajectories.states[..., :-1, BODY.start],
        trajectories.controls[..., 2],
    )
    held = jnp.all(is_valid(lateral, curvature), axis=-1) & jnp.all(
        jnp.isfinite(trajectories.states), axis=(-2, -1)
    )
    if not bool(jnp.all(held)):
        lost, total = int(jnp.sum(~held)), held.size
        raise ValueError(
            f"{lost} of {total} drives left their path (1 - kappa e_y <= 0.2): dataset.law does not hold the car"
        )
