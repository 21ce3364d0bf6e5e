"""Steady states of a system that follows its reference, over a table of ρ and e."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sfkd_jax.ranges import Interval
from sfkd_jax.systems._tracking import Tracked

NEWTON = 30
"""Steps of Newton's method to the steady state in the middle of the table."""
STAGES = 6
"""Number of places on the way from there to a point of the table."""
CORRECTIONS = 4
"""Steps of Newton's method at each of these places."""
SETTLED = 1e-6
"""Largest residual of a steady state, relative to 1 and the size of ξ."""
LARGEST_TABLE = 20_000
"""Largest number of points of a table."""


class NoLaw(ValueError):
    """There is no law for this system; the message says where, and why."""


class SteadyStates(NamedTuple):
    """Steady states of a system at the points of a table, in float64.

    Attributes:
        low: lower ends of the axes (ρ, e).
        high: upper ends of the axes.
        points: number of points on each axis.
        states: ξ*, (point, state).
        controls: u*, (point, control).
        slopes: [A B] of the step there, (point, state, state + control).
    """

    low: np.ndarray
    high: np.ndarray
    points: int
    states: np.ndarray
    controls: np.ndarray
    slopes: np.ndarray

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of points on each axis."""
        return (self.points,) * len(self.low)

    @property
    def corners(self) -> np.ndarray:
        """Indices of the points at the corners of the table."""
        indices = np.arange(len(self.states)).reshape(self.counts)
        for axis in range(len(self.low)):
            indices = np.take(indices, (0, self.points - 1), axis)
        return indices.ravel()


def steady_states(
    tracked: Tracked, *, points: Annotated[int, Interval("[2, inf)")] = 5
) -> SteadyStates:
    """Tabulate the steady states of a system over ρ and e, and the slopes of its step.

        ξ* = f(ξ*, u*; ρ, e),   ξ*_i = 0 for the held states

    Args:
        tracked: the system, whose step jax differentiates.
        points: on every axis; 3 where the table would otherwise be too large.

    Raises:
        NoLaw: somewhere there is no steady state, or not within the limits.
    """
    low = np.concatenate([tracked.frame.input_box[0], tracked.system.env_box[0]])
    high = np.concatenate([tracked.frame.input_box[1], tracked.system.env_box[1]])
    if points ** len(low) > LARGEST_TABLE:
        points = 3
    if points ** len(low) > LARGEST_TABLE:
        raise NoLaw(
            f"a table over {len(low)} entries of the reference and e is too large: "
            "leave some of them out"
        )
    ends = zip(low, high, strict=True)
    axes = [np.linspace(start, stop, points) for start, stop in ends]
    places = np.asarray(list(product(*axes)))
    # In float64: the errors of steady states are then far below those of a model.
    with jax.enable_x64(True):
        steady = _steady_states(tracked, places, 0.5 * (low + high))
        states, controls, residuals = map(np.asarray, steady)
        _require_settled(tracked, places, states, residuals)
        _require_within_limits(tracked, places, controls)
        slopes = np.asarray(_slopes(tracked, states, controls, places))
    return SteadyStates(low, high, points, states, controls, slopes)


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
    middle_place = jnp.asarray(middle)
    # At the limits of a control it may have no effect, as the thrust of a rotor at 0.
    start = jnp.concatenate([jnp.zeros(size), 0.5 * (low + high)])

    def residual(unknown: Array, place: Array) -> Array:
        both = start.at[free].set(unknown)
        error = both[:size]
        after = tracked.step(error, both[size:], place[:count], place[count:])
        return after - error

    def corrected(place: Array) -> Callable[[Any, Array], Array]:
        def newton(_: Any, unknown: Array) -> Array:
            slopes = jax.jacfwd(residual)(unknown, place)
            return unknown - jnp.linalg.solve(slopes, residual(unknown, place))

        return newton

    def solved(centre: Array, place: Array) -> tuple[Array, Array, Array]:
        def stage(unknown: Array, share: Array) -> tuple[Array, None]:
            there = middle_place + share * (place - middle_place)
            return jax.lax.fori_loop(0, CORRECTIONS, corrected(there), unknown), None

        shares = jnp.arange(1, STAGES + 1) / STAGES
        unknown, _ = jax.lax.scan(stage, centre, shares)
        both = start.at[free].set(unknown)
        return both[:size], both[size:], residual(unknown, place)

    @jax.jit
    def all_solved(places: Array) -> tuple[Array, Array, Array]:
        improved = corrected(middle_place)
        centre = jax.lax.fori_loop(0, NEWTON, improved, start[free])
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
            f"{len(places)} places, as at {described(tracked, places[missing][0])}: "
            "hold other states, or make the ranges smaller"
        )


def _require_within_limits(
    tracked: Tracked, places: np.ndarray, controls: np.ndarray
) -> None:
    """Raise `NoLaw` where a steady control exceeds its limits."""
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
            f"{described(tracked, places[beyond][0])}: {listed}"
        )


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


def described(tracked: Tracked, place: np.ndarray) -> str:
    """Return a place (ρ, e) in words."""
    names = [*tracked.frame.input_names, *tracked.system.environment]
    return ", ".join(
        f"{name} {value:.4g}" for name, value in zip(names, place, strict=True)
    )
