"""Simulated runs of a closed loop: references, environments and excitation drawn."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import without_pose
from sfkd_jax.ranges import Span
from sfkd_jax.schedules import random_switching, within
from sfkd_jax.systems._closed_loop import ClosedLoop
from sfkd_jax.systems._law import Law
from sfkd_jax.systems._system import Ends
from sfkd_jax.systems._tracking import Error, ReferenceState, Tracked
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Key,
    Scalar,
    State,
    Trajectory,
)

SMALLEST = 0.01
"""Smallest size of ν and of the errors at the start, relative to the largest."""
SLOWEST = 0.95
"""Largest autocorrelation of ν from a step to the next."""
TRIALS = 64
"""Number of runs that tell how far a loop moves, and whether it saturates."""
QUANTILE = 0.95
"""Share of the trial runs whose errors count."""
TINY = 1e-12
"""Error that is none."""
ROUNDING = 1e-4
"""Share of the range of a control that counts as its limit."""
BRAKING = 0.8
"""Share of the largest rate that a reference plans to stop with."""

Profile: TypeAlias = Callable[[Scalar, Scalar, Scalar], Scalar]
"""(first state of a chain, last state, goal) -> rate of the last state."""


class Reference(NamedTuple):
    """A reference over time.

    Attributes:
        points: states of the reference, (time + 1, reference).
        rates: of its chains, constant over a step.
    """

    points: Float[Array, "time_plus_1 reference"]
    rates: Float[Array, "time chain"]


def random_reference(tracked: Tracked, key: Key, *, steps: int) -> Reference:
    """Draw a reference of the frame: rates or goals that are held for some time.

    A chain whose first state has a range moves from one point of it to the next. A
    chain whose second state has a range has rates that keep it there.

    Args:
        tracked: the system in the coordinates of its frame.
        key: consumed.
        steps: number of steps.
    """
    frame = tracked.frame
    dt = tracked.system.dt
    start_key, goal_key = jax.random.split(key)
    ranges = [_range_of(tracked, chain) for chain in frame.reference]
    low = tuple(float(ends[0]) for ends in ranges)
    high = tuple(float(ends[1]) for ends in ranges)
    goals = random_switching(
        goal_key, steps=steps, dt=dt, low=low, high=high, dwell=frame.dwell
    )
    profiles = [_profile(tracked, chain) for chain in frame.reference]
    sizes = [len(chain) for chain in frame.reference]
    firsts = [sum(sizes[:i]) for i in range(len(sizes))]

    def step(point: ReferenceState, goal: Array) -> tuple[ReferenceState, Any]:
        rates = jnp.stack(
            [
                profile(point[first], point[first + size - 1], one)
                for profile, first, size, one in zip(
                    profiles, firsts, sizes, goal, strict=True
                )
            ]
        )
        after = tracked.advance(point, rates)
        return after, (after, rates)

    start = jnp.zeros(len(tracked.followed))
    # A chain that moves between places begins at rest, or it could leave its range.
    at_rest = {chain[1:] for chain in frame.reference if chain[0] in frame.ranges}
    for state, ends in frame.ranges.items():
        if (state,) in at_rest:
            continue
        index = frame.followed.index(state)
        draw = within(ends, jax.random.fold_in(start_key, index))
        start = start.at[index].set(draw)
    _, (after, rates) = jax.lax.scan(step, start, goals)
    return Reference(jnp.concatenate([start[None], after]), rates)


def _range_of(tracked: Tracked, chain: tuple[str, ...]) -> Ends:
    """Return the range of the goals of a chain: of its first state, or of its rate."""
    frame = tracked.frame
    return frame.ranges.get(chain[0], frame.reference[chain])


def _profile(tracked: Tracked, chain: tuple[str, ...]) -> Profile:
    """Return how a chain moves to its goals."""
    frame = tracked.frame
    dt = tracked.system.dt
    slowest, fastest = frame.reference[chain]
    limits = frame.ranges.get(chain[-1])

    def limited(last: Scalar, rate: Scalar) -> Scalar:
        if limits is not None:
            rate = jnp.clip(rate, (limits[0] - last) / dt, (limits[1] - last) / dt)
        return jnp.clip(rate, slowest, fastest)

    if chain[0] not in frame.ranges:
        return lambda first, last, goal: limited(last, goal)
    if len(chain) == 1:
        return lambda first, last, goal: limited(last, (goal - first) / dt)
    braking = BRAKING * min(-slowest, fastest)

    def towards(first: Scalar, last: Scalar, goal: Scalar) -> Scalar:
        side = jnp.sign(goal - first)
        # The rate v' from which it still stops at the goal, a step later:
        # (v + v') dt / 2 + v'² / (2 b) = way.
        half = 0.5 * braking * dt
        squared = half**2 + 2.0 * braking * jnp.abs(goal - first)
        squared = squared - 2.0 * half * side * last
        rate = jnp.sqrt(jnp.maximum(squared, 0.0)) - half
        return limited(last, (side * rate - last) / dt)

    return towards


def inputs_along(tracked: Tracked, reference: Reference) -> Float[Array, "time inputs"]:
    """Return ρ of the steps of a reference."""
    return jax.vmap(tracked.inputs)(reference.points[:-1], reference.rates)


class Drawn(NamedTuple):
    """What is drawn for a run.

    Attributes:
        inputs: ρ, (time, inputs).
        nu: ν, (time, control).
        envs: e, (time, environment).
    """

    inputs: Float[Array, "time inputs"]
    nu: Float[Array, "time control"]
    envs: Float[Array, "time environment"]


def draw_run(loop: ClosedLoop, key: Key, *, steps: int, dwell: Span) -> Drawn:
    """Draw references, excitation and environments of a run.

    Args:
        loop: the closed loop.
        key: consumed.
        steps: number of steps.
        dwell: shortest and longest time between two switches of e [s].
    """
    tracked = loop.tracked
    reference_key, env_key, nu_key = jax.random.split(key, 3)
    low, high = tracked.system.env_box
    return Drawn(
        inputs=inputs_along(
            tracked, random_reference(tracked, reference_key, steps=steps)
        ),
        nu=_excitation(loop, nu_key, steps),
        envs=random_switching(
            env_key, steps=steps, dt=tracked.system.dt, low=low, high=high, dwell=dwell
        ),
    )


def _excitation(loop: ClosedLoop, key: Key, steps: int) -> Float[Array, "time control"]:
    """Draw ν: noise of a size and a bandwidth of its own for each run."""
    size_key, band_key, noise_key = jax.random.split(key, 3)
    size = 10.0 ** within((jnp.log10(SMALLEST), 0.0), size_key)
    memory = within((0.0, SLOWEST), band_key)
    noise = jax.random.normal(noise_key, (steps, loop.controls))

    def filtered(before: Array, drawn: Array) -> tuple[Array, Array]:
        after = memory * before + jnp.sqrt(1.0 - memory**2) * drawn
        return after, after

    _, values = jax.lax.scan(filtered, noise[0], noise)
    # Half of the largest value is one standard deviation.
    return loop.law.perturbation * size * jnp.clip(0.5 * values, -1.0, 1.0)


def simulate(
    loop: ClosedLoop,
    drawn: Drawn,
    key: Key,
    *,
    spread: Float[Array, " state"],
    noise: Float[Array, " state"],
) -> Trajectory:
    """Simulate a run from near its steady state.

    The controls of the run are (ν, ρ), with the part of ν that the limits allow. What
    the noise of the sensors does to the law counts as a disturbance.

    Args:
        loop: the closed loop.
        drawn: of `draw_run`.
        key: of start and sensors; consumed.
        spread: standard deviations of ξ at the start, at most.
        noise: standard deviations of the sensors.
    """
    size_key, start_key, sensor_key = jax.random.split(key, 3)
    steady = loop.law.at(drawn.inputs[0], drawn.envs[0])
    size = 10.0 ** within((jnp.log10(SMALLEST), 0.0), size_key)
    away = jax.random.normal(start_key, steady.state.shape)
    start = steady.state + size * spread * away
    shape = (len(drawn.nu), len(start))
    sensed = noise * jax.random.normal(sensor_key, shape)

    def step(error: Error, given: tuple[Drawn, Array]) -> tuple[Error, Any]:
        (inputs, nu, env), off = given
        steady = loop.law.at(inputs, env)
        applied = loop.applied(steady, error + off, nu)
        after = loop.tracked.step(error, applied, inputs, env)
        effective = applied - steady.feedback(error + off)
        return after, (after, jnp.concatenate([effective, inputs]))

    _, (after, controls) = jax.lax.scan(step, start, (drawn, sensed))
    states = jax.vmap(without_pose)(jnp.concatenate([start[None], after]))
    return Trajectory(states, controls, drawn.envs)


def random_runs(
    loop: ClosedLoop,
    key: Key,
    *,
    count: int,
    steps: int,
    dwell: Span,
    spread: Float[Array, " state"],
    noisy: bool,
) -> Trajectory:
    """Draw and simulate runs, as one program.

    Args:
        loop: the closed loop.
        key: consumed.
        count: number of runs.
        steps: of each run.
        dwell: shortest and longest time between two switches of e [s].
        spread: standard deviations of ξ at the start, at most.
        noisy: whether the law reads sensors with noise.
    """
    noise = jnp.asarray(loop.tracked.system.sensor_noise) * noisy
    keys = jax.random.split(key, count)
    return _simulated(loop.tracked, steps, dwell, loop.law, keys, spread, noise)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _simulated(
    tracked: Tracked,
    steps: int,
    dwell: Span,
    law: Law,
    keys: Array,
    spread: Float[Array, " state"],
    noise: Float[Array, " state"],
) -> Trajectory:
    """Return the runs of `random_runs`; laws share a program."""
    loop = ClosedLoop(tracked, law)

    def run(key: Key) -> Trajectory:
        draw_key, run_key = jax.random.split(key)
        drawn = draw_run(loop, draw_key, steps=steps, dwell=dwell)
        return simulate(loop, drawn, run_key, spread=spread, noise=noise)

    return jax.vmap(run)(keys)


def _from_steady(loop: ClosedLoop, key: Key, steps: int, dwell: Span) -> Trajectory:
    """Return a few runs that begin at steady states."""
    return random_runs(
        loop,
        key,
        count=TRIALS,
        steps=steps,
        dwell=dwell,
        spread=jnp.zeros(len(loop.tracked.names)),
        noisy=True,
    )


def spread_of(
    loop: ClosedLoop, key: Key, *, steps: int, dwell: Span
) -> Float[Array, " state"]:
    """Return the standard deviations of ξ − ξ* in runs that begin at steady states.

    What a steady state itself changes by, such as the angle of a motor that drives a
    pendulum to its set point, is no deviation from it.
    """
    runs = _from_steady(loop, key, steps, dwell)

    def deviation(state: State, control: Control, env: Environment) -> Array:
        _, inputs = loop.split(control)
        return state[BODY] - loop.law.at(inputs, env).state

    deviations = jax.vmap(jax.vmap(deviation))(
        runs.states[:, :-1], runs.controls, runs.envs
    )
    return jnp.std(deviations.reshape(-1, len(loop.tracked.names)), axis=0)


class Trial(NamedTuple):
    """What runs that begin at steady states say of a law.

    Attributes:
        saturated: share of the steps in which a control is at its limit; 1 if a run is
            not finite.
        error: geometric mean over the outputs of the largest |y| of a run, which
            `QUANTILE` of the runs stay below.
    """

    saturated: float
    error: float


def tried(loop: ClosedLoop, key: Key, *, steps: int, dwell: Span) -> Trial:
    """Simulate a few runs of a law.

    Args:
        loop: the system with its law.
        key: consumed.
        steps: of each run.
        dwell: shortest and longest time between two switches of e [s].
    """
    runs = _from_steady(loop, key, steps, dwell)
    if not jnp.all(jnp.isfinite(runs.states)):
        return Trial(saturated=1.0, error=float("inf"))

    def at_limit(state: State, control: Control, env: Environment) -> Array:
        nu, inputs = loop.split(control)
        wanted = loop.law.at(inputs, env).feedback(state[BODY]) + nu
        low, high = map(jnp.asarray, loop.tracked.system.control_box)
        room = ROUNDING * (high - low)
        return jnp.any((wanted <= low + room) | (wanted >= high - room))

    limited = jax.vmap(jax.vmap(at_limit))(
        runs.states[:, :-1], runs.controls, runs.envs
    )
    errors = runs.states[..., BODY]
    logarithms = []
    for entries in loop.tracked.rows.values():
        sizes = jnp.linalg.norm(errors[..., list(entries)], axis=-1).max(axis=1)
        logarithms.append(jnp.log(jnp.quantile(sizes, QUANTILE) + TINY))
    return Trial(
        saturated=float(jnp.mean(limited)),
        error=float(jnp.exp(jnp.mean(jnp.stack(logarithms)))),
    )
