"""Ridge regression of linear predictors, free or with operators bounded in norm."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from sfkd_jax.types import Scalar


def ridge_regression(
    inputs: Float[Array, "sample p"],
    targets: Float[Array, "sample q"],
    ridges: Float[Array, " ridge"],
) -> Float[Array, "ridge p q"]:
    """Return W = argmin |X W − Y|² + λ N |D W|² for every λ.

    D are the root mean squares of the columns of X. Solved by an orthogonal
    factorisation of [X D⁻¹, Y] instead of X'X, which float32 cannot resolve.

    Args:
        inputs: X.
        targets: Y.
        ridges: λ > 0.
    """
    triangle, spread = _factorised(inputs, targets)

    def solve(ridge: Scalar) -> Float[Array, "p q"]:
        upper, right = _ridged(triangle, inputs.shape[1], ridge * inputs.shape[0])
        return solve_triangular(upper, right) / spread[:, None]

    return jax.lax.map(solve, ridges)


def bounded_ridge(
    states: Float[Array, "sample state"],
    mixtures: Float[Array, "sample vertex"],
    inputs: Float[Array, "sample p"],
    targets: Float[Array, "sample state"],
    *,
    bound: float,
    ridge: float = 1e-4,
    iterations: int = 200,
) -> tuple[Float[Array, "vertex state state"], Float[Array, "state p"]]:
    """Return the best predictor whose operators are bounded in norm (eq:koopid).

        min Σ_k |z⁺_k − Σ_j w_j(e_k) A_j z_k − B v_k|²
            + λ N (Σ_j |A_j D_j|² + |B D_v|²)   with   ||A_j||_2 ≤ ρ

    so that ||A(e)||_2 ≤ ρ for every mixture w(e) on the simplex; D are root mean
    squares of the regressors. Where the bound is slack, this is ridge regression in
    closed form. Where it is active, the singular values of the ridge solution are
    clipped, which is feasible but not optimal, and accelerated projected gradient steps
    with B eliminated start from there. B is the best one for the A_j returned.

    Args:
        states: z.
        mixtures: w(e), each on the simplex.
        inputs: v, products of features of e and entries of u for a B that varies with
            e.
        targets: z⁺, minus every other term of the prediction.
        bound: ρ.
        ridge: λ > 0.
        iterations: projected steps; 0 returns the clipped ridge solution.

    Returns:
        A_j, (vertex, state, state), and B, (state, p).

    Source: Beck and Teboulle (2009); restarts of the momentum by O'Donoghue and Candès
    (2015).
    """
    rank, columns = states.shape[1], inputs.shape[1]
    products = (mixtures[:, :, None] * states[:, None, :]).reshape(states.shape[0], -1)
    triangle, spread = _factorised(jnp.concatenate([inputs, products], axis=1), targets)
    upper, right = _ridged(triangle, spread.shape[0], ridge * states.shape[0])
    # B comes first: for any A, B makes the first rows of the residual 0, and the rows
    # below depend on A alone.
    curve, goal = upper[columns:, columns:] * spread[columns:], right[columns:]
    free = solve_triangular(curve, goal)
    stacked = _descend(curve, goal, _clipped(free, bound), bound, iterations)
    rest = right[:columns] - upper[:columns, columns:] @ (
        stacked * spread[columns:, None]
    )
    gains = solve_triangular(upper[:columns, :columns], rest) / spread[:columns, None]
    return stacked.reshape(-1, rank, rank).swapaxes(1, 2), gains.T


def _descend(
    curve: Float[Array, "n n"],
    goal: Float[Array, "n rank"],
    start: Float[Array, "n rank"],
    bound: float,
    steps: int,
) -> Float[Array, "n rank"]:
    """Minimise |curve A − goal|² by projected gradient, accelerated, with restarts."""
    length = 1.0 / jnp.linalg.norm(curve, 2) ** 2

    def step(
        carry: tuple[Array, Array, Array], _: None
    ) -> tuple[tuple[Array, Array, Array], None]:
        previous, ahead, momentum = carry
        slope = curve.T @ (curve @ ahead - goal)
        point = _clipped(ahead - length * slope, bound)
        uphill = jnp.sum((ahead - point) * (point - previous)) > 0
        momentum = jnp.where(uphill, 1.0, momentum)
        later = (1.0 + jnp.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
        ahead = point + (momentum - 1.0) / later * (point - previous)
        return (point, ahead, later), None

    (best, _, _), _ = jax.lax.scan(step, (start, start, jnp.ones(())), length=steps)
    return best


def _clipped(stacked: Float[Array, "n rank"], bound: float) -> Float[Array, "n rank"]:
    """Project stacked operators onto those with singular values below the bound."""
    rank = stacked.shape[1]
    left, values, right = jnp.linalg.svd(stacked.reshape(-1, rank, rank))
    inside = (left * jnp.minimum(values, bound)[:, None, :]) @ right
    slack = values[:, :1, None] <= bound
    return jnp.where(slack, stacked.reshape(inside.shape), inside).reshape(
        stacked.shape
    )


def _factorised(
    inputs: Float[Array, "sample p"], targets: Float[Array, "sample q"]
) -> tuple[Float[Array, "rows columns"], Float[Array, " p"]]:
    """The first p rows, at most, of R in [X D⁻¹, Y] = Q R, and the diagonal of D."""
    spread = jnp.sqrt(jnp.mean(inputs**2, axis=0))
    spread = jnp.where(spread > 0, spread, 1.0)
    triangle = jnp.linalg.qr(
        jnp.concatenate([inputs / spread, targets], axis=1), mode="r"
    )
    return triangle[: inputs.shape[1]], spread


def _ridged(
    triangle: Float[Array, "rows columns"], columns: int, ridge: Scalar | float
) -> tuple[Float[Array, "p p"], Float[Array, "p q"]]:
    """Return U, upper triangular, and V of the regularised least squares problem.

    |X W − Y|² + ridge |D W|² = |U D W − V|² + a constant, X of p columns.
    """
    stacked = jnp.concatenate(
        [triangle[:, :columns], jnp.sqrt(ridge) * jnp.eye(columns)]
    )
    orthogonal, upper = jnp.linalg.qr(stacked)
    return upper, orthogonal[: triangle.shape[0]].T @ triangle[:, columns:]
