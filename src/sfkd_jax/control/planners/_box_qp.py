"""Quadratic programs under box constraints, by projected Newton steps."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from sfkd_jax.types import Scalar

HALVINGS = 12
"""Step lengths 1, 1/2, … tried along the projected Newton direction."""


class BoxSolution(NamedTuple):
    """What was found.

    Attributes:
        primal: x, inside the box.
        residual: max_i |x − clip(x − ∇/diag H)|_i, 0 at the optimum, in units of x.
    """

    primal: Float[Array, " n"]
    residual: Scalar


def box_qp(
    H: Float[Array, "n n"],
    f: Float[Array, " n"],
    low: Float[Array, " n"],
    high: Float[Array, " n"],
    start: Float[Array, " n"],
    *,
    iterations: int = 12,
) -> BoxSolution:
    """min ½ xᵀ H x + fᵀ x subject to low ≤ x ≤ high, for H > 0.

    Entries that sit at a bound and whose gradient pushes outward are held; the others
    take the Newton step of the reduced problem, x ← clip(x − 2⁻ʲ H_ff⁻¹ ∇_f), with the
    j of the lowest cost. It is exact one step after the set of held entries is right,
    so a warm start that guesses them is solved at once. The cost never rises, and a
    step that is not finite is not taken.

    Args:
        H, f: the cost.
        low, high: the box, low ≤ high.
        start: where to begin, clipped into the box.
        iterations: fixed; each is one Cholesky factorisation.

    Source: Bertsekas (1982); Tassa, Mansard and Todorov (2014), section III.
    """
    lengths = 0.5 ** jnp.arange(HALVINGS)[:, None]
    diagonal = jnp.diagonal(H)

    def improve(x: Float[Array, " n"], _: None) -> tuple[Float[Array, " n"], None]:
        slope = H @ x + f
        held = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        reduced = jnp.where(held[:, None] | held, jnp.diag(diagonal), H)
        newton = -cho_solve(cho_factor(reduced), jnp.where(held, 0.0, slope))
        candidates = jnp.clip(x + lengths * newton, low, high)
        moves = candidates - x
        change = moves @ slope + 0.5 * jnp.sum((moves @ H) * moves, axis=1)
        change = jnp.where(jnp.isfinite(change), change, jnp.inf)
        best = jnp.argmin(change)
        return jnp.where(change[best] < 0, candidates[best], x), None

    x, _ = jax.lax.scan(improve, jnp.clip(start, low, high), length=iterations)
    return BoxSolution(
        x, jnp.max(jnp.abs(x - jnp.clip(x - (H @ x + f) / diagonal, low, high)))
    )
