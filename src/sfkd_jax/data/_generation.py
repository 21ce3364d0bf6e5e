"""Generate segments in world coordinates with persistently excited controls."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.data._splits import scenario_labels
from sfkd_jax.plants import Vehicle
from sfkd_jax.ranges import Interval, Span
from sfkd_jax.scenarios import (
    Scenario,
    family,
    project,
    reference_window,
    smooth_path,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.types import Key, Scalar, State, Trajectory

Driver: TypeAlias = Callable[
    [State, Float[Array, "horizon 4"]], Float[Array, " control"]
]

Conditions: TypeAlias = Callable[[Key], Float[Array, "time environment"]]

BURN_IN = 10
"""Steps simulated before a segment starts, so that slip, yaw rate and steering have
settled.
"""
ROADS = partial(
    smooth_path, length=150.0, peak_curvature=0.025, wavelengths=(60.0, 240.0)
)
"""Paths for training: other wavelengths and a wider range of curvature than those of
the benchmark.
"""

WET = {"before": (0.55, 0.9), "after": (0.3, 0.5)}
"""Friction of a wet road in the data, before and after it drops."""


def benchmark_roads(
    steps: int, dt: float, *, fixed_levels: bool = False
) -> dict[str, Conditions]:
    """Return schedules of S1 and S2; friction drops at a random time of the segment.

    Args:
        steps: of a segment.
        dt: [s].
        fixed_levels: use the levels of the benchmark only, instead of ranges around
            them.
    """
    dry: dict[str, Any] = {} if fixed_levels else {"friction": (0.3, 0.9)}
    wet: dict[str, Any] = {} if fixed_levels else WET
    return {
        "s1": partial(uniform_road, steps=steps, **dry),
        "s2": partial(wet_road, steps=steps, dt=dt, drop_time=(0.0, steps * dt), **wet),
    }


def from_switching(steps: int, dt: float) -> Conditions:
    """Return the schedule of S3, from a random time of it."""

    def conditions(key: Key) -> Float[Array, "time 2"]:
        road_key, moment_key = jax.random.split(key)
        schedule = switching_road(road_key, steps=4 * steps, dt=dt)
        return jax.lax.dynamic_slice_in_dim(
            schedule, jax.random.randint(moment_key, (), 0, 3 * steps), steps
        )

    return conditions


def log_uniform(
    key: Key, limits: Float[Array, "channel 2"]
) -> Float[Array, " channel"]:
    """Draw one number per channel, uniform in its logarithm."""
    logs = jnp.log(limits)
    return jnp.exp(
        jax.random.uniform(key, limits.shape[:1], minval=logs[:, 0], maxval=logs[:, 1])
    )


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
    fixed_levels: bool = False,
) -> Trajectory:
    """Generate independent segments: half S1 (uniform road), half S2 (drop and gusts).

    A path-following driver keeps the car on a random road while an AR(1) process
    excites both controls. Its spread is drawn log-uniformly per segment, so that the
    excitation ranges from weak to strong.

    Args:
        vehicle: the plant.
        driver: (state, next reference points) -> control before excitation.
        key: consumed.
        segments: their number.
        steps: of a segment.
        speed: range of the target speed [m/s].
        steering_excitation: range of the spread [rad].
        speed_excitation: the same for the second control [m/s² or m/s].
        fixed_levels: use the benchmark's own levels of S1 and S2 only (the training
            set as printed in the paper).

    Returns:
        A batch of trajectories, states (segment, steps + 1, state); their scenarios are
        those of `segment_scenarios`.
    """
    halves, counts = [], _counts(segments).values()
    excitation = jnp.asarray([steering_excitation, speed_excitation])
    schedules = benchmark_roads(steps, vehicle.dt, fixed_levels=fixed_levels).values()
    for index, (conditions, count) in enumerate(zip(schedules, counts, strict=True)):
        drive = partial(_segment, vehicle, driver, conditions, steps, speed, excitation)
        keys = jax.random.split(jax.random.fold_in(key, index), count)
        halves.append(jax.lax.map(drive, keys, batch_size=500))
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), *halves)


def segment_scenarios(segments: int) -> Int[np.ndarray, " segment"]:
    """Return the scenario of every segment of `generate`, as index into `SCENARIOS`."""
    return scenario_labels(_counts(segments))


def _counts(segments: int) -> dict[str, int]:
    """Number of segments by scenario, in the order in which they are generated."""
    return {"s1": segments - segments // 2, "s2": segments // 2}


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
    """Generate segments of S3's switching, from a random time of its schedule.

    They are for tests, never for training.

    Args:
        vehicle: the plant.
        driver: as for `generate`.
        key: consumed.
        segments: their number.
        steps: of a segment.
        speed: as for `generate`.
        steering_excitation: as for `generate`.
        speed_excitation: as for `generate`.
    """
    conditions = from_switching(steps, vehicle.dt)
    drive = partial(_segment, vehicle, driver, conditions, steps, speed)
    drive = partial(drive, jnp.asarray([steering_excitation, speed_excitation]))
    return jax.lax.map(drive, jax.random.split(key, segments), batch_size=500)


def _segment(
    vehicle: Vehicle,
    driver: Driver,
    conditions: Callable[[Key], Array],
    steps: int,
    speed_range: tuple[float, float],
    excitation: Float[Array, "control 2"],
    key: Key,
) -> Trajectory:
    """One segment; its first environment also applies during the burn-in."""
    road_key, speed_key, spread_key, noise_key, start_key, offset_key = (
        jax.random.split(key, 6)
    )
    speed = jax.random.uniform(
        speed_key, (), minval=speed_range[0], maxval=speed_range[1]
    )
    sample = family(
        conditions,
        ROADS,
        speed=10.0,
        state_size=len(vehicle.state_names),
    )
    scenario: Scenario = sample(road_key)._replace(speed=speed)
    spread = log_uniform(spread_key, excitation)
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
        jnp.full((), 20.0 * jax.random.uniform(offset_key)),
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
