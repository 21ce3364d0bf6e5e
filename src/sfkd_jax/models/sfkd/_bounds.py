"""Upper bounds on matrix norms from matrix products only: smooth and cheap."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Scalar

FLOAT32_MARGIN = 1e-5
"""Relative margin for float32 rounding inside the Gram iteration (measured: 2.2e-6)."""
GRAM_ITERATIONS = 6


def gram_bound(
    matrix: Float[Array, "rows columns"], *, iterations: int = GRAM_ITERATIONS
) -> Scalar:
    """Return an upper bound on ||M||_2, too large by a factor r^(1/2^(k+1)) at most.

    Gram iteration: G_0 = M, G_{k+1} = G_k' G_k rescaled to unit Frobenius norm; ||M||_2
    ≤ ||G_k||_F^(1/2^k), scales undone. It needs no singular vectors, so the gradient is
    finite at repeated singular values. Source: Delattre et al., arXiv 2305.16173.

    Args:
        matrix: any shape.
        iterations: k.
    """
    scale = _frobenius(matrix)
    gram = matrix / scale
    log_norm = jnp.log(scale)
    power = 1.0
    for _ in range(iterations):
        gram = gram.T @ gram
        power /= 2.0
        scale = _frobenius(gram)
        gram = gram / scale
        log_norm = log_norm + power * jnp.log(scale)
    return jnp.exp(log_norm)


def bounded(
    matrix: Float[Array, "rows columns"], bound: float
) -> Float[Array, "rows columns"]:
    """Return M · ρ / max(ρ, gram(M)(1 + margin)), whose 2-norm is at most ρ.

    A matrix with a Gram bound below ρ is returned as it is, up to the margin.
    """
    norm = gram_bound(matrix) * (1.0 + FLOAT32_MARGIN)
    return matrix * (bound * (1.0 - FLOAT32_MARGIN) / jnp.maximum(bound, norm))


def unbounded(matrix: Float[Array, "rows columns"]) -> Float[Array, "rows columns"]:
    """Return what `bounded` maps to this matrix, whose norm is at most `attainable`."""
    return matrix / (1.0 - FLOAT32_MARGIN)


def attainable(bound: float, size: int) -> float:
    """Return the norm up to which `bounded` attains every square matrix of this size.

    Beyond it the Gram bound may exceed ρ. Equal singular values are the worst case: the
    Gram bound is then size^(1/2^(k+1)) times the norm.
    """
    return bound * (1.0 - 3.0 * FLOAT32_MARGIN) / size ** (0.5 ** (GRAM_ITERATIONS + 1))


def _frobenius(matrix: Float[Array, "rows columns"]) -> Scalar:
    """||M||_F, away from zero so that its logarithm and gradient exist."""
    return jnp.sqrt(jnp.sum(matrix**2) + 1e-24)
