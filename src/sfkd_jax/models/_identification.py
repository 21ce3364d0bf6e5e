"""Identification of linear predictors by ridge regression, free or with operators bounded in norm."""

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
    """W = argmin |X W − Y|² + λ N |D W|² for every λ, D the root mean squares of the columns of X.

    By an orthogonal factorisation of [X D⁻¹, Y] and never by X'X, whose condition
    float32 does not hold.

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
    """Operators and input map that predict best among those whose operators are bounded in norm (eq:koopid).

        min Σ_k |z⁺_k − Σ_j w_j(e_k) A_j z_k − B v_k|² + λ N (Σ_j |A_j D_j|² + |B D_v|²)   with   ||A_j||_2 ≤ ρ

    so that ||A(e)||_2 ≤ ρ for every mixture w(e) on the simplex; D are root mean
    squares of the regressors. Where the bound is slack this is ridge regression, in
    closed form. Where it binds there is no closed form: the singular values of the
    ridge solution are clipped, which is feasible and no more, and accelerated projected
    gradient steps, B eliminated, go down from there. B is the best one for the A_j that
    are returned.

    Args:
        states, targets: z and z⁺, less what else predicts it.
        mixtures: w(e), each on the simplex.
        inputs: v, products of features of e and entries of u for a B that varies with
            e.
        bound: ρ.
        ridge: λ > 0.
        iterations: projected steps; 0 leaves the clipped ridge solution.

    Source: Beck and Teboulle (2009); restarts of the momentum by O'Donoghue and Candès
    (2015).
    """
    rank, columns = states.shape[1], inputs.shape[1]
    products = (mixtures[:, :, None] * states[:, None, :]).reshape(states.shape[0], -1)
    triangle, spread = _factorised(jnp.concatenate([inputs, products], axis=1), targets)
    upper, right = _ridged(triangle, spread.shape[0], ridge * states.shape[0])
    # B comes first: whatever A is, B makes the first rows of the residual 0, and the
    # rows below are about A alone
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
    """Accelerated projected gradient on |curve A − goal|², its momentum dropped whenever it points uphill."""
    length = 1.0 / jnp.linalg.norm(curve, 2) ** 2

    def step(
        carry: tuple[Array, Array, Array], _: None
    ) -> tuple[tuple[Array, Array, Array], None]:
        here, ahead, momentum = carry
        slope = curve.T @ (curve @ ahead - goal)
        there = _clipped(ahead - length * slope, bound)
        momentum = jnp.where(
            jnp.sum((ahead - there) * (there - here)) > 0, 1.0, momentum
        )
        later = (1.0 + jnp.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
        return (there, there + (momentum - 1.0) / later * (there - here), later), None

    (reached, _, _), _ = jax.lax.scan(step, (start, start, jnp.ones(())), length=steps)
    return reached


def _clipped(stacked: Float[Array, "n rank"], bound: float) -> Float[Array, "n rank"]:
    """The nearest operators, stacked, with singular values of at most the bound."""
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
    """The first p rows, or as many as there are, of R in [X D⁻¹, Y] = Q R, and the diagonal of D."""
    spread = jnp.sqrt(jnp.mean(inputs**2, axis=0))
    spread = jnp.where(spread > 0, spread, 1.0)
    triangle = jnp.linalg.qr(
        jnp.concatenate([inputs / spread, targets], axis=1), mode="r"
    )
    return triangle[: inputs.shape[1]], spread


def _ridged(
    triangle: Float[Array, "rows columns"], columns: int, ridge: Scalar | float
) -> tuple[Float[Array, "p p"], Float[Array, "p q"]]:
    """U, upper triangular, and V with |X W − Y|² + ridge |D W|² = |U D W − V|² + what no W changes, X of p columns."""
    stacked = jnp.concatenate(
        [triangle[:, :columns], jnp.sqrt(ridge) * jnp.eye(columns)]
    )
    orthogonal, upper = jnp.linalg.qr(stacked)
    return upper, orthogonal[: triangle.shape[0]].T @ triangle[:, columns:]
