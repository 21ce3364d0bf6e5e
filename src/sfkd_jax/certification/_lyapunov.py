"""The paper's semidefinite program: a common Lyapunov matrix of least condition.

The solver (cvxpy with clarabel) proposes; the trusted core decides.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from sfkd_jax.certification._claims import (
    COMPILATION_SLACK,
    LyapunovClaim,
    Refuted,
    keeps_metrics,
)
from sfkd_jax.certification._core import Matrix, check_metric, check_vertices
from sfkd_jax.certification._search import joint_bound
from sfkd_jax.certification._weights import Exported
from sfkd_jax.types import Polytope

MARGIN = 1e-6
"""Relative tightening of constraints, which solvers may violate slightly."""
SHARES = (0.5, 0.75, 0.9)
"""Rates that are tried, between the largest spectral radius of a vertex (0), below
which there is no P, and the largest 2-norm (1), at which P = I.
"""
SLACKS = (1e-9, 1e-7, 1e-5, 1e-3)
MISSING = (
    "no Lyapunov matrix: cvxpy or clarabel is not installed "
    "(pip install 'sfkd_jax[certify]')"
)


def prove_lyapunov(weights: Exported) -> LyapunovClaim:
    """Solve the program at the smallest of the `SHARES` that has an accepted answer.

    Args:
        weights: explicit, float64, finite.

    Raises:
        Refuted: no solver is installed, the model admits no metric but I, or no answer
            was accepted; gives the reason.
    """
    # A rotation on a switch of e keeps no ellipsoid, only the ball.
    if not keeps_metrics(weights):
        raise Refuted(
            "P = I is the only metric that the transport keeps: c_1 = c_2 = 1"
        )
    vertices = list(weights.operators.vertices)
    norm = max(np.linalg.norm(vertex, 2) for vertex in vertices)
    # No P gives a rate below a spectral radius, by which the search is bounded.
    radius = max(np.max(np.abs(np.linalg.eigvals(vertex))) for vertex in vertices)
    # From the smallest rate up: the first accepted one has the best rate.
    for share in SHARES:
        rate = float(radius + share * (norm - radius))
        metric = solve_metric(vertices, rate)
        claim = None if metric is None else accepted(metric, weights)
        # A solver that reports success may still have violated a constraint
        if claim is not None:
            return claim
    raise Refuted("the solver found no common Lyapunov matrix that the core accepts")


def accepted(metric: Matrix, weights: Exported) -> LyapunovClaim | None:
    """Return the smallest constants of a proposed P that the core accepts, or None.

    Args:
        metric: P, from an untrusted solver.
        weights: explicit, float64, finite.
    """
    metric, vertices = np.asarray(metric, dtype=np.float64), weights.operators.vertices
    if metric.shape != vertices.shape[1:] or not np.all(np.isfinite(metric)):
        return None
    # Symmetric before eigenvalues, which read one triangle only.
    metric = 0.5 * (metric + metric.T)
    values = np.linalg.eigvalsh(metric)
    if not 0 < values[0] <= values[-1] < np.inf:
        return None
    metric /= values[0]  # scale is free, and λ_min = 1 is far from under- and overflow
    step, listed = _in_coordinates(weights, metric), list(vertices)
    rate = max(np.linalg.norm(vertex, 2) for vertex in step.operators.vertices)
    alpha, joint = joint_bound(step, weights.residual_multipliers)
    # Rounding decides how little slack the core accepts; the smallest is kept.
    for slack in SLACKS:
        claim = LyapunovClaim(
            rho=float(COMPILATION_SLACK * rate * (1 + slack)),
            condition=float(values[-1] / values[0] * (1 + slack)),
            alpha=float(alpha * (1 + slack)),
            metric=metric,
            joint=[[np.asarray(part) for part in vertex] for vertex in joint],
        )
        if (
            claim.rho < 1.0
            and check_metric(metric, listed, claim.rho, claim.condition)
            and check_vertices(
                weights.residual, claim.joint, claim.alpha, listed, metric
            )
        ):
            return claim
    return None


def _in_coordinates(weights: Exported, metric: Matrix) -> Exported:
    """The step in coordinates L'z with P = L L', in which |·|_P is the 2-norm."""
    root = np.linalg.cholesky(metric).T
    back = np.linalg.inv(root)
    # The first weights read z and the last write it; hidden layers stay as they are.
    residual = [*weights.residual]
    if residual:
        residual[0] = residual[0] @ back
        residual[-1] = root @ residual[-1]
    vertices = root @ weights.operators.vertices @ back
    return weights._replace(
        operators=Polytope(vertices),
        residual=tuple(residual),
    )


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
        P, symmetric, or None if the solver returns no values. Its status is ignored.

    Raises:
        Refuted: cvxpy or the solver is not installed.
    """
    try:
        import cvxpy as cp  # an optional dependency
    except ImportError:
        raise Refuted(MISSING) from None
    if solver not in cp.installed_solvers():
        raise Refuted(MISSING)
    size = operators[0].shape[0]
    metric, condition = cp.Variable((size, size), symmetric=True), cp.Variable()
    # I ⪯ P fixes the scale, which is free otherwise, and makes κ the condition.
    bounds: list[Any] = [metric >> np.eye(size), condition * np.eye(size) - metric >> 0]
    decreases = [
        # A little tighter than claimed, since solvers meet constraints only nearly.
        (rate * (1 - MARGIN)) ** 2 * metric - a.T @ metric @ a >> 0
        for a in operators
    ]
    problem = cp.Problem(cp.Minimize(condition), bounds + decreases)
    try:
        with warnings.catch_warnings():
            # An inaccurate answer is judged by the core, not by a warning
            warnings.simplefilter("ignore")
            problem.solve(solver=solver)
    except (cp.SolverError, ValueError, ArithmeticError):
        return None
    if metric.value is None:
        return None
    solution = np.asarray(metric.value, dtype=np.float64)
    return 0.5 * (solution + solution.T)
