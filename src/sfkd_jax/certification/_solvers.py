"""Proposals from semidefinite programs, feasible for widths up to about 32."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sfkd_jax.certification._core import Matrix

MARGIN = 1e-6
"""Relative tightening of constraints, which solvers may violate slightly."""


def solve_multipliers(
    weights: Sequence[Matrix], linear: Matrix | None = None, *, solver: str = "CLARABEL"
) -> list[Any]:
    """Return the diagonal multipliers of the LipSDP optimum by cvxpy.

    For f = A z + W_L σ(… W_1 z …), minimise b² over λ ≥ 0 such that the matrix of
    `check_witness` is positive semidefinite.

    Args:
        weights: W_1 … W_L.
        linear: A, or None.
        solver: a conic solver of cvxpy.

    Returns:
        λ_1 … λ_{L-1}, or an empty list if the solver returns no values. The status of
        the solver is ignored.
    """
    import cvxpy as cp  # an optional dependency

    widths = [weight.shape[0] for weight in weights[:-1]]
    inputs = weights[0].shape[1]
    multipliers = [cp.Variable(width, nonneg=True) for width in widths]
    square = cp.Variable()
    corner = square * np.eye(inputs) - (0.0 if linear is None else linear.T @ linear)
    last = np.zeros((weights[-1].shape[0], inputs)) if linear is None else linear
    size = len(widths) + 1
    blocks: list[list[Any]] = [[None] * size for _ in range(size)]
    shapes = [inputs, *widths]
    for row in range(size):
        for column in range(size):
            blocks[row][column] = np.zeros((shapes[row], shapes[column]))
    blocks[0][0] = corner
    for k, multiplier in enumerate(multipliers):
        coupling = -cp.diag(multiplier) @ weights[k]
        blocks[k + 1][k], blocks[k][k + 1] = coupling, coupling.T
        blocks[k + 1][k + 1] = 2 * cp.diag(multiplier)
    blocks[-1][-1] = blocks[-1][-1] - weights[-1].T @ weights[-1]
    blocks[0][-1] = blocks[0][-1] - last.T @ weights[-1]
    blocks[-1][0] = blocks[0][-1].T
    matrix = cp.bmat(blocks)
    feasible = 0.5 * (matrix + matrix.T) >> 0
    _solve(cp, cp.Problem(cp.Minimize(square), [feasible]), solver)
    values = [multiplier.value for multiplier in multipliers]
    if any(value is None for value in values):
        return []
    return [np.asarray(value, dtype=np.float64) for value in values]


def solve_metric(
    operators: Sequence[Matrix], rate: float, *, solver: str = "CLARABEL"
) -> Matrix | None:
    """Return a common Lyapunov matrix of the smallest condition number by cvxpy.

    Minimise κ over I ⪯ P ⪯ κ I such that A' P A ⪯ ρ² P for every operator A.

    Args:
        operators: the vertices.
        rate: ρ.
        solver: a conic solver of cvxpy.

    Returns:
        P, symmetric, or None if the solver returns no values; `certify` recomputes ρ
        and κ from it.
    """
    import cvxpy as cp  # an optional dependency

    size = operators[0].shape[0]
    metric, condition = cp.Variable((size, size), symmetric=True), cp.Variable()
    bounds: list[Any] = [metric >> np.eye(size), condition * np.eye(size) - metric >> 0]
    decreases = [
        (rate * (1 - MARGIN)) ** 2 * metric - a.T @ metric @ a >> 0 for a in operators
    ]
    _solve(cp, cp.Problem(cp.Minimize(condition), bounds + decreases), solver)
    if metric.value is None:
        return None
    solution = np.asarray(metric.value, dtype=np.float64)
    return 0.5 * (solution + solution.T)


def _solve(cp: Any, problem: Any, solver: str) -> None:
    """Run a solver; after a failure the variables have no values."""
    try:
        problem.solve(solver=solver)
    except (cp.SolverError, ValueError, ArithmeticError):
        return
