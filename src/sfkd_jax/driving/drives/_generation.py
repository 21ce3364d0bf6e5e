"""Simulated runs in the world to learn from, on random roads or without any path."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.drives._schedules import (
    Conditions,
    counts_by_scenario,
    held_out_segments,
    planned_segments,
    schedules_in_world,
)
from sfkd_jax.driving.paths import Path, project, reference_window
from sfkd_jax.driving.plants import Vehicle
from sfkd_jax.driving.scenarios import BOX, family, held_road, smooth_path
from sfkd_jax.ranges import Interval, Positive, Span
from sfkd_jax.rollout import in_batches
from sfkd_jax.types import Key, Scalar, State, Trajectory

Driver: TypeAlias = Callable[
    [State, Float[Array, "horizon 4"]], Float[Array, " control"]
]
"""Maps a state and the next reference points to a control."""

PATHS = partial(
    smooth_path, length=150.0, peak_curvature=0.025, wavelengths=(60.0, 240.0)
)
"""Paths in the world. Their wavelengths differ from those of the benchmark, and their
range of curvature is wider.
"""
SETTLING = 10
"""Steps before a segment in the world, in which slip, yaw rate and steering settle."""
CORRELATION = 0.85
"""Correlation of the excitation with that of the step before."""
BATCH = 500
"""Runs that are simulated at once."""
OPEN_LOOP_EXCITATION = ((0.003, 0.08), (0.1, 1.5))
"""Ranges of the spread of the excitation of both controls in `generate_open_loop`."""


def generate(
    vehicle: Vehicle,
    driver: Driver,
    key: Key,
    *,
    segments: Annotated[int, Interval("[4, inf)")] = 8000,
    steps: int = 50,
    speed: Span = (7.0, 13.0),
    steering_excitation: Span = (0.005, 0.1),
    speed_excitation: Span = (0.1, 1.5),
    held_out: bool = False,
    env_low: tuple[float, ...] = BOX[0],
    env_high: tuple[float, ...] = BOX[1],
) -> Trajectory:
    """Generate independent segments in the world: half of them uniform, half wet.

    A path-following driver keeps the car on a random road, while an AR(1) process
    excites both controls. The spread of the process is drawn log-uniformly for each
    segment, so that the excitation ranges from weak to strong.

    Args:
        vehicle: the plant.
        driver: (state, next reference points) -> control before excitation.
        key: consumed.
        segments: number of them.
        steps: of a segment.
        speed: range of the target speed [m/s].
        steering_excitation: range of the spread of the first control [rad].
        speed_excitation: range of the spread of the second control [m/s² or m/s].
        held_out: whether e follows S3 from a random time on instead, for tests.
        env_low: lower corner of E, which the levels are moved into by `in_box`.
        env_high: upper corner of E.

    Returns:
        A batch of trajectories, states (segment, steps + 1, state). Their scenarios are
        those of `segment_scenarios`.
    """
    excitation = jnp.asarray([steering_excitation, speed_excitation])

    def segment(conditions: Conditions, key: Key) -> Trajectory:
        task = _draw_task(
            vehicle,
            conditions,
            key,
            steps=steps,
            speed=speed,
            excitation=excitation,
        )
        return _follow_path(vehicle, driver, task)

    schedules = schedules_in_world(steps, vehicle.dt, env_low, env_high)
    if held_out:
        planned = held_out_segments(key, schedules, segments)
    else:
        counts = counts_by_scenario(segments, along_path=False)
        planned = planned_segments(key, schedules, counts)
    parts = [
        jax.lax.map(partial(segment, conditions), keys, batch_size=BATCH)
        for conditions, keys in planned
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


class _Task(NamedTuple):
    """What is drawn for a segment in the world before it is driven.

    Attributes:
        path: to follow.
        start: x_0 on the path, before the car settles.
        progress: arc length of the start [m].
        target: speed to hold [m/s].
        envs: of every step, those in which the car settles included.
        spread: of the excitation of both controls.
        white: white noise that the excitation is made of.
    """

    path: Path
    start: State
    progress: Scalar
    target: Scalar
    envs: Float[Array, "time environment"]
    spread: Float[Array, " 2"]
    white: Float[Array, "time 2"]


def _draw_task(
    vehicle: Vehicle,
    conditions: Conditions,
    key: Key,
    *,
    steps: int,
    speed: tuple[float, float],
    excitation: Float[Array, "2 2"],
) -> _Task:
    """Draw path, environment, start and excitation of a segment of `generate`."""
    road_key, speed_key, spread_key, noise_key, start_key, offset_key = (
        jax.random.split(key, 6)
    )
    target = jax.random.uniform(speed_key, (), minval=speed[0], maxval=speed[1])
    size = len(vehicle.state_names)
    scenario = family(conditions, PATHS, speed=10.0, state_size=size)(road_key)
    # The first environment also holds while the car settles.
    settling = jnp.tile(scenario.envs[:1], (SETTLING, 1))
    envs = jnp.concatenate([settling, scenario.envs])
    spread = log_uniform(spread_key, excitation)
    white = jax.random.normal(noise_key, (steps + SETTLING, 2))
    progress = 20.0 * jax.random.uniform(offset_key)
    offset = jax.random.uniform(start_key, (), minval=-1.0, maxval=1.0)
    start = scenario.initial_state.at[3].set(target + offset)
    # `point_at` would round differently, and the data sets of all seeds would change.
    here = reference_window(scenario.path, progress, jnp.zeros(()), dt=0.0, horizon=1)[
        0
    ]
    start = start.at[:3].set(here[:3])
    return _Task(scenario.path, start, progress, target, envs, spread, white)


def _follow_path(vehicle: Vehicle, driver: Driver, task: _Task) -> Trajectory:
    """Drive a segment of `generate`, and return it without the steps of settling."""
    low = jnp.asarray(vehicle.control_low)
    high = jnp.asarray(vehicle.control_high)

    def step(
        carry: tuple[State, Scalar, Array], inputs: tuple[Array, Array]
    ) -> tuple[Any, Any]:
        state, progress, noise = carry
        env, white = inputs
        noise = coloured_noise(noise, task.spread, white)
        ahead = reference_window(
            task.path, progress, task.target, dt=vehicle.dt, horizon=2
        )
        # Clipped after the excitation is added: the model is to learn from the command
        # that was applied.
        control = jnp.clip(driver(vehicle.shown(state), ahead) + noise, low, high)
        after = vehicle.step(state, control, env)
        progress, _ = project(task.path, after[:2], progress + after[3] * vehicle.dt)
        return (after, progress, noise), (vehicle.shown(after), control)

    carry = (vehicle.whole(task.start), task.progress, task.spread * task.white[0])
    _, (states, controls) = jax.lax.scan(step, carry, (task.envs, task.white))
    return Trajectory(
        states=states[SETTLING - 1 :],
        controls=controls[SETTLING:],
        envs=task.envs[SETTLING:],
    )


def generate_open_loop(
    vehicle: Vehicle,
    key: Key,
    *,
    speed: Span,
    lateral_acceleration: Positive,
    tightest: Positive = 0.25,
    segments: int = 4000,
    steps: int = 50,
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
) -> Trajectory:
    """Generate segments without any path or law, to fit a model of the vehicle.

    The steering is about that of a circle, the drive goes from one speed to another,
    and an AR(1) process excites both. e is held, anywhere in E and at its ends.

    Args:
        vehicle: the plant.
        key: consumed.
        speed: range of the speeds [m/s].
        lateral_acceleration: of the tightest circles [m/s²].
        tightest: largest curvature of a circle [1/m].
        segments: number of them.
        steps: of a segment.
        env_low: lower corner of E.
        env_high: upper corner of E.
    """
    low = jnp.asarray(vehicle.control_low)
    high = jnp.asarray(vehicle.control_high)
    # The smallest divisor is below all speeds, also those of a slow vehicle.
    crawl = min(1.0, 0.5 * speed[0])

    def segment(key: Key) -> Trajectory:
        env_key, speed_key, bend_key, spread_key, noise_key = jax.random.split(key, 5)
        env = held_road(env_key, steps=1, low=env_low, high=env_high)[0]
        first_speed, last_speed = jax.random.uniform(
            speed_key, (2,), minval=speed[0], maxval=speed[1]
        )
        # The share is squared: most turns are wide, as on roads, and some are as tight
        # as the axes of a law are long.
        share = jax.random.uniform(bend_key, (), minval=-1.0)
        bend = jnp.minimum(lateral_acceleration / first_speed**2, tightest)
        steering = jnp.arctan(vehicle.wheelbase * share * jnp.abs(share) * bend)
        spread = log_uniform(spread_key, jnp.asarray(OPEN_LOOP_EXCITATION))
        white = jax.random.normal(noise_key, (steps + SETTLING, 2))

        def step(carry: tuple[State, Array], white: Array) -> tuple[Any, Any]:
            state, noise = carry
            noise = coloured_noise(noise, spread, white)
            if vehicle.speed_loop:
                drive = last_speed
            else:
                drive = jnp.clip(0.5 * (last_speed - state[3]), -2.0, 2.0)
            # At a higher speed than at the start the same circle would need more grip.
            slower = jnp.minimum(first_speed / jnp.maximum(state[3], crawl), 1.0) ** 2
            control = jnp.stack([slower * steering, drive]) + noise
            control = jnp.clip(control, low, high)
            after = vehicle.step(state, control, env)
            return (after, noise), (vehicle.shown(after), control)

        start = jnp.zeros(len(vehicle.state_names)).at[3].set(first_speed)
        start = vehicle.whole(start)
        _, (states, controls) = jax.lax.scan(step, (start, spread * white[0]), white)
        return Trajectory(
            states=states[SETTLING - 1 :],
            controls=controls[SETTLING:],
            envs=jnp.tile(env, (steps, 1)),
        )

    return in_batches(jax.vmap(segment), jax.random.split(key, segments), size=BATCH)


def log_uniform(
    key: Key, limits: Float[Array, "channel 2"]
) -> Float[Array, " channel"]:
    """Draw one number per channel, uniform in its logarithm."""
    logs = jnp.log(limits)
    return jnp.exp(
        jax.random.uniform(key, limits.shape[:1], minval=logs[:, 0], maxval=logs[:, 1])
    )


def coloured_noise(noise: Array, spread: float | Array, white: Array) -> Array:
    """Return the next value of an AR(1) process with a given standard deviation.

    Args:
        noise: the value before.
        spread: standard deviation of the process.
        white: white noise of variance 1.
    """
    return CORRELATION * noise + jnp.sqrt(1.0 - CORRELATION**2) * spread * white
