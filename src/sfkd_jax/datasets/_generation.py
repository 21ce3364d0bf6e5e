"""Segments of driving for training: scenarios S1 and S2 with levels drawn per segment, persistently excited."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.scenarios import (
    Scenario,
    family,
    project,
    reference_window,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.types import Key, Scalar, State, Trajectory
from sfkd_jax.vehicle import Vehicle

Driver: TypeAlias = Callable[
    [State, Float[Array, "horizon 4"]], Float[Array, " control"]
]

BURN_IN = 10
"""Steps driven before a segment starts, so that hidden states (slip, yaw rate,
steering) are on their manifold.
"""
PATH = {"peak_curvature": 0.025, "wavelengths": (60.0, 240.0)}
"""Training geometry: other wavelengths and a wider range of curvature than the
benchmark's paths.
"""


def generate(
    vehicle: Vehicle,
    driver: Driver,
    key: Key,
    *,
    segments: int = 8000,
    steps: int = 50,
    speed: tuple[float, float] = (7.0, 13.0),
    steering_excitation: tuple[float, float] = (0.005, 0.1),
    speed_excitation: tuple[float, float] = (0.1, 1.5),
    fixed_levels: bool = False,
) -> Trajectory:
    """Independent segments, half S1 (uniform road), half S2 (friction drop and gusts), every one its own trajectory.

    A path-following driver keeps the car on a random road while an AR(1) process
    excites both controls; its spread is drawn per segment, log-uniformly, so that quiet
    and violent driving both occur.

    Args:
        vehicle: the plant.
        driver: (state, next reference points) -> control before excitation.
        key: consumed.
        segments, steps: how many, how long.
        speed: range of the target speed [m/s].
        steering_excitation: range of the spread [rad].
        speed_excitation: the same for the second control [m/s² or m/s].
        fixed_levels: draw S1 and S2 at the benchmark's own levels only (the paper's
            literal training set).

    Returns:
        A batch of trajectories, states (segment, steps + 1, state).
    """
    halves = []
    for index, conditions in enumerate(_conditions(steps, vehicle.dt, fixed_levels)):
        count = segments // 2 if index else segments - segments // 2
        drive = partial(_segment, vehicle, driver, conditions, steps, speed)
        drive = partial(drive, jnp.asarray([steering_excitation, speed_excitation]))
        keys = jax.random.split(jax.random.fold_in(key, index), count)
        halves.append(jax.lax.map(drive, keys, batch_size=500))
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *halves)


def generate_switching(
    vehicle: Vehicle,
    driver: Driver,
    key: Key,
    *,
    segments: int,
    steps: int = 50,
    speed: tuple[float, float] = (7.0, 13.0),
    steering_excitation: tuple[float, float] = (0.005, 0.1),
    speed_excitation: tuple[float, float] = (0.1, 1.5),
) -> Trajectory:
    """The same driving under S3's switching, from a random moment of its schedule: never for training.

    Args:
        vehicle, driver, key, segments, steps, speed, steering_excitation,
            speed_excitation: as for `generate`.
    """

    def conditions(key: Key) -> Float[Array, "time 2"]:
        road_key, moment_key = jax.random.split(key)
        schedule = switching_road(road_key, steps=4 * steps, dt=vehicle.dt)
        return jax.lax.dynamic_slice_in_dim(
            schedule, jax.random.randint(moment_key, (), 0, 3 * steps), steps
        )

    drive = partial(_segment, vehicle, driver, conditions, steps, speed)
    drive = partial(drive, jnp.asarray([steering_excitation, speed_excitation]))
    return jax.lax.map(drive, jax.random.split(key, segments), batch_size=500)


def _conditions(steps: int, dt: float, fixed: bool) -> list[Callable[[Key], Array]]:
    """Schedules of S1 and S2 for training; the friction drop falls anywhere in the segment."""
    during = (0.0, steps * dt)
    if fixed:
        return [
            partial(uniform_road, steps=steps),
            partial(wet_road, steps=steps, dt=dt, drop_time=during),
        ]
    return [
        partial(uniform_road, steps=steps, friction=(0.3, 0.9)),
        partial(
            wet_road,
            steps=steps,
            dt=dt,
            before=(0.55, 0.9),
            after=(0.3, 0.5),
            drop_time=during,
        ),
    ]


def _segment(
    vehicle: Vehicle,
    driver: Driver,
    conditions: Callable[[Key], Array],
    steps: int,
    speed_range: tuple[float, float],
    excitation: Float[Array, "control 2"],
    key: Key,
) -> Trajectory:
    """One segment; its first environment also holds during the burn-in."""
    road_key, speed_key, spread_key, noise_key, start_key, place_key = jax.random.split(
        key, 6
    )
    speed = jax.random.uniform(
        speed_key, (), minval=speed_range[0], maxval=speed_range[1]
    )
    sample = family(
        conditions,
        length=150.0,
        speed=10.0,
        state_size=len(vehicle.state_names),
        **PATH,
    )
    scenario: Scenario = sample(road_key)._replace(speed=speed)
    logs = jnp.log(excitation)
    spread = jnp.exp(
        jax.random.uniform(spread_key, (2,), minval=logs[:, 0], maxval=logs[:, 1])
    )
    offset = jax.random.uniform(start_key, (), minval=-1.0, maxval=1.0)
    initial = scenario.initial_state.at[3].set(speed + offset)
    envs = jnp.concatenate([jnp.tile(scenario.envs[:1], (BURN_IN, 1)), scenario.envs])
    low, high = jnp.asarray(vehicle.control_low), jnp.asarray(vehicle.control_high)
    white = jax.random.normal(noise_key, (steps + BURN_IN, 2))

    def step(
        carry: tuple[State, Scalar, Array], inputs: tuple[Array, Array]
    ) -> tuple[Any, Any]:
        state, progress, noise = carry
        env, fresh = inputs
        noise = 0.85 * noise + jnp.sqrt(1.0 - 0.85**2) * spread * fresh
        reference = reference_window(
            scenario.path, progress, speed, dt=vehicle.dt, horizon=2
        )
        control = jnp.clip(driver(state, reference) + noise, low, high)
        after = vehicle.step(state, control, env)
        progress, _ = project(
            scenario.path, after[:2], progress + after[3] * vehicle.dt
        )
        return (after, progress, noise), (after, control)

    start = (
        initial,
        jnp.full((), 20.0 * jax.random.uniform(place_key)),
        spread * white[0],
    )
    start = (_on_path(scenario, start[1], initial), start[1], start[2])
    _, (states, controls) = jax.lax.scan(step, start, (envs, white))
    return Trajectory(states[BURN_IN - 1 :], controls[BURN_IN:], envs[BURN_IN:])


def _on_path(scenario: Scenario, progress: Scalar, state: State) -> State:
    """The state placed on the path at `progress`."""
    point = reference_window(scenario.path, progress, jnp.zeros(()), dt=0.0, horizon=1)[
        0
    ]
    return state.at[:3].set(point[:3])
