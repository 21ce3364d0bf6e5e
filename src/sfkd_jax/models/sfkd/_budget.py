"""One contraction bound that the operator and the residual share."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models.sfkd._bounds import bounded
from sfkd_jax.models.sfkd._sandwich import Weights
from sfkd_jax.types import Scalar

LARGEST_COUPLING = 0.999
"""Bound of ||G||_2 and ||H||_2, so that I − G G' and I − H'H have a Cholesky factor in
float32.
"""


def share_budget(
    operators: Float[Array, "vertex rank rank"],
    couplings: Float[Array, "2 rank rank"],
    network: Weights,
    alpha: float | Scalar,
) -> tuple[Float[Array, "vertex rank rank"], Weights]:
    """Return operators and a residual such that A_j z + G φ(α H z) is α-Lipschitz.

        A_j = α L M_j R',   L L' = I − G G',   R R' = I − H'H,
        ||M_j||_2, ||G||_2, ||H||_2 ≤ 1,   φ 1-Lipschitz

    This is Parrott's parametrisation of all matrices [[A_j/α, G], [H, 0]] with norm at
    most 1; hence |A dz + G dw|² + |α H dz|² ≤ α²|dz|² + |dw|², and |dw| ≤ |α H dz|.
    Where the residual does not use a direction, the operator has the whole of α: ||A||
    + Lip r may exceed 1, but their sum as one map cannot. By convexity the same holds
    for every mixture of the A_j. The multipliers of φ are a witness of the joint bound.

    Args:
        operators: M_j before bounding.
        couplings: (G, H) before bounding.
        network: φ, bounded by 1.
        alpha: α in (0, 1).

    Returns:
        A_j, and the residual with G and α H folded into its last and first weights.
    """
    out, into = (bounded(matrix, LARGEST_COUPLING) for matrix in couplings)
    left, right = _factors(out, into)
    vertices = (
        alpha
        * left
        @ jax.vmap(lambda matrix: bounded(matrix, 1.0))(operators)
        @ right.T
    )
    first, *middle, last = network.matrices
    return vertices, Weights(
        (alpha * first @ into, *middle, out @ last), network.multipliers
    )


def budget_factors(
    couplings: Float[Array, "2 rank rank"],
) -> tuple[Float[Array, "rank rank"], Float[Array, "rank rank"]]:
    """Return L and R of `share_budget`, lower triangular."""
    out, into = (bounded(matrix, LARGEST_COUPLING) for matrix in couplings)
    return _factors(out, into)


def _factors(
    out: Float[Array, "rank rank"], into: Float[Array, "rank rank"]
) -> tuple[Float[Array, "rank rank"], Float[Array, "rank rank"]]:
    """Cholesky factors of I − G G' and I − H'H."""
    identity = jnp.eye(out.shape[0])
    return jnp.linalg.cholesky(identity - out @ out.T), jnp.linalg.cholesky(
        identity - into.T @ into
    )
