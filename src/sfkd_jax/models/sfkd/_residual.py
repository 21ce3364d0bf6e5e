"""The residual of SFKD, and the bound of a step.

A residual is an entry of `RESIDUALS`: a flax module that is called like `Sandwich`, and
whose `is_bounded` says whether its weights keep the bound that it is called with. Its
value is W_L σ(… W_1 z + b_1(u, e) …) + b_L(u, e), because `Explicit` can state, and the
trusted core can check, no other form. What planners alone add is in `Planning`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.models._networks import Free, Sandwich, Weights, bounded
from sfkd_jax.types import Scalar

LARGEST_COUPLING = 0.999
"""Bound of ||G||_2 and ||H||_2, so that I − G G' and I − H'H have a Cholesky factor in
float32.
"""
BUDGETS = ("joint", "sum")
RESIDUALS = {"sandwich": Sandwich, "free": Free, "none": None}
"""(inputs, hidden widths, outputs) -> flax module, by name; None for no residual. With
a `Free` residual a step does not contract by construction.
"""


def separate_budget(
    operators: Float[Array, "vertex rank rank"], rho: float
) -> Float[Array, "vertex rank rank"]:
    """Return A_j with ||A_j||_2 ≤ ρ, whatever the residual is."""
    # Each vertex is bounded, so a mixture is below ρ by convexity.
    return jax.vmap(partial(bounded, bound=rho))(operators)


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

    `operators` M_j and `couplings` (G, H) are bounded here, `network` φ is. Returns A_j
    and the residual with G and α H folded into its last and first weights.
    """
    out, into = (bounded(matrix, LARGEST_COUPLING) for matrix in couplings)
    # Cholesky factors instead of square roots, since any L with L L' = I − G G' serves.
    identity = jnp.eye(out.shape[0])
    left = jnp.linalg.cholesky(identity - out @ out.T)
    right = jnp.linalg.cholesky(identity - into.T @ into)
    # All vertices share (L, R), since the residual is the same for each of them.
    vertices = alpha * left @ separate_budget(operators, 1.0) @ right.T
    # G and H become part of the network, so that the certified weights are those that
    # are multiplied. α is at the input alone; at both ends it would count twice.
    first, *middle, last = network.matrices
    matrices = (alpha * first @ into, *middle, out @ last)
    return vertices, Weights(matrices, network.multipliers)
