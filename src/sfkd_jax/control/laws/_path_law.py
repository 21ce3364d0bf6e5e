"""A path-following law as tables of steady turns and feedback gains."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from math import prod
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sfkd_jax.control.laws._model_law import SteadyTurn
from sfkd_jax.geometry import PATH_SPEED, PathState
from sfkd_jax.types import Control, Environment, Scalar


class PathLaw(NamedTuple):
    """Feedback around steady turns, tabulated over a = v² κ, v and e.

        u = u*(a, v, e) − K(a, v, e) (ξ − ξ*(a, v, e))

    Interpolation is linear. The tables are over the lateral acceleration a of a turn,
    not over κ, because the limit of the tyres is then a box. The law is a pytree of
    arrays, so it can be stored beside the weights that were learned around it.

    Attributes:
        low: lower ends of the axes (a [m/s²], v_ref [m/s], e_1, …).
        high: upper ends of the axes; every axis is divided evenly.
        perturbation: largest |ν| that data and planners add to u [rad, control unit],
            (2,).
        state: ξ* of the steady turns, (*axes, coordinate).
        control: u*, (*axes, 2).
        gain: K, (*axes, 2, coordinate).
    """

    low: Float[Array, " axis"]
    high: Float[Array, " axis"]
    perturbation: Float[Array, " 2"]
    state: Float[Array, "*axes coordinate"]
    control: Float[Array, "*axes 2"]
    gain: Float[Array, "*axes 2 coordinate"]

    def turn(self, curvature: Scalar, speed: Scalar, env: Environment) -> SteadyTurn:
        """Interpolate the steady turn; outside the axes, the value at their ends.

        Args:
            curvature: κ [1/m].
            speed: reference speed [m/s]; it is also the speed of the steady turn.
            env: e.
        """
        at = jnp.concatenate([jnp.stack([curvature * speed**2, speed]), env])
        counts = self.control.shape[:-1]
        rows, weights = _corners(at, self.low, self.high, counts)

        def interpolate(table: Array) -> Array:
            corners = table.reshape(-1, *table.shape[len(counts) :])[rows]
            return jnp.tensordot(weights, corners, axes=1)

        state, control, gain = (
            interpolate(table) for table in (self.state, self.control, self.gain)
        )
        return SteadyTurn(state.at[PATH_SPEED].set(speed), control, gain)

    def __call__(
        self, coordinates: PathState, curvature: Scalar, speed: Scalar, env: Environment
    ) -> Control:
        """Return u, without any limit."""
        return turn_control(self.turn(curvature, speed, env), coordinates)


def turn_control(turn: SteadyTurn, coordinates: PathState) -> Control:
    """Return the control u* − K (ξ − ξ*)."""
    return turn.control - turn.gain @ (coordinates - turn.state)


def _corners(
    at: Float[Array, " axis"],
    low: Float[Array, " axis"],
    high: Float[Array, " axis"],
    counts: tuple[int, ...],
) -> tuple[Int[Array, " corner"], Float[Array, " corner"]]:
    """Flat indices and weights of the grid points for multilinear interpolation."""
    last = jnp.asarray(counts) - 1
    position = jnp.clip((at - low) / (high - low), 0.0, 1.0) * last
    index = jnp.minimum(jnp.floor(position).astype(int), last - 1)
    beyond = position - index
    sides = jnp.asarray(list(product((0, 1), repeat=len(counts))))
    strides = jnp.asarray([prod(counts[axis + 1 :]) for axis in range(len(counts))])
    weights = jnp.prod(jnp.where(sides == 1, beyond, 1.0 - beyond), axis=1)
    return (index + sides) @ strides, weights


def law_to_arrays(law: PathLaw) -> dict[str, Array]:
    """Return the law as a dictionary of arrays, for storage."""
    return law._asdict()


def law_from_arrays(arrays: Mapping[str, Any]) -> PathLaw:
    """Return the law from a dictionary of arrays.

    Raises:
        KeyError: an array is missing.
    """
    return PathLaw(**{name: jnp.asarray(arrays[name]) for name in PathLaw._fields})
