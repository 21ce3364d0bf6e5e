"""Search for metrics P: one of all operators together, and one for an output.

The semidefinite program of the paper (cvxpy with clarabel) proposes a common Lyapunov
matrix with the smallest condition number. L-BFGS proposes a metric for each output. The
search proves nothing: the trusted core decides what is accepted.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import partial
from itertools import chain, pairwise
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from sfkd_jax.certificate import LyapunovClaim, OutputMetric
from sfkd_jax.certification._claims import COMPILATION_SLACK, rows
from sfkd_jax.certification._core import Matrix, Vector, check_metric
from sfkd_jax.certification._metric_claims import (
    ROTATES,
    contracts,
    keeps_metrics,
    reads_within,
    size_of,
)
from sfkd_jax.certification._search import INFEASIBLE, SLACKS, joint_bound, reduced
from sfkd_jax.certification._weights import (
    CertificationRefused,
    Exported,
    one_thread,
    require,
)
from sfkd_jax.types import Polytope

TINY = 1e-12
"""Smallest multiplier of a start, whose logarithm the search moves."""
ProvedMetric: TypeAlias = tuple[Matrix, Sequence[Sequence[Any]]]
"""A metric, and the multipliers of every vertex that prove contraction in it."""
MARGIN = 1e-6
"""Relative tightening of constraints, which solvers may violate slightly."""
SHARES = (0.5, 0.75, 0.9)
"""Rates ρ that are tried, as shares of the way from 0, the largest spectral radius of a
vertex, to 1, the largest 2-norm. Below the spectral radius there is no P; at the 2-norm
P = I suffices.
"""
MISSING = (
    "no Lyapunov matrix: cvxpy or clarabel is not installed "
    '(pip install "sfkd-jax[train]")'
)
SHARPNESS = ((16.0, 40), (64.0, 60), (256.0, 100))
"""Exponents of the p-norms that smooth a maximum, with L-BFGS iterations for each."""
POWER_OVER_RUNS = 8
"""Exponent of the power mean over runs. It is smooth and close to a high quantile."""
POWER_OVER_STEPS = 32.0
"""Exponent of the p-norm over the worst steps of a run, close to their maximum."""


@one_thread()
def prove_lyapunov(weights: Exported) -> LyapunovClaim:
    """Return a common Lyapunov function at the smallest rate that is accepted.

    The semidefinite program is solved at the rates of `SHARES`, from the smallest one
    up. P = I comes last: there a step contracts by construction, whatever a solver
    says.

    Raises:
        CertificationRefused: there is none, or a solver is missing.
    """
    # A rotation at a switch of e keeps only balls, and no other ellipsoid.
    require(keeps_metrics(weights), ROTATES)
    vertices = list(weights.operators.vertices)
    norm = max(np.linalg.norm(vertex, 2) for vertex in vertices)
    radius = max(np.max(np.abs(np.linalg.eigvals(vertex))) for vertex in vertices)
    rates = (float(radius + share * (norm - radius)) for share in SHARES)
    proposed = (solve_metric(vertices, rate) for rate in rates)
    identity = np.eye(len(vertices[0]))
    for metric in chain(proposed, [identity]):
        if metric is None:
            continue
        # A solver that reports success may still have violated a constraint.
        claim = _accepted_lyapunov(metric, weights)
        if claim is not None:
            return claim
    raise CertificationRefused(
        "the solver found no common Lyapunov matrix that the core accepts"
    )


def solve_metric(operators: Sequence[Matrix], rate: float) -> Matrix | None:
    """Return a common Lyapunov matrix of the smallest condition number by cvxpy.

    Minimise κ over I ⪯ P ⪯ κ I such that A' P A ⪯ ρ² P for every operator A.

    Args:
        operators: A.
        rate: ρ.

    Returns:
        P, or None if the solver returns no values. The status of the solver is ignored,
        since the core judges the values.

    Raises:
        CertificationRefused: cvxpy or clarabel is not installed.
    """
    try:
        import cvxpy as cp  # an optional dependency
    except ImportError:
        raise CertificationRefused(MISSING) from None
    require("CLARABEL" in cp.installed_solvers(), MISSING)
    identity = np.eye(len(operators[0]))
    metric = cp.Variable(identity.shape, symmetric=True)
    condition = cp.Variable()
    # I ⪯ P fixes the scale, which would be free otherwise, and makes κ the condition.
    constraints: list[Any] = [metric >> identity, condition * identity - metric >> 0]
    # Solvers meet constraints only nearly, so that these are a little tighter than what
    # will be claimed.
    tightened = (rate * (1 - MARGIN)) ** 2
    constraints += [tightened * metric - a.T @ metric @ a >> 0 for a in operators]
    problem = cp.Problem(cp.Minimize(condition), constraints)
    try:
        with warnings.catch_warnings():
            # A warning about an inaccurate answer is not needed: the core judges it.
            warnings.simplefilter("ignore")
            problem.solve(solver="CLARABEL")
    except (cp.SolverError, ValueError, ArithmeticError):
        return None
    return None if metric.value is None else np.asarray(metric.value, np.float64)


def _accepted_lyapunov(metric: Matrix, weights: Exported) -> LyapunovClaim | None:
    """Return the smallest constants of a proposed P that the core accepts, or None."""
    metric = np.asarray(metric, dtype=np.float64)
    vertices = weights.operators.vertices
    if metric.shape != vertices.shape[1:] or not np.all(np.isfinite(metric)):
        return None
    # Made symmetric, because `eigvalsh` reads one triangle only.
    metric = 0.5 * (metric + metric.T)
    values = np.linalg.eigvalsh(metric)
    if not 0 < values[0] <= values[-1] < np.inf:
        return None
    # The scale is free. λ_min = 1 is far from underflow and overflow.
    metric /= values[0]
    step = _in_coordinates(weights, metric)
    rate = max(np.linalg.norm(vertex, 2) for vertex in step.operators.vertices)
    alpha, joint = joint_bound(step, weights.residual_multipliers)
    # Rounding decides how little slack the core accepts. The smallest is kept.
    for slack in SLACKS:
        bound = float(values[-1] / values[0] * (1 + slack))
        claim = LyapunovClaim(
            rho=float(COMPILATION_SLACK * rate * (1 + slack)),
            condition=bound,
            alpha=float(alpha * (1 + slack)),
            c_1=math.sqrt(bound),
            c_2=math.sqrt(bound),
            metric=rows(metric),
            joint=rows(joint),
        )
        holds = check_metric(metric, list(vertices), claim.rho, claim.condition)
        if max(claim.rho, claim.alpha) < 1.0 and holds and contracts(claim, weights):
            return claim
    return None


def _in_coordinates(weights: Exported, metric: Matrix) -> Exported:
    """Return the step in coordinates L'z with P = L L', where |·|_P is the 2-norm."""
    root = np.linalg.cholesky(metric).T
    inverse = np.linalg.inv(root)
    # The first layer reads z and the last one writes it. Hidden layers stay the same.
    residual = [*weights.residual]
    if residual:
        residual[0] = residual[0] @ inverse
        residual[-1] = root @ residual[-1]
    vertices = root @ weights.operators.vertices @ inverse
    return weights._replace(operators=Polytope(vertices), residual=tuple(residual))


@one_thread()
def propose_metric(
    weights: Exported,
    readout: Matrix,
    gaps: Float[np.ndarray, "run worst rank"],
    proved: Sequence[ProvedMetric] = (),
) -> OutputMetric:
    """Minimise |C|_{P⁻¹} q(|d|_P) / (1 − α_P) over metrics P.

    The variables are L with P = L L' and the multipliers of every vertex. In
    coordinates L'z the step has A' = L'A L'⁻¹, W_1' = W_1 L'⁻¹ and W_L' = L'W_L. The
    Schur complement of the hidden layers gives α² as a differentiable eigenvalue.

    Args:
        weights: of the model.
        readout: C of the output.
        gaps: d of the worst steps of every run, of a split other than the calibration.
        proved: metrics in which the step contracts. The search starts at the best of
            these, of I and of the same metrics with the multipliers of the weights.

    Raises:
        CertificationRefused: no metric is accepted.
    """
    vertices = weights.operators.vertices
    multipliers = weights.residual_multipliers
    rank = vertices.shape[-1]
    lower = np.tril_indices(rank)
    entries = len(lower[0])
    candidates = []
    usual = [multipliers] * len(vertices)
    others = [(metric, usual) for metric, _ in proved]
    for metric, joint in ((np.eye(rank), usual), *others):
        # Scaled to the trace of I, so that all starts have entries of the same size.
        factor = np.linalg.cholesky(metric * (rank / np.trace(metric)))
        candidates.append(np.concatenate([factor[lower], *map(_logs, joint)]))
    for metric, joint in proved:
        # Multipliers scale with P.
        share = rank / np.trace(metric)
        factor = np.linalg.cholesky(share * metric)
        logs = [np.log(share) + _logs(of_vertex) for of_vertex in joint]
        candidates.append(np.concatenate([factor[lower], *logs]))

    def objective(flat: Vector, sharpness: float) -> tuple[float, Vector]:
        loss, gradient = _log_radius(
            flat, sharpness, vertices, weights.residual, readout.T, gaps
        )
        # A Cholesky factor of NaN says that nothing is proved at this point.
        if not (np.isfinite(loss) and np.all(np.isfinite(gradient))):
            return INFEASIBLE, np.zeros_like(flat)
        return float(loss), np.asarray(gradient)

    # In float64: near α = 1 float32 could not tell the metrics apart.
    with jax.enable_x64(True):
        first_sharpness, _ = SHARPNESS[0]
        best = min(candidates, key=lambda point: objective(point, first_sharpness)[0])
        flat = best
        # From smooth to sharp: a sharp maximum alone would stop at its first kink.
        for sharpness, iterations in SHARPNESS:
            flat = scipy.optimize.minimize(
                objective,
                flat,
                args=(sharpness,),
                jac=True,
                method="L-BFGS-B",
                options={"maxiter": iterations, "maxcor": 20},
            ).x

    def accepted(flat: Vector) -> OutputMetric:
        factor = np.zeros((rank, rank))
        factor[lower] = flat[:entries]
        metric = factor @ factor.T
        # P has the size 1. Multipliers scale with it, or they would prove nothing.
        scale = 1.0 / size_of(metric)
        metric *= scale
        widths = np.cumsum([len(part) for part in multipliers], dtype=int)[:-1]
        joint = [
            np.split(scale * np.exp(part), widths) if multipliers else []
            for part in flat[entries:].reshape(len(vertices), -1)
        ]
        return accepted_metric(weights, readout, 0.5 * (metric + metric.T), joint)

    try:
        return accepted(flat)
    except CertificationRefused:
        # The search may end where rounding spoils the proof. Where it began is worse,
        # but proves something.
        return accepted(best)


def _logs(multipliers: Sequence[Any]) -> Vector:
    """Return logarithms of multipliers, over which the search keeps them positive."""
    return np.log(np.maximum(np.concatenate([*multipliers, []]), TINY))


def accepted_metric(
    weights: Exported, readout: Matrix, metric: Matrix, joint: list[list[Vector]]
) -> OutputMetric:
    """Return the smallest constants that the core accepts in a metric.

    Args:
        weights: of the model.
        readout: C of the output.
        metric: P.
        joint: multipliers of every vertex.

    Raises:
        CertificationRefused: it accepts none, or α would not be below 1.
    """
    refusal = CertificationRefused("no metric below 1 was found for this output")
    try:
        step = _in_coordinates(weights, metric)
    except np.linalg.LinAlgError:  # not positive definite
        raise refusal from None
    # The squares of α at every vertex, the largest eigenvalues.
    squares = []
    for multipliers, vertex in zip(joint, step.operators.vertices, strict=True):
        eigenvalues, _, _ = reduced(step.residual, multipliers, vertex)
        squares.append(eigenvalues[-1])
    # C P⁻¹ C', without the inverse of an ill-conditioned P.
    squared_output = readout @ np.linalg.solve(metric, readout.T)
    sizes = np.sqrt([max(squares), np.max(np.linalg.eigvalsh(squared_output))])
    # The eigenvalues are rounded. The core decides with how little slack they hold.
    for slack in SLACKS:
        alpha, lipschitz = map(float, COMPILATION_SLACK * sizes * (1 + slack))
        claim = OutputMetric(
            alpha=alpha, lipschitz=lipschitz, metric=rows(metric), joint=rows(joint)
        )
        reads = reads_within(readout, lipschitz, metric)
        if alpha < 1.0 and reads and contracts(claim, weights):
            return claim
    raise refusal


@jax.jit  # one program for all outputs of a model
@jax.value_and_grad
def _log_radius(
    flat: Array, sharpness: Array, operators: Array, weights: Any, read: Any, gaps: Any
) -> Array:
    """Return the logarithm of what `propose_metric` minimises, with smooth maxima.

    Args:
        flat: lower triangle of L, then log λ of every vertex.
        sharpness: exponent of the p-norm that smooths the largest eigenvalue.
        operators: vertices A.
        weights: W_1 … W_L.
        read: C'.
        gaps: d of the worst steps of every run.
    """
    rank = operators.shape[-1]
    lower = np.tril_indices(rank)
    entries = len(lower[0])
    # The variable is L and not P: any L gives P = L L' ⪰ 0 without a constraint.
    factor = jnp.zeros((rank, rank)).at[lower].set(flat[:entries])
    logs = flat[entries:].reshape(len(operators), -1)
    squares_at = jax.vmap(partial(_squares, weights, factor))
    # Not below 1e-12, because the root below has no gradient at 0.
    squares = jnp.maximum(squares_at(jnp.exp(logs), operators), 1e-12).reshape(-1)
    alpha = jnp.sqrt(_power_sum(squares, sharpness))
    solved = jax.scipy.linalg.solve_triangular(factor, read, lower=True)
    # Of several rows the Frobenius norm, which is smooth where singular values cross.
    gain = jnp.linalg.norm(solved)
    sizes = jnp.linalg.norm(gaps @ factor, axis=-1)
    worst_of_runs = jax.vmap(partial(_power_sum, power=POWER_OVER_STEPS))(sizes)
    radius = jnp.log(gain * _power_mean(worst_of_runs, POWER_OVER_RUNS))
    return radius - jnp.log(1.0 - alpha)


def _squares(
    weights: Sequence[Array], factor: Array, multipliers: Array, operator: Array
) -> Array:
    """Return the eigenvalues of C'S⁻¹C − K in coordinates L'z, as in `_search`.

    They are NaN if the multipliers prove nothing.

    Args:
        weights: W_1 … W_L.
        factor: L.
        multipliers: λ of all hidden layers.
        operator: A.
    """
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
    # The Cholesky factor is NaN if S is not positive definite.
    root = jnp.linalg.cholesky(matrix[rank:, rank:])
    half = jax.scipy.linalg.solve_triangular(root, matrix[rank:, :rank], lower=True)
    return jnp.linalg.eigvalsh(half.T @ half - matrix[:rank, :rank])


def _power_sum(values: Array, power: Any) -> Array:
    """Return the p-norm (Σ x^p)^(1/p) for x > 0."""
    # Of ratios, which are at most 1: a large exponent cannot overflow.
    largest = jax.lax.stop_gradient(jnp.max(values))
    total = jnp.sum((values / largest) ** power)
    return largest * total ** (1.0 / power)


def _power_mean(values: Array, power: Any) -> Array:
    """Return the power mean (mean x^p)^(1/p) for x > 0."""
    largest = jax.lax.stop_gradient(jnp.max(values))
    total = jnp.sum((values / largest) ** power)
    return largest * (total / len(values)) ** (1.0 / power)
