"""Simulated runs of a closed loop in path coordinates, to learn from and to certify."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sfkd_jax.driving.drives._generation import BATCH, coloured_noise, log_uniform
from sfkd_jax.driving.drives._schedules import (
    counts_by_scenario,
    held_out_segments,
    planned_segments,
    schedules_along_path,
)
from sfkd_jax.driving.path_coordinates import (
    CURVATURE,
    LATERAL,
    PERTURBATION,
    PathState,
    is_valid,
)
from sfkd_jax.driving.plants import Vehicle
from sfkd_jax.driving.scenarios import DRIVES, DriveClass, random_drive
from sfkd_jax.geometry import without_pose
from sfkd_jax.ranges import Interval, Span
from sfkd_jax.rollout import in_batches
from sfkd_jax.types import BODY, Control, Environment, Key, State, Trajectory

Range: TypeAlias = tuple[float, float]

BURN_IN = 20
"""Steps before a run along a path, so that its start has no influence."""
SENSORS = 3
"""Number that is folded into a run's key for its sensors. The streams 0 to 2 are those
of road, ν and start, which `split` makes.
"""
BANG_BANG_SHARE = 0.25
"""Share of the runs whose ν jumps between its two values."""


class Reading(NamedTuple):
    """What a controller with imperfect sensors knows at a call, and what it does.

    Attributes:
        measured: ξ that the sensors showed.
        control: u over the period that begins at the time of this measurement.
        road: κ [1/m] and v_ref [m/s] of that period.
        env: e that was known.
    """

    measured: PathState
    control: Control
    road: Float[Array, " 2"]
    env: Environment


class Sensors(NamedTuple):
    """How a law reads the state of its loop: with noise, and late.

    Attributes:
        init: (path state, w, e) at the start -> memory.
        read: (memory, key, path state, w, e) -> (ν with which the exact law would
            apply the same control, what was read, memory).
    """

    init: Callable[[State, Control, Environment], Any]
    read: Callable[
        [Any, Key, State, Control, Environment], tuple[Control, Reading | None, Any]
    ]


def _remember_nothing(state: State, inputs: Control, env: Environment) -> None:
    """Return the memory of exact sensors."""


def _read_exactly(
    memory: Any, key: Key, state: State, inputs: Control, env: Environment
) -> tuple[Float[Array, " 2"], None, Any]:
    """Return ν as it is, and no reading."""
    return inputs[PERTURBATION], None, memory


EXACT = Sensors(_remember_nothing, _read_exactly)
"""Of a law that knows its state."""


def generate_along_path(
    loop: Vehicle,
    key: Key,
    *,
    segments: Annotated[int, Interval("[4, inf)")] = 8000,
    steps: int = 50,
    limits: DriveClass = DriveClass(),  # noqa: B008 never changed
    steering_excitation: Span = (0.002, 0.025),
    speed_excitation: Span = (0.05, 0.6),
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    held_out: bool = False,
) -> Trajectory:
    """Generate independent segments in path coordinates, a quarter of each scenario.

    In the last two quarters every entry of e lies at an end of its range with
    probability 1/3, so that the corners of E are covered. There e switches after times
    drawn from `SWITCHES`. Roads and ν are those of `drive_along_path`.

    Args:
        loop: of `plants.along_path`.
        key: consumed.
        segments: number of them.
        steps: of a segment.
        limits: the class of the drives.
        steering_excitation: range of the spread of ν_1 [rad].
        speed_excitation: range of the spread of ν_2 [m/s² or m/s].
        env_low: lower corner of E.
        env_high: upper corner of E.
        held_out: whether e follows S3 from a random time on instead, for tests.

    Returns:
        A batch of trajectories, states (segment, steps + 1, 3 + coordinate), controls w
        (segment, steps, 4). Their scenarios are those of `segment_scenarios`.
    """
    schedules = schedules_along_path(steps, loop.dt, env_low, env_high)
    env_key, run_key = jax.random.split(key)
    if held_out:
        planned = held_out_segments(env_key, schedules, segments)
    else:
        counts = counts_by_scenario(segments, along_path=True)
        planned = planned_segments(env_key, schedules, counts)
    envs = [jax.vmap(conditions)(keys) for conditions, keys in planned]
    runs, _ = drive_along_path(
        loop,
        jnp.concatenate(envs),
        run_key,
        limits=limits,
        steering_excitation=steering_excitation,
        speed_excitation=speed_excitation,
    )
    return runs


def drive_along_path(
    loop: Vehicle,
    envs: Float[Array, "run time environment"],
    key: Key,
    *,
    limits: DriveClass,
    groups: Int[Array, " run"] | None = None,
    steering_excitation: Range = (0.002, 0.025),
    speed_excitation: Range = (0.05, 0.6),
    offset: tuple[float, float, float] = (0.1, 0.02, 0.5),
    burn_in: int = BURN_IN,
    sensors: Sensors | None = None,
) -> tuple[Trajectory, Reading | None]:
    """Simulate one run in each of the given environments.

    Speed and curvature are those of `random_drive`. ν of a run is an AR(1) process, as
    of a planner, or the sign of one (bang-bang). It has a log-uniform spread and is
    clipped to the limits of the loop.

    Args:
        loop: of `plants.along_path`.
        envs: of the plant.
        key: consumed.
        limits: the class of the drives.
        groups: group of every run, as index into `DRIVES`. By default the groups follow
            one after another.
        steering_excitation: range of the spread of ν_1 [rad].
        speed_excitation: range of the spread of ν_2 [m/s² or m/s].
        offset: largest e_y [m], e_ψ [rad] and v − v_ref [m/s] at the start.
        burn_in: steps simulated before a run starts.
        sensors: that the law reads; None if it knows the state. What they make it do is
            not part of w.

    Returns:
        The runs, and what the law has read at every step, (run, time, …).
    """
    init, read = EXACT if sensors is None else sensors
    spread = jnp.asarray([steering_excitation, speed_excitation])
    drive = partial(random_drive, limits=limits, dt=loop.dt)
    if groups is None:
        groups = jnp.arange(envs.shape[0]) % len(DRIVES)

    def run(inputs: tuple[Array, Key, Array]) -> tuple[Trajectory, Reading | None]:
        run_envs, run_key, group = inputs
        # The first environment also holds during the burn-in.
        run_envs = jnp.concatenate(
            [jnp.repeat(run_envs[:1], burn_in, axis=0), run_envs]
        )
        steps = run_envs.shape[0]
        road_key, nu_key, start_key = jax.random.split(run_key, 3)
        step_keys = jax.random.split(jax.random.fold_in(run_key, SENSORS), steps)
        speeds, curvatures = drive(road_key, group, steps=steps)
        nus = _perturbations(nu_key, steps=steps, spread=spread)
        nus = jnp.clip(
            nus, jnp.asarray(loop.control_low[:2]), jnp.asarray(loop.control_high[:2])
        )
        controls = jnp.concatenate([nus, curvatures[:, None], speeds[:, None]], axis=1)
        beside = jax.random.uniform(start_key, (3,), minval=-1.0) * jnp.asarray(offset)
        # The offset of the speed is relative to the reference speed.
        beside = beside.at[2].add(speeds[0])
        start = without_pose(jnp.zeros(len(loop.state_names) - 3).at[:3].set(beside))

        def step(
            carry: tuple[State, Any], inputs: tuple[Control, Environment, Key]
        ) -> tuple[Any, Any]:
            state, memory = carry
            control, env, step_key = inputs
            shown = loop.shown(state)
            nu, reading, memory = read(memory, step_key, shown, control, env)
            after = loop.step(state, control.at[PERTURBATION].set(nu), env)
            return (after, memory), (loop.shown(after), reading)

        memory = init(start, controls[0], run_envs[0])
        _, (states, readings) = jax.lax.scan(
            step, (loop.whole(start), memory), (controls, run_envs, step_keys)
        )
        states = jnp.concatenate([start[None], states])
        driven = Trajectory(states, controls, run_envs)
        return jax.tree.map(lambda leaf: leaf[burn_in:], (driven, readings))

    keys = jax.random.split(key, envs.shape[0])
    return in_batches(jax.vmap(run), (envs, keys, groups), size=BATCH)


def _perturbations(
    key: Key, *, steps: int, spread: Float[Array, "2 2"]
) -> Float[Array, "time 2"]:
    """Draw ν: an AR(1) process or its sign, with a log-uniform spread per channel."""
    spread_key, white_key, choice_key = jax.random.split(key, 3)
    size = log_uniform(spread_key, spread)
    white = jax.random.normal(white_key, (steps, 2))

    def step(noise: Array, white: Array) -> tuple[Array, Array]:
        noise = coloured_noise(noise, 1.0, white)
        return noise, noise

    _, noise = jax.lax.scan(step, white[0], white)
    # Jumping between the two limits is the worst that a planner may do.
    is_bang_bang = jax.random.uniform(choice_key) < BANG_BANG_SHARE
    return size * jnp.where(is_bang_bang, jnp.sign(noise), noise)


def check_on_path(trajectories: Trajectory) -> None:
    """Refuse runs in path coordinates that left the range where these are meaningful.

    Raises:
        ValueError: at a step of a run 1 − κ e_y ≤ 0.2, or a state is not finite.
    """
    lateral = trajectories.states[..., :-1, BODY][..., LATERAL]
    valid = jnp.all(is_valid(lateral, trajectories.controls[..., CURVATURE]), axis=-1)
    valid &= jnp.all(jnp.isfinite(trajectories.states), axis=(-2, -1))
    if not bool(jnp.all(valid)):
        raise ValueError(
            f"{int(jnp.sum(~valid))} of {valid.size} runs left their path "
            "(1 - kappa e_y <= 0.2): dataset.law does not stabilise the car"
        )
