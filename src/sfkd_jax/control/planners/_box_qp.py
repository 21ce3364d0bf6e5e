"""Box-constrained quadratic programs by the projected Newton method."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from sfkd_jax.types import Scalar

HALVINGS = 12
"""Number of step lengths 1, 1/2, … tried along the projected Newton direction."""


class BoxSolution(NamedTuple):
    """The solution of a box-constrained quadratic program.

    Attributes:
        primal: x, inside the box.
        residual: max_i |x − clip(x − ∇ / diag H)|_i in units of x; 0 at the optimum.
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
    """Minimise ½ xᵀ H x + fᵀ x subject to low ≤ x ≤ high, for H > 0.

        x_f ← clip(x_f − 2⁻ʲ H_ff⁻¹ ∇_f)

    The active set holds the entries at a bound where descent points outward; the free
    entries f take a Newton step of the reduced problem, with the j of the lowest cost.
    The solution is exact one step after the active set is right, so a good warm start
    needs one iteration. The cost never increases, and a step that is not finite is not
    taken.

    Args:
        H: Hessian of the cost, positive definite.
        f: linear term of the cost.
        low: lower bounds.
        high: upper bounds, high ≥ low.
        start: initial guess, clipped to the box.
        iterations: fixed number; each is one Cholesky factorisation.

    Source: Bertsekas (1982); Tassa, Mansard and Todorov (2014), section III.
    """
    lengths = 0.5 ** jnp.arange(HALVINGS)[:, None]
    diagonal = jnp.diagonal(H)

    def improve(x: Float[Array, " n"], _: None) -> tuple[Float[Array, " n"], None]:
        slope = H @ x + f
        active = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        reduced = jnp.where(active[:, None] | active, jnp.diag(diagonal), H)
        newton = -cho_solve(cho_factor(reduced), jnp.where(active, 0.0, slope))
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
