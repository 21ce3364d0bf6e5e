"""Search for metrics P, without a proof: of all operators together, and of an output.

The paper's semidefinite program (cvxpy with clarabel) proposes a common Lyapunov matrix
of least condition, L-BFGS a metric for each output. The trusted core decides.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from itertools import chain, pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from sfkd_jax.certification._claims import (
    COMPILATION_SLACK,
    ROTATES,
    LyapunovClaim,
    OutputMetric,
    contracts,
    keeps_metrics,
    reads_within,
    size_of,
)
from sfkd_jax.certification._core import Matrix, Vector, check_metric
from sfkd_jax.certification._search import INFEASIBLE, SLACKS, joint_bound, reduced
from sfkd_jax.certification._weights import (
    CertificationRefused,
    Exported,
    one_thread,
    require,
)
from sfkd_jax.types import Polytope

MARGIN = 1e-6
"""Relative tightening of constraints, which solvers may violate slightly."""
SHARES = (0.5, 0.75, 0.9)
"""Rates that are tried, between the largest spectral radius of a vertex (0), below
which there is no P, and the largest 2-norm (1), at which P = I.
"""
MISSING = (
    "no Lyapunov matrix: cvxpy or clarabel is not installed "
    "(pip install 'sfkd_jax[certify]')"
)
SHARPNESS = ((16.0, 40), (64.0, 60), (256.0, 100))
"""Exponents of the p-norms that smooth a maximum, with L-BFGS iterations for each."""
RUNS = 8
"""Exponent of the power mean over runs, a smooth stand-in for a high quantile."""


@one_thread()
def prove_lyapunov(weights: Exported) -> LyapunovClaim:
    """Solve the program at the smallest of the `SHARES` that has an accepted answer."""
    # A rotation on a switch of e keeps no ellipsoid, only the ball.
    require(keeps_metrics(weights), ROTATES)
    vertices = list(weights.operators.vertices)
    norm = max(np.linalg.norm(vertex, 2) for vertex in vertices)
    # No P gives a rate below a spectral radius, by which the search is bounded.
    radius = max(np.max(np.abs(np.linalg.eigvals(vertex))) for vertex in vertices)
    # From the smallest rate up: the first accepted one has the best rate.
    rates = (float(radius + share * (norm - radius)) for share in SHARES)
    solved = (solve_metric(vertices, rate) for rate in rates)
    # Last the ball, in which a step contracts by construction, whatever a solver says.
    for metric in chain(solved, [np.eye(len(vertices[0]))]):
        # A solver that reports success may still have violated a constraint
        if metric is not None and (claim := _accepted_lyapunov(metric, weights)):
            return claim
    raise CertificationRefused(
        "the solver found no common Lyapunov matrix that the core accepts"
    )


def solve_metric(operators: Sequence[Matrix], rate: float) -> Matrix | None:
    """Return a common Lyapunov matrix of the smallest condition number by cvxpy.

    Minimise κ over I ⪯ P ⪯ κ I such that A' P A ⪯ ρ² P for every operator A. None if
    the solver returns no values; its status is ignored.
    """
    try:
        import cvxpy as cp  # an optional dependency
    except ImportError:
        raise CertificationRefused(MISSING) from None
    require("CLARABEL" in cp.installed_solvers(), MISSING)
    identity = np.eye(len(operators[0]))
    metric = cp.Variable(identity.shape, symmetric=True)
    condition = cp.Variable()
    # I ⪯ P fixes the scale, which is free otherwise, and makes κ the condition.
    bounds: list[Any] = [metric >> identity, condition * identity - metric >> 0]
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
            problem.solve(solver="CLARABEL")
    except (cp.SolverError, ValueError, ArithmeticError):
        return None
    return None if metric.value is None else np.asarray(metric.value, np.float64)


def _accepted_lyapunov(metric: Matrix, weights: Exported) -> LyapunovClaim | None:
    """The smallest constants of a proposed P that the core accepts, or None."""
    metric = np.asarray(metric, dtype=np.float64)
    vertices = weights.operators.vertices
    if metric.shape != vertices.shape[1:] or not np.all(np.isfinite(metric)):
        return None
    # Symmetric before eigenvalues, which read one triangle only.
    metric = 0.5 * (metric + metric.T)
    values = np.linalg.eigvalsh(metric)
    if not 0 < values[0] <= values[-1] < np.inf:
        return None
    metric /= values[0]  # scale is free, and λ_min = 1 is far from under- and overflow
    step = _in_coordinates(weights, metric)
    rate = max(np.linalg.norm(vertex, 2) for vertex in step.operators.vertices)
    alpha, joint = joint_bound(step, weights.residual_multipliers)
    # Rounding decides how little slack the core accepts; the smallest is kept.
    for slack in SLACKS:
        claim = LyapunovClaim(
            rho=float(COMPILATION_SLACK * rate * (1 + slack)),
            condition=float(values[-1] / values[0] * (1 + slack)),
            alpha=float(alpha * (1 + slack)),
            metric=metric,
            joint=joint,
        )
        holds = check_metric(metric, list(vertices), claim.rho, claim.condition)
        if claim.rho < 1.0 and holds and contracts(claim, weights):
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
    return weights._replace(operators=Polytope(vertices), residual=tuple(residual))


@one_thread()
def propose_metric(
    weights: Exported,
    rows: Matrix,
    gaps: Float[np.ndarray, "run worst rank"],
    start: Matrix | None = None,
) -> OutputMetric:
    """Minimise |C|_{P⁻¹} q(|d|_P) / (1 − α_P) over metrics P.

    The variables are L with P = L L' and the multipliers of every vertex. In
    coordinates L'z the step has A' = L'A L'⁻¹, W_1' = W_1 L'⁻¹ and W_L' = L'W_L. The
    Schur complement of the hidden layers gives α² as a differentiable eigenvalue.

    `rows` is C, `gaps` are d of the worst steps of every run, not of the calibration
    split. The search starts at `start`, the Lyapunov matrix of the operators, or at I.
    """
    vertices = weights.operators.vertices
    multipliers = weights.residual_multipliers
    rank = vertices.shape[-1]
    lower = np.tril_indices(vertices.shape[-1])
    entries = len(lower[0])
    # Logarithms: multipliers stay positive in an unconstrained search.
    logs = [np.log(np.concatenate([*multipliers, []]))] * len(vertices)
    begins = [np.eye(rank)]
    # Scaled to the trace of I: both starts have entries of the same size.
    if start is not None:
        begins.append(np.linalg.cholesky(start * (rank / np.trace(start))))
    candidates = [np.concatenate([begin[lower], *logs]) for begin in begins]
    given = vertices, weights.residual, rows.T, gaps

    def objective(flat: Vector, sharpness: float) -> tuple[float, Vector]:
        loss, gradient = _log_radius(flat, sharpness, *given)
        # NaN of the Cholesky factor: outside the cone nothing is proved
        if not (np.isfinite(loss) and np.all(np.isfinite(gradient))):
            return INFEASIBLE, np.zeros_like(flat)
        return float(loss), np.asarray(gradient)

    # float64 for the search: near α = 1 float32 could not tell the metrics apart.
    with jax.enable_x64(True):
        flat = min(candidates, key=lambda each: objective(each, SHARPNESS[0][0])[0])
        # From smooth to sharp: a sharp maximum alone would stop at its first kink.
        for sharpness, iterations in SHARPNESS:
            options = {"maxiter": iterations, "maxcor": 20}
            search = {"args": (sharpness,), "method": "L-BFGS-B", "options": options}
            flat = scipy.optimize.minimize(objective, flat, jac=True, **search).x
    factor = np.zeros((rank, rank))
    factor[lower] = flat[:entries]
    found = factor @ factor.T
    scale = 1.0 / size_of(found)
    found *= scale
    widths = np.cumsum([len(part) for part in multipliers], dtype=int)[:-1]
    # P and multipliers scale together, or the matrix inequality would be another.
    joint = [
        np.split(scale * np.exp(part), widths) if multipliers else []
        for part in flat[entries:].reshape(len(vertices), -1)
    ]
    return accepted_metric(weights, rows, 0.5 * (found + found.T), joint)


def accepted_metric(
    weights: Exported, rows: Matrix, metric: Matrix, joint: list[list[Vector]]
) -> OutputMetric:
    """Return the smallest constants that the core accepts in this metric, or refuse."""
    refusal = CertificationRefused("no metric below 1 was found for this output")
    try:
        step = _in_coordinates(weights, metric)
    except np.linalg.LinAlgError:  # not positive definite
        raise refusal from None
    pairs = zip(joint, step.operators.vertices, strict=True)
    squares = [reduced(step.residual, *pair)[0][-1] for pair in pairs]
    # |c|² in the metric P⁻¹, without the inverse of an ill-conditioned P.
    squared = rows @ np.linalg.solve(metric, rows.T)
    sizes = np.sqrt([max(squares), np.max(np.linalg.eigvalsh(squared))])
    for slack in SLACKS:
        alpha, lipschitz = map(float, COMPILATION_SLACK * sizes * (1 + slack))
        claim = OutputMetric(alpha, lipschitz, metric, joint)
        # The core decides; the eigenvalues above are rounded.
        reads = reads_within(rows, lipschitz, metric)
        if alpha < 1.0 and reads and contracts(claim, weights):
            return claim
    raise refusal


@jax.jit  # one program for all outputs of a model
@jax.value_and_grad
def _log_radius(
    flat: Array, sharpness: Array, operators: Array, weights: Any, read: Any, gaps: Any
) -> Array:
    """Logarithm of what `propose_metric` minimises, smoothed, of (L, log λ)."""
    rank = operators.shape[-1]
    lower = np.tril_indices(operators.shape[-1])
    # L itself, not P: any L gives P = L L' ⪰ 0 without a constraint.
    factor = jnp.zeros((rank, rank)).at[lower].set(flat[: len(lower[0])])
    logs = flat[len(lower[0]) :].reshape(len(operators), -1)
    each = jax.vmap(partial(_squares, weights, factor))
    # Away from 0: the root below has no gradient there.
    squares = jnp.maximum(each(jnp.exp(logs), operators), 1e-12).reshape(-1)
    alpha = jnp.sqrt(_power_mean(squares, sharpness, mean=False))
    solved = jax.scipy.linalg.solve_triangular(factor, read, lower=True)
    gain = jnp.linalg.norm(solved)
    sizes = jnp.linalg.norm(gaps @ factor, axis=-1)
    # A smooth maximum over the worst steps of a run, sharp enough for five values.
    worst = jax.vmap(lambda run: _power_mean(run, 32.0, mean=False))(sizes)
    radius = jnp.log(gain * _power_mean(worst, RUNS, mean=True))
    return radius - jnp.log(1.0 - alpha)


def _squares(
    weights: Sequence[Array], factor: Array, multipliers: Array, operator: Array
) -> Array:
    """Eigenvalues of C'S⁻¹C − K in coordinates L'z; NaN if nothing is proved."""
    rank = len(factor)
    inverse = jax.scipy.linalg.solve_triangular(factor, jnp.eye(rank), lower=True).T
    # L' A L'⁻¹: in these coordinates |·|_P is the 2-norm.
    linear = factor.T @ operator @ inverse
    layers = [*weights]
    edges = np.cumsum([0, rank, *(len(part) for part in layers[:-1])])
    blocks = [slice(a, b) for a, b in pairwise(edges)]
    output = jnp.zeros((rank, edges[-1])).at[:, :rank].set(linear)
    if layers:
        layers[0] = layers[0] @ inverse
        output = output.at[:, blocks[-1]].add(factor.T @ layers[-1])
    scales = jnp.concatenate([jnp.zeros(rank), multipliers])
    matrix = 2 * jnp.diag(scales) - output.T @ output
    for weight, (before, here) in zip(layers, pairwise(blocks), strict=False):
        coupling = scales[here, None] * weight
        matrix = matrix.at[here, before].add(-coupling)
        matrix = matrix.at[before, here].add(-coupling.T)
    root = jnp.linalg.cholesky(matrix[rank:, rank:])  # NaN if it is not definite
    half = jax.scipy.linalg.solve_triangular(root, matrix[rank:, :rank], lower=True)
    return jnp.linalg.eigvalsh(half.T @ half - matrix[:rank, :rank])


def _power_mean(values: Array, power: Any, *, mean: bool) -> Array:
    """Return (Σ x^p)^(1/p) for x > 0, with `mean` that of the mean."""
    # Ratios at most 1: a large exponent cannot overflow, and one of them is 1.
    largest = jax.lax.stop_gradient(jnp.max(values))
    total = jnp.sum((values / largest) ** power)
    return largest * (total / len(values) if mean else total) ** (1.0 / power)
