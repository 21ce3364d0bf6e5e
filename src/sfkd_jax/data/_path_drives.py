"""Simulate a closed loop along paths under perturbations ν."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.data._path_excitation import perturbations, profile
from sfkd_jax.geometry import is_valid, path_state
from sfkd_jax.plants import Vehicle
from sfkd_jax.rollout import in_batches
from sfkd_jax.types import BODY, Control, Environment, Key, Scalar, State, Trajectory

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
