"""A feedback law around the steady states of a system that follows its reference."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.ranges import Fraction, Interval, Positive
from sfkd_jax.systems._tracking import Error, Inputs, Tracked
from sfkd_jax.tables import corners, interpolated
from sfkd_jax.types import Control, Environment

NEWTON = 30
"""Steps of Newton's method to the steady state in the middle of the table."""
STAGES = 6
"""Number of places on the way from there to a point of the table."""
CORRECTIONS = 4
"""Steps of Newton's method at each of these places."""
SETTLED = 1e-6
"""Largest residual of a steady state, relative to 1 and the size of ξ."""
EVALUATIONS = 20_000
"""Largest number of points of a table."""
WEIGHTS = 10.0 ** np.arange(-2.0, 6.1, 0.5)
"""Weights of the held states that are tried, relative to that of the controls."""


class SteadyState(NamedTuple):
    """Where a system follows its reference, and the gain of the feedback around it.

    Attributes:
        state: ξ*.
        control: u*.
        gain: K.
    """

    state: Error
    control: Control
    gain: Float[Array, "control state"]

    def feedback(self, error: Error) -> Control:
        """Return u* − K (ξ − ξ*), without any limit."""
        return self.control - self.gain @ (error - self.state)


class Law(NamedTuple):
    """Feedback around steady states, tabulated over ρ and e.

        u = u*(ρ, e) − K(ρ, e) (ξ − ξ*(ρ, e))

    Interpolation is linear. The law is a pytree of arrays, so it is stored beside the
    weights that were learned around it.

    Attributes:
        low: lower ends of the axes (ρ, e).
        high: upper ends of the axes; every axis is divided evenly.
        perturbation: largest |ν| that data and planners add to u, (control,).
        state: ξ*, (*axes, state).
        control: u*, (*axes, control).
        gain: K, (*axes, control, state).
    """

    low: Float[Array, " axis"]
    high: Float[Array, " axis"]
    perturbation: Float[Array, " control"]
    state: Float[Array, "*axes state"]
    control: Float[Array, "*axes control"]
    gain: Float[Array, "*axes control state"]

    def at(self, inputs: Inputs, env: Environment) -> SteadyState:
        """Interpolate the steady state; outside the axes, the value at their ends."""
        place = jnp.concatenate([inputs, env])
        counts = self.control.shape[:-1]
        rows, weights = corners(place, self.low, self.high, counts)
        axes = len(counts)
        return SteadyState(
            state=interpolated(self.state, rows, weights, axes),
            control=interpolated(self.control, rows, weights, axes),
            gain=interpolated(self.gain, rows, weights, axes),
        )


class NoLaw(ValueError):
    """There is no law for this system; the message says where, and why."""


def derive_law(
    tracked: Tracked,
    *,
    weights: Mapping[str, float] | None = None,
    effort: Positive = 1.0,
    rate: Fraction = 0.9,
    points: Annotated[int, Interval("[2, inf)")] = 5,
    perturbation: Fraction = 0.05,
) -> Law:
    """Tabulate steady states and gains over ρ and e, from the step alone.

        ξ* = f(ξ*, u*; ρ, e),   ξ*_i = 0 for the held states

    K solves the Riccati equation of f, linearised there.

    Args:
        tracked: the system, whose step jax differentiates.
        weights: state -> weight in the Riccati equation; those of other states are 0.
            None for one weight on all held states, which is chosen by `rate`.
        effort: weight of every control, per squared half of its range.
        rate: without `weights`, the smallest of `WEIGHTS` is taken with which every
            mode in the middle of the table decays by this factor in a step, or the one
            with which the slowest mode is fastest.
        points: on every axis; 3 where the table would otherwise be too large.
        perturbation: largest |ν|, relative to half of the range of each control.

    Raises:
        NoLaw: a steady state or a gain does not exist somewhere in the table.
    """
    low = np.concatenate([tracked.frame.input_box[0], tracked.system.env_box[0]])
    high = np.concatenate([tracked.frame.input_box[1], tracked.system.env_box[1]])
    if points ** len(low) > EVALUATIONS:
        points = 3
    counts = (points,) * len(low)
    if points ** len(low) > EVALUATIONS:
        raise NoLaw(
            f"a table over {len(low)} entries of the reference and e is too large: "
            "leave some of them out"
        )
    ends = zip(low, high, counts, strict=True)
    axes = [np.linspace(start, stop, count) for start, stop, count in ends]
    places = np.asarray(list(product(*axes)))
    # In float64: the errors of steady states are then far below those of a model.
    with jax.enable_x64(True):
        steady = _steady_states(tracked, places, 0.5 * (low + high))
        states, controls, residuals = map(np.asarray, steady)
        _require_settled(tracked, places, states, residuals)
        slopes = np.asarray(_slopes(tracked, states, controls, places))
    controls = _within_limits(tracked, places, controls)
    half_ranges = 0.5 * np.subtract(*tracked.system.control_box[::-1])
    R = effort * np.diag(1.0 / half_ranges**2)
    middle = np.argmin(np.sum(((places - places.mean(0)) / (high - low)) ** 2, axis=1))
    Q = _state_weights(tracked, weights, slopes[middle], R, rate)
    gains = np.stack(
        [
            _gain(slope, Q, R, tracked, place)
            for slope, place in zip(slopes, places, strict=True)
        ]
    )

    def table(values: np.ndarray) -> Array:
        shape = (*counts, *values.shape[1:])
        return jnp.asarray(values.reshape(shape), jnp.float32)

    return Law(
        low=jnp.asarray(low, jnp.float32),
        high=jnp.asarray(high, jnp.float32),
        perturbation=jnp.asarray(perturbation * half_ranges, jnp.float32),
        state=table(states),
        control=table(controls),
        gain=table(gains),
    )


def _steady_states(
    tracked: Tracked, places: np.ndarray, middle: np.ndarray
) -> tuple[Array, Array, Array]:
    """Return steady states, controls and residuals at places (ρ, e).

    The search begins in the middle of the table, and follows the solution from there.
    """
    size = len(tracked.names)
    low, high = map(np.asarray, tracked.system.control_box)
    count = len(tracked.frame.input_names)
    free = np.asarray([i for i in range(size) if i not in tracked.held])
    free = np.concatenate([free, size + np.arange(len(low))])
    # At the limits of a control it may have no effect, as the thrust of a rotor at 0.
    start = jnp.concatenate([jnp.zeros(size), 0.5 * (low + high)])

    def residual(unknown: Array, place: Array) -> Array:
        both = start.at[free].set(unknown)
        error = both[:size]
        after = tracked.step(error, both[size:], place[:count], place[count:])
        return after - error

    def corrected(place: Array) -> Callable[[int, Array], Array]:
        def newton(_: int, unknown: Array) -> Array:
            slopes = jax.jacfwd(residual)(unknown, place)
            return unknown - jnp.linalg.solve(slopes, residual(unknown, place))

        return newton

    def solved(centre: Array, place: Array) -> tuple[Array, Array, Array]:
        def stage(unknown: Array, share: Array) -> tuple[Array, None]:
            there = middle + share * (place - middle)
            return jax.lax.fori_loop(0, CORRECTIONS, corrected(there), unknown), None

        shares = jnp.arange(1, STAGES + 1) / STAGES
        unknown, _ = jax.lax.scan(stage, centre, shares)
        both = start.at[free].set(unknown)
        return both[:size], both[size:], residual(unknown, place)

    @jax.jit
    def all_solved(places: Array) -> tuple[Array, Array, Array]:
        centre = jax.lax.fori_loop(
            0, NEWTON, corrected(jnp.asarray(middle)), start[free]
        )
        return jax.vmap(solved, in_axes=(None, 0))(centre, places)

    return all_solved(jnp.asarray(places))


def _require_settled(
    tracked: Tracked, places: np.ndarray, states: np.ndarray, residuals: np.ndarray
) -> None:
    """Raise `NoLaw` where no steady state was found."""
    sizes = np.max(np.abs(residuals), axis=1)
    tolerance = SETTLED * (1.0 + np.max(np.abs(states), axis=1))
    missing = ~(sizes <= tolerance)
    if missing.any():
        held = ", ".join(tracked.names[i] for i in tracked.held)
        raise NoLaw(
            f"with {held} held there is no steady state at {missing.sum()} of "
            f"{len(places)} places, as at {_described(tracked, places[missing][0])}: "
            "hold other states, or make the ranges smaller"
        )


def _within_limits(
    tracked: Tracked, places: np.ndarray, controls: np.ndarray
) -> np.ndarray:
    """Return the steady controls, or raise `NoLaw` where they exceed their limits."""
    low, high = map(np.asarray, tracked.system.control_box)
    beyond = np.any((controls < low) | (controls > high), axis=1)
    if beyond.any():
        first = controls[beyond][0]
        listed = ", ".join(
            f"{variable.label} {value:.4g} in [{variable.low:g}, {variable.high:g}]"
            for variable, value in zip(
                tracked.system.control_variables, first, strict=True
            )
        )
        raise NoLaw(
            f"saturation: at {beyond.sum()} of {len(places)} places the reference asks "
            f"for more than the limits, as at "
            f"{_described(tracked, places[beyond][0])}: {listed}"
        )
    return controls


def _slopes(
    tracked: Tracked, states: np.ndarray, controls: np.ndarray, places: np.ndarray
) -> Array:
    """Return [A B] at steady states, (place, state, state + control)."""
    count = len(tracked.frame.input_names)

    def slopes(state: Array, control: Array, place: Array) -> Array:
        def step(state: Array, control: Array) -> Array:
            return tracked.step(state, control, place[:count], place[count:])

        return jnp.concatenate(jax.jacfwd(step, (0, 1))(state, control), axis=1)

    return jax.jit(jax.vmap(slopes))(*map(jnp.asarray, (states, controls, places)))


def _state_weights(
    tracked: Tracked,
    weights: Mapping[str, float] | None,
    slopes: np.ndarray,
    R: np.ndarray,
    rate: float,
) -> np.ndarray:
    """Return Q, with the weights that are stated or with those that `rate` chooses."""
    size = len(tracked.names)
    if weights is not None:
        unknown = set(weights) - set(tracked.names)
        if unknown or min(weights.values(), default=0.0) < 0.0:
            raise ValueError(f"weights: 0 or above, of {', '.join(tracked.names)}")
        return np.diag([float(weights.get(name, 0.0)) for name in tracked.names])
    held = np.isin(np.arange(size), tracked.held).astype(float)
    fastest = None
    for weight in WEIGHTS:
        Q = np.diag(weight * held)
        try:
            gain = _riccati(slopes, Q, R)
        except np.linalg.LinAlgError:
            continue
        A, B = slopes[:, :size], slopes[:, size:]
        decay = np.max(np.abs(np.linalg.eigvals(A - B @ gain)))
        if fastest is None or decay < fastest[0]:
            fastest = decay, Q
        if decay <= rate:
            break
    if fastest is None:
        raise NoLaw(
            "the Riccati equation in the middle of the table has no solution: "
            f"{', '.join(tracked.names)} cannot all be brought back by "
            f"{', '.join(tracked.system.controls)}"
        )
    return fastest[1]


def _gain(
    slopes: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    tracked: Tracked,
    place: np.ndarray,
) -> np.ndarray:
    """Return K at a place, or raise `NoLaw`."""
    try:
        return _riccati(slopes, Q, R)
    except np.linalg.LinAlgError:
        raise NoLaw(
            f"the Riccati equation has no solution at {_described(tracked, place)}"
        ) from None


def _riccati(slopes: np.ndarray, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return K of the discrete Riccati equation."""
    # Here: who loads a policy derives no law.
    from scipy.linalg import solve_discrete_are

    A, B = np.split(slopes, [len(slopes)], axis=1)
    value = solve_discrete_are(A, B, Q, R)
    return np.linalg.solve(R + B.T @ value @ B, B.T @ value @ A)


def _described(tracked: Tracked, place: np.ndarray) -> str:
    """Return a place (ρ, e) in words."""
    names = [*tracked.frame.input_names, *tracked.system.environment]
    return ", ".join(
        f"{name} {value:.4g}" for name, value in zip(names, place, strict=True)
    )
