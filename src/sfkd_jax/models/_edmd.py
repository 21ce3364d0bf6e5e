"""Extended dynamic mode decomposition: radial functions and pairs along circles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import between, compose, wrap_angle
from sfkd_jax.types import BODY, POSE, Scalar, State

STRAIGHT = 1e-12
"""Smallest curvature [1/m], so that nothing divides by 0."""


def thin_plate(
    point: Float[Array, " n"], centres: Float[Array, "function n"]
) -> Float[Array, " function"]:
    """Return r² log r of the distances r to every centre; 0 at r = 0."""
    squares = jnp.sum((point - centres) ** 2, axis=1)
    positive = squares > 0
    return jnp.where(
        positive, 0.5 * squares * jnp.log(jnp.where(positive, squares, 1.0)), 0.0
    )


def along_circle(
    states: Float[Array, "time state"], offset: Float[Array, " 2"], curvature: Scalar
) -> Float[Array, "time state"]:
    """Return states relative to a circle from which the first one has a given offset.

        e_y = (2Y − κ (X² + Y²)) / (1 + D),   s = atan2(κX, 1 − κY) / κ,
        e_ψ = Θ − κ s,   D = |(κX, 1 − κY)|,

    (X, Y, Θ) the pose in the frame of the circle's point closest to the first state.

    Args:
        states: x_0 … x_T.
        offset: e_y [m] and e_ψ [rad] of x_0.
        curvature: κ [1/m].

    Returns:
        (s, e_y, e_ψ, body state) at every time: exact, and finite up to the centre of
        the circle.
    """
    kappa = jnp.where(jnp.abs(curvature) < STRAIGHT, STRAIGHT, curvature)
    tangent = states[0, POSE].at[2].add(-offset[1])
    foot = compose(tangent, jnp.stack([jnp.zeros(()), -offset[0], jnp.zeros(())]))

    def one(state: State) -> State:
        x, y, yaw = between(foot, state[POSE])
        across, along = 1.0 - kappa * y, kappa * x
        turned = jnp.arctan2(along, across)
        left = (2.0 * y - kappa * (x**2 + y**2)) / (1.0 + jnp.hypot(along, across))
        return jnp.concatenate(
            [jnp.stack([turned / kappa, left, wrap_angle(yaw - turned)]), state[BODY]]
        )

    return jax.vmap(one)(states)
