"""A feedback law around the steady states of a system that follows its reference."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.systems._tracking import Error, Inputs
from sfkd_jax.tables import corners, interpolated
from sfkd_jax.types import Control, Environment


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
