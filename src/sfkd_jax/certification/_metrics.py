"""Search for the metric of an output in float64 by L-BFGS, without a proof."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import cho_solve, eigh
from scipy.optimize import minimize

from sfkd_jax.certification._claims import (
    COMPILATION_SLACK,
    OutputMetric,
    Refuted,
    reads_within,
)
from sfkd_jax.certification._core import Matrix, Vector, check_vertices, witness_matrix
from sfkd_jax.certification._weights import Exported

SHARPNESS = ((16, 40), (64, 60), (256, 100))
"""Exponents of the p-norms that smooth a maximum, with L-BFGS iterations for each."""
INFEASIBLE = 1e3
"""Value of the logarithmic objective where nothing is proved."""
SLACKS = (1e-9, 1e-7, 1e-5, 1e-3)
RUNS = 8
"""Exponent of the power mean over runs, a smooth stand-in for a high quantile."""


def propose_metric(
    weights: Exported,
    rows: Matrix,
    gaps: Float[np.ndarray, "run worst rank"],
    start: Sequence[Vector],
    metric: Matrix | None = None,
) -> OutputMetric:
    """Minimise |C|_{P⁻¹} q(|d|_P) / (1 − α_P) over metrics P.

    The variables are L with P = L L' and the multipliers of every vertex. In
    coordinates L'z the step has A' = L'A L'⁻¹, W_1' = W_1 L'⁻¹ and W_L' = L'W_L. The
    Schur complement of the hidden layers gives α² as a largest eigenvalue, which is
    differentiable.

    Args:
        weights: explicit, float64.
        rows: C, (output, rank).
        gaps: d of the worst steps of every run, not of the calibration split.
        start: initial multipliers, equal at all vertices.
        metric: the Lyapunov matrix of the operators; the search starts there if that
            is better than I.

    Returns:
        The metric with the smallest constants that the trusted core accepts.

    Raises:
        Refuted: no α below 1 was found.
    """
    vertices, rank = weights.operators.vertices, weights.operators.vertices.shape[-1]
    # Logarithms: multipliers stay positive in an unconstrained search.
    logs = [np.log(np.concatenate(start))] * len(vertices) if start else [np.zeros(0)]
    lower = np.tril_indices(rank)
    begins = [np.eye(rank)]
    # Scaled to the trace of I: both starts have entries of the same size.
    if metric is not None:
        begins.append(np.linalg.cholesky(metric * (rank / np.trace(metric))))
    candidates = [np.concatenate([begin[lower], *logs]) for begin in begins]
    # float64 for the search: near α = 1 float32 could not tell the metrics apart.
    with jax.enable_x64(True):
        objective = _objective(weights, rows, gaps)
        first = partial(objective, SHARPNESS[0][0])
        flat = min(candidates, key=lambda candidate: first(candidate)[0])
        # From smooth to sharp: a sharp maximum alone would stop at its first kink.
        for sharpness, iterations in SHARPNESS:
            options = {"maxiter": iterations, "maxcor": 20}
            search = {"jac": True, "method": "L-BFGS-B", "options": options}
            flat = minimize(partial(objective, sharpness), flat, **search).x
    factor = np.zeros((rank, rank))
    factor[lower] = flat[: len(lower[0])]
    found = factor @ factor.T
    # The scale is free: entries of about 1 keep the core's rounding errors small.
    scale = 2.0 / (np.trace(found) / rank + np.max(np.abs(found)))
    found *= scale
    widths = np.cumsum([len(part) for part in start])[:-1]
    logs = flat[len(lower[0]) :].reshape(len(vertices), -1)
    # P and multipliers scale together, or the matrix inequality would be another.
    joint = [np.split(scale * np.exp(part), widths) if start else [] for part in logs]
    return _accepted(weights, rows, 0.5 * (found + found.T), joint)


def _accepted(
    weights: Exported, rows: Matrix, metric: Matrix, joint: list[list[Vector]]
) -> OutputMetric:
    """Return the smallest constants that the core accepts in this metric.

    Raises:
        Refuted: there are none.
    """
    vertices = list(weights.operators.vertices)
    rate = max(
        _rate(weights.residual, part, vertex, metric)
        for part, vertex in zip(joint, vertices, strict=True)
    )
    # |c|² in the metric P⁻¹, without the inverse of an ill-conditioned P.
    squared = rows @ np.linalg.solve(metric, rows.T)
    gain = float(np.sqrt(np.max(np.linalg.eigvalsh(squared))))
    for slack in SLACKS:
        alpha = float(COMPILATION_SLACK * rate * (1 + slack))
        lipschitz = float(COMPILATION_SLACK * gain * (1 + slack))
        # The core decides; the eigenvalues above are rounded.
        proved = check_vertices(weights.residual, joint, alpha, vertices, metric)
        if proved and alpha < 1.0 and reads_within(rows, lipschitz, metric):
            return OutputMetric(alpha, lipschitz, metric, joint)
    raise Refuted("no metric below 1 was found for this output")


def _rate(
    weights: Sequence[Matrix], joint: list[Vector], vertex: Matrix, metric: Matrix
) -> float:
    """α in this metric, not rigorous; infinity if the multipliers prove nothing."""
    matrix, _ = witness_matrix(weights, joint, 0.0, vertex, metric)
    rank = len(metric)
    try:
        root = np.linalg.cholesky(matrix[rank:, rank:])
        hidden = cho_solve((root, True), matrix[rank:, :rank])
        schur = matrix[rank:, :rank].T @ hidden - matrix[:rank, :rank]
        return float(np.sqrt(eigh(schur, metric, eigvals_only=True)[-1]))
    # Multipliers outside the cone: the hidden block is not positive definite.
    except (np.linalg.LinAlgError, ValueError):
        return float("inf")


def _objective(
    weights: Exported, rows: Matrix, gaps: Any
) -> Callable[..., tuple[float, Vector]]:
    """Return (sharpness, flat (L, log λ)) ↦ (log radius, gradient) for scipy."""
    operators = jnp.asarray(weights.operators.vertices)
    rank, hidden = operators.shape[-1], sum(len(part) for part in weights.residual[:-1])
    lower = jnp.tril_indices(rank)
    read, disturbed = jnp.asarray(rows.T), jnp.asarray(gaps)

    def value(flat: Array, sharpness: Array) -> Array:
        # L itself, not P: any L gives P = L L' ⪰ 0 without a constraint.
        factor = jnp.zeros((rank, rank)).at[lower].set(flat[: len(lower[0])])
        logs = flat[len(lower[0]) :].reshape(len(operators), hidden)
        each = jax.vmap(partial(_squares, weights.residual, factor))
        # Away from 0: the root below has no gradient there.
        squares = jnp.maximum(each(jnp.exp(logs), operators), 1e-12).reshape(-1)
        alpha = jnp.sqrt(_power_mean(squares, sharpness, mean=False))
        solved = jax.scipy.linalg.solve_triangular(factor, read, lower=True)
        gain = jnp.linalg.norm(solved)
        sizes = jnp.linalg.norm(disturbed @ factor, axis=-1)
        # A smooth maximum over the worst steps of a run, sharp enough for five values.
        worst = jax.vmap(lambda run: _power_mean(run, 32.0, mean=False))(sizes)
        radius = jnp.log(gain * _power_mean(worst, RUNS, mean=True))
        return radius - jnp.log(1.0 - alpha)

    with_gradient = jax.jit(jax.value_and_grad(value))

    def call(sharpness: int, flat: Vector) -> tuple[float, Vector]:
        loss, gradient = with_gradient(jnp.asarray(flat), jnp.asarray(float(sharpness)))
        # NaN of the Cholesky factor: outside the cone nothing is proved
        if not (np.isfinite(loss) and np.all(np.isfinite(gradient))):
            return INFEASIBLE, np.zeros_like(flat)
        return float(loss), np.asarray(gradient)

    return call


def _squares(
    weights: Sequence[Matrix], factor: Array, multipliers: Array, operator: Array
) -> Array:
    """Eigenvalues of A'A + X H⁻¹ X' in coordinates L'z; NaN if nothing is proved."""
    inverse = jax.scipy.linalg.solve_triangular(
        factor, jnp.eye(len(factor)), lower=True
    )
    # L' A L'⁻¹: in these coordinates |·|_P is the 2-norm.
    linear = factor.T @ operator @ inverse.T
    if not weights:
        return jnp.linalg.eigvalsh(linear.T @ linear)
    edges = np.cumsum([0, *(len(part) for part in weights[:-1])])
    blocks = [slice(a, b) for a, b in pairwise(edges)]
    output = jnp.zeros((len(factor), edges[-1]))
    output = output.at[:, blocks[-1]].set(factor.T @ weights[-1])
    inner = 2 * jnp.diag(multipliers) - output.T @ output
    for k, (before, here) in enumerate(pairwise(blocks)):
        coupling = multipliers[here, None] * weights[k + 1]
        inner = inner.at[here, before].add(-coupling).at[before, here].add(-coupling.T)
    entry = multipliers[blocks[0], None] * (weights[0] @ inverse.T)
    coupling = (linear.T @ output).at[:, blocks[0]].add(entry.T)
    root = jnp.linalg.cholesky(inner)  # NaN if it is not positive definite
    half = jax.scipy.linalg.solve_triangular(root, coupling.T, lower=True)
    return jnp.linalg.eigvalsh(linear.T @ linear + half.T @ half)


def _power_mean(values: Array, power: Any, *, mean: bool) -> Array:
    """Return (Σ x^p)^(1/p) for x > 0, with `mean` that of the mean."""
    # Ratios at most 1: a large exponent cannot overflow, and one of them is 1.
    largest = jax.lax.stop_gradient(jnp.max(values))
    total = jnp.sum((values / largest) ** power)
    return largest * (total / len(values) if mean else total) ** (1.0 / power)
