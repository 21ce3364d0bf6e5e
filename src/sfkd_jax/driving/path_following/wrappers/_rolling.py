"""A bound of the lateral deviation of a car that is too slow for its certificate."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.path_coordinates import HEADING, PATH_SPEED, PathState
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.driving.path_following.wrappers._conditions import Conditions
from sfkd_jax.types import Scalar


class RollingCorridor(NamedTuple):
    """The corridor from the course of the car alone, below the speeds of a certificate.

        corridor⁺ = corridor + v dt |sin χ|,   χ = e_ψ − ψ*(κ, v, e)

    Time does not contract at rest, so no certificate covers the last metres before a
    stop. Proved is, for every controller, |e_y(t)| ≤ |e_y(0)| + ∫ |sin χ| ds for the
    course χ of the car relative to the path. Two things are measured and not proved:
    that the heading ψ* of the steady turn tells the slip of the car, and χ itself,
    once a step.

    Attributes:
        law: whose steady turns give ψ*.
        conditions: of the certificate.
        dt: sampling period [s].
        rear: distance l from the rear axle to the position of the vehicle [m]; at
            walking pace the slip at that position is l κ.
    """

    law: PathLaw
    conditions: Conditions
    dt: float
    rear: float

    def applies(self, xi: PathState, road: Float[Array, " 2"]) -> Bool[Array, ""]:
        """Return whether the car or its reference is slower than the conditions."""
        state_box = self.conditions.state
        road_box = self.conditions.road
        slowest = -jnp.inf if state_box is None else state_box[0][PATH_SPEED]
        slow = xi[PATH_SPEED] < slowest
        if road_box is None:
            return slow
        return slow | (road[1] < road_box[0][1])

    def growth(self, xi: PathState, road: Float[Array, " 2"], steady: Scalar) -> Scalar:
        """Return how far a step moves the car across the path, v dt |sin χ| [m].

        Args:
            xi: ξ.
            road: κ [1/m] and v_ref [m/s].
            steady: ψ*, the e_ψ of the steady turn [rad].
        """
        slowest = self.law.low[1]
        # The table of the law ends at its lowest speed. Below that speed the tyres slip
        # less, and the car turns about its rear axle.
        slower = 1.0 - jnp.minimum(road[1] / slowest, 1.0) ** 2
        course = xi[HEADING] - steady + self.rear * road[0] * slower
        return self.dt * jnp.abs(xi[PATH_SPEED] * jnp.sin(course))
