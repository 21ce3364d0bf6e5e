"""Planar poses g = (p_x [m], p_y [m], yaw [rad]): composition, difference, wrapping."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def wrap_angle(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the same angle in [-π, π], with gradient 1."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def rotate(angle: Float[Array, ""], vector: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Return R(angle) vector."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def compose(
    pose: Float[Array, " 3"], increment: Float[Array, " 3"]
) -> Float[Array, " 3"]:
    """Return g ∘ Δ, the pose after a motion Δ in the frame of g; yaw is not wrapped."""
    position = pose[:2] + rotate(pose[2], increment[:2])
    return jnp.concatenate([position, pose[2:] + increment[2:]])


def between(
    pose: Float[Array, " 3"], pose_next: Float[Array, " 3"]
) -> Float[Array, " 3"]:
    """Return g⁻¹ ∘ g', the motion from g to g' in the frame of g, yaw wrapped."""
    position = rotate(-pose[2], pose_next[:2] - pose[:2])
    return jnp.concatenate([position, wrap_angle(pose_next[2:] - pose[2:])])
