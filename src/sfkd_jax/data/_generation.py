"""Simulated runs to learn from: random roads, environments and excited commands."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.geometry import path_state
from sfkd_jax.plants import Vehicle
from sfkd_jax.ranges import Interval, Positive, Span
from sfkd_jax.rollout import in_batches
from sfkd_jax.scenarios import (
    BOX,
    DRIVES,
    DriveClass,
    family,
    held_road,
    in_box,
    project,
    random_drive,
    random_switching,
    reference_window,
    smooth_path,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.types import Control, Environment, Key, Scalar, State, Trajectory

Driver: TypeAlias = Callable[
    [State, Float[Array, "horizon 4"]], Float[Array, " control"]
]
Conditions: TypeAlias = Callable[[Key], Float[Array, "time environment"]]
Sensors: TypeAlias = Callable[[Key, State, Control, Environment], Control]
"""(key, path state, w, e) -> what the law adds to ν because its sensors are noisy."""
Range: TypeAlias = tuple[float, float]

SCENARIOS = ("uniform", "wet", "held", "switching")
"""Environments of generated segments: a uniform road, friction that drops under gusts,
e held anywhere in E, and e switching anywhere in E. Their levels are drawn; those of
the benchmark are `scenarios.ROADS`.
"""
WET = {"before": (0.55, 0.9), "after": (0.3, 0.5)}
"""Friction of a wet road, before and after it drops."""
SWITCHES = (1.5, 6.0)
"""Range of times between switches [s]."""
PATHS = partial(
    smooth_path, length=150.0, peak_curvature=0.025, wavelengths=(60.0, 240.0)
)
"""Paths in the world: other wavelengths and a wider range of curvature than those of
the benchmark.
"""
SETTLING = 10
"""Steps before a segment in the world, so that slip, yaw rate and steering settle."""
BURN_IN = 20
"""Steps before a run along a path, so that its start has no influence."""
CORRELATION = 0.85
"""Of the excitation with that of the step before."""
BATCH = 500
"""Runs simulated at once."""
SENSORS = 3
"""Folded into a run's key, which is also split for road, ν and start."""


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

    A path-following driver keeps the car on a random road while an AR(1) process
    excites both controls. Its spread is drawn log-uniformly per segment, so that the
    excitation ranges from weak to strong.

    Args:
        vehicle: the plant.
        driver: (state, next reference points) -> control before excitation.
        key: consumed.
        speed: range of the target speed [m/s].
        steering_excitation: range of the spread [rad].
        speed_excitation: the same for the second control [m/s² or m/s].
        held_out: whether e follows S3 from a random time instead, for tests.
        env_low: lower corner of E, which the levels are moved into by `in_box`.
        env_high: upper corner of E.

    Returns:
        A batch of trajectories, states (segment, steps + 1, state); their scenarios are
        those of `segment_scenarios`.
    """
    excitation = jnp.asarray([steering_excitation, speed_excitation])
    low = jnp.asarray(vehicle.control_low)
    high = jnp.asarray(vehicle.control_high)

    def one(conditions: Conditions, key: Key) -> Trajectory:
        road_key, speed_key, spread_key, noise_key, start_key, offset_key = (
            jax.random.split(key, 6)
        )
        target = jax.random.uniform(speed_key, (), minval=speed[0], maxval=speed[1])
        size = len(vehicle.state_names)
        scenario = family(conditions, PATHS, speed=10.0, state_size=size)(road_key)
        path = scenario.path
        # The first environment also holds while the car settles.
        settling = jnp.tile(scenario.envs[:1], (SETTLING, 1))
        envs = jnp.concatenate([settling, scenario.envs])
        spread = _log_uniform(spread_key, excitation)
        white = jax.random.normal(noise_key, (steps + SETTLING, 2))

        def step(
            carry: tuple[State, Scalar, Array], inputs: tuple[Array, Array]
        ) -> tuple[Any, Any]:
            state, progress, noise = carry
            env, fresh = inputs
            noise = _coloured(noise, spread, fresh)
            ahead = reference_window(path, progress, target, dt=vehicle.dt, horizon=2)
            # Clipped after the excitation: the model learns the command that was
            # applied.
            control = jnp.clip(driver(state, ahead) + noise, low, high)
            after = vehicle.step(state, control, env)
            progress, _ = project(path, after[:2], progress + after[3] * vehicle.dt)
            return (after, progress, noise), (after, control)

        progress = 20.0 * jax.random.uniform(offset_key)
        offset = jax.random.uniform(start_key, (), minval=-1.0, maxval=1.0)
        start = scenario.initial_state.at[3].set(target + offset)
        # By a window, whose rounding is part of every data set of a seed.
        here = reference_window(path, progress, jnp.zeros(()), dt=0.0, horizon=1)[0]
        start = start.at[:3].set(here[:3])
        carry = start, progress, spread * white[0]
        _, (states, controls) = jax.lax.scan(step, carry, (envs, white))
        return Trajectory(states[SETTLING - 1 :], controls[SETTLING:], envs[SETTLING:])

    schedules = _schedules(steps, vehicle.dt, env_low, env_high)
    parts = [
        jax.lax.map(partial(one, conditions), keys, batch_size=BATCH)
        for conditions, keys in _planned(key, schedules, segments, held_out=held_out)
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


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

    In the last two quarters a third of every entry of e lies at an end of its range, so
    that the corners of E are covered; switches are `SWITCHES` apart. Roads and ν are
    those of `drive_along_path`, which has the other arguments.

    Args:
        loop: of `vehicle.along_path`.
        env_low: lower corner of E.
        env_high: upper corner of E.
        held_out: see `generate`.

    Returns:
        A batch of trajectories, states (segment, steps + 1, 3 + coordinate), controls w
        (segment, steps, 4); their scenarios are those of `segment_scenarios`.
    """
    schedules = _schedules(steps, loop.dt, env_low, env_high)
    box: dict[str, Any] = {"steps": steps, "low": env_low, "high": env_high}
    schedules["held"] = partial(held_road, **box)
    schedules["switching"] = partial(
        random_switching, dt=loop.dt, dwell=SWITCHES, **box
    )
    env_key, run_key = jax.random.split(key)
    planned = _planned(env_key, schedules, segments, held_out=held_out)
    return drive_along_path(
        loop,
        jnp.concatenate([jax.vmap(conditions)(keys) for conditions, keys in planned]),
        run_key,
        limits=limits,
        steering_excitation=steering_excitation,
        speed_excitation=speed_excitation,
    )


def generate_open_loop(
    vehicle: Vehicle,
    key: Key,
    *,
    speed: Span,
    lateral_acceleration: Positive,
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
        lateral_acceleration: of the tightest circles [m/s²], within 0.25 /m.
        segments: number of them.
        steps: of a segment.
        env_low: lower corner of E.
        env_high: upper corner of E.
    """
    low = jnp.asarray(vehicle.control_low)
    high = jnp.asarray(vehicle.control_high)

    def one(key: Key) -> Trajectory:
        env_key, speed_key, bend_key, spread_key, noise_key = jax.random.split(key, 5)
        env = held_road(env_key, steps=1, low=env_low, high=env_high)[0]
        begin, goal = jax.random.uniform(
            speed_key, (2,), minval=speed[0], maxval=speed[1]
        )
        # Squared: most turns are wide, as on roads, and some as tight as the axes of a
        # law are long.
        share = jax.random.uniform(bend_key, (), minval=-1.0)
        tightest = jnp.minimum(lateral_acceleration / begin**2, 0.25)
        steering = jnp.arctan(vehicle.wheelbase * share * jnp.abs(share) * tightest)
        spread = _log_uniform(spread_key, jnp.asarray([[0.003, 0.08], [0.1, 1.5]]))
        white = jax.random.normal(noise_key, (steps + SETTLING, 2))

        def step(carry: tuple[State, Array], fresh: Array) -> tuple[Any, Any]:
            state, noise = carry
            noise = _coloured(noise, spread, fresh)
            drive = jnp.clip(0.5 * (goal - state[3]), -2.0, 2.0)
            drive = goal if vehicle.speed_loop else drive
            # Faster than at the start, the same circle would need more grip.
            slower = jnp.minimum(begin / jnp.maximum(state[3], 1.0), 1.0) ** 2
            control = jnp.stack([slower * steering, drive]) + noise
            control = jnp.clip(control, low, high)
            after = vehicle.step(state, control, env)
            return (after, noise), (after, control)

        start = jnp.zeros(len(vehicle.state_names)).at[3].set(begin)
        _, (states, controls) = jax.lax.scan(step, (start, spread * white[0]), white)
        envs = jnp.tile(env, (steps, 1))
        return Trajectory(states[SETTLING - 1 :], controls[SETTLING:], envs)

    return in_batches(jax.vmap(one), jax.random.split(key, segments), size=BATCH)


def segment_scenarios(
    segments: int, *, along_path: bool = False
) -> Int[np.ndarray, " segment"]:
    """Return the scenario of every generated segment, as index into `SCENARIOS`.

    `generate_along_path` makes those `along_path`, `generate` the others.
    """
    counts = _counts(segments, along_path=along_path)
    return np.repeat(np.arange(len(counts), dtype=np.int32), list(counts.values()))


def _counts(segments: int, *, along_path: bool) -> dict[str, int]:
    """Number of segments by scenario, in the order in which they are generated."""
    if along_path:
        quarter = segments // 4
        sizes = (quarter, quarter, quarter, segments - 3 * quarter)
    else:
        sizes = (segments - segments // 2, segments // 2)
    return dict(zip(SCENARIOS, sizes, strict=False))


def _schedules(steps: int, dt: float, *box: tuple[float, ...]) -> dict[str, Conditions]:
    """Uniform and wet roads, where friction drops at a random time, and S3."""
    drop = (0.0, steps * dt)
    return {
        "uniform": lambda key: in_box(
            uniform_road(key, steps=steps, friction=(0.3, 0.9)), *box
        ),
        "wet": lambda key: in_box(
            wet_road(key, steps=steps, dt=dt, drop_time=drop, **WET), *box
        ),
        "s3": from_s3(steps, dt, *box),
    }


def from_s3(
    steps: int,
    dt: float,
    env_low: tuple[float, ...] = BOX[0],
    env_high: tuple[float, ...] = BOX[1],
) -> Conditions:
    """Return the schedule of S3 in the box E, from a random time of it."""

    def conditions(key: Key) -> Float[Array, "time environment"]:
        road_key, moment_key = jax.random.split(key)
        schedule = switching_road(road_key, steps=4 * steps, dt=dt)
        schedule = in_box(schedule, env_low, env_high)
        return jax.lax.dynamic_slice_in_dim(
            schedule, jax.random.randint(moment_key, (), 0, 3 * steps), steps
        )

    return conditions


def _planned(
    key: Key, schedules: dict[str, Conditions], segments: int, *, held_out: bool
) -> list[tuple[Conditions, Array]]:
    """The schedule of every scenario, or S3, and a key for each of its segments."""
    if held_out:
        return [(schedules["s3"], jax.random.split(key, segments))]
    counts = _counts(segments, along_path="held" in schedules)
    return [
        (schedules[name], jax.random.split(jax.random.fold_in(key, index), count))
        for index, (name, count) in enumerate(counts.items())
    ]


def _log_uniform(
    key: Key, limits: Float[Array, "channel 2"]
) -> Float[Array, " channel"]:
    """One number per channel, uniform in its logarithm."""
    logs = jnp.log(limits)
    return jnp.exp(
        jax.random.uniform(key, limits.shape[:1], minval=logs[:, 0], maxval=logs[:, 1])
    )


def _coloured(noise: Array, spread: float | Array, fresh: Array) -> Array:
    """One step of an AR(1) process of a given spread, from fresh white noise."""
    return CORRELATION * noise + jnp.sqrt(1.0 - CORRELATION**2) * spread * fresh


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
) -> Trajectory:
    """Simulate one run in each of the given environments.

    Speed and curvature are those of `random_drive`. ν of a run is an AR(1) process, as
    of a planner, or its sign (bang-bang), with a log-uniform spread, clipped to the
    limits of the loop.

    Args:
        loop: of `vehicle.along_path`.
        envs: of the plant.
        key: consumed.
        limits: the class of the drives.
        groups: of `DRIVES`, as index; by default one after another.
        steering_excitation: range of the spread of ν_1 [rad].
        speed_excitation: of ν_2 [m/s² or m/s].
        offset: largest e_y [m], e_ψ [rad] and v − v_ref [m/s] at the start.
        burn_in: steps simulated before a run starts.
        sensors: noise of the law's sensors; it is not part of w.
    """
    spread = jnp.asarray([steering_excitation, speed_excitation])
    drive = partial(random_drive, limits=limits, dt=loop.dt)
    if groups is None:
        groups = jnp.arange(envs.shape[0]) % len(DRIVES)

    def one(given: tuple[Array, Key, Array]) -> Trajectory:
        envs = jnp.concatenate([jnp.repeat(given[0][:1], burn_in, axis=0), given[0]])
        road_key, nu_key, start_key = jax.random.split(given[1], 3)
        sensor_keys = _sensor_keys(given[1], envs.shape[0])
        speeds, curvatures = drive(road_key, given[2], steps=envs.shape[0])
        nus = _perturbations(nu_key, steps=envs.shape[0], spread=spread)
        nus = jnp.clip(
            nus, jnp.asarray(loop.control_low[:2]), jnp.asarray(loop.control_high[:2])
        )
        inputs = jnp.concatenate([nus, curvatures[:, None], speeds[:, None]], axis=1)
        beside = jax.random.uniform(start_key, (3,), minval=-1.0) * jnp.asarray(offset)
        start = path_state(
            jnp.zeros(len(loop.state_names) - 3).at[:3].set(beside.at[2].add(speeds[0]))
        )

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
    return in_batches(jax.vmap(one), (envs, keys, groups), size=BATCH)


def _sensor_keys(key: Key, steps: int) -> Array:
    """A key a step for the sensors of one run."""
    return jax.random.split(jax.random.fold_in(key, SENSORS), steps)


def sensor_keys(key: Key, runs: int, steps: int) -> Array:
    """Return the keys that `drive_along_path` gave to `sensors`, (run, time).

    Without a burn-in, with its key; so that what the law measured can be drawn again.
    """
    return jax.vmap(lambda run: _sensor_keys(run, steps))(jax.random.split(key, runs))


def _perturbations(
    key: Key, *, steps: int, spread: Float[Array, "2 2"]
) -> Float[Array, "time 2"]:
    """ν: an AR(1) process or its sign, its spread log-uniform per channel."""
    spread_key, white_key, kind_key = jax.random.split(key, 3)
    size = _log_uniform(spread_key, spread)
    white = jax.random.normal(white_key, (steps, 2))

    def follow(noise: Array, fresh: Array) -> tuple[Array, Array]:
        noise = _coloured(noise, 1.0, fresh)
        return noise, noise

    noise = jax.lax.scan(follow, white[0], white)[1]
    # A quarter is bang-bang, the worst that a planner within its limits may do.
    bang = jax.random.uniform(kind_key) < 0.25
    return size * jnp.where(bang, jnp.sign(noise), noise)
