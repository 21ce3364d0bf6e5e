"""Isometric transport between fibers: T(e → e') = Q(e') Q(e)', Q(e) orthogonal."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def rotate_planes(
    tangents: Float[Array, " plane"], z: Float[Array, " rank"]
) -> Float[Array, " rank"]:
    """Return Q z, where Q rotates plane i = (z_i, z_{i + r/2}) by 2 arctan t_i.

    Q = (I − S)⁻¹(I + S) is the Cayley transform of S = diag(t_i J), J = [[0, −1], [1,
    0]], in closed form; −t inverts t exactly.

    This Q is as general as a full orthogonal Q(e): in the coordinates Q(e)' z the
    transport is the identity and A(e), B(e) and the networks are conjugated, which a
    model with free A(e), B(e) represents anyway. What matters is that T is an isometry,
    T(e → e) = I, and a cocycle.

    Args:
        tangents: t, one entry per plane.
        z: of even length.
    """
    first, second = jnp.split(z, 2)
    scale = 1.0 / (1.0 + tangents**2)
    cosine, sine = (1.0 - tangents**2) * scale, 2.0 * tangents * scale
    return jnp.concatenate(
        [cosine * first - sine * second, sine * first + cosine * second]
    )
