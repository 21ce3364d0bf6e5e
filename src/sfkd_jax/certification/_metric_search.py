"""The search for an output's metric: proposed in float64 by L-BFGS, believed by nobody."""

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

from sfkd_jax.certification._claims import SERVED, Refuted
from sfkd_jax.certification._core import Matrix, Vector, check_vertices, witness_matrix
from sfkd_jax.certification._exported import Exported
from sfkd_jax.certification._output_metrics import OutputMetric, reads_within

SHARPNESS = ((16, 40), (64, 60), (256, 100))
"""Exponents of the p-norms that stand in for largest values, and L-BFGS iterations with
each.
"""
INFEASIBLE = 1e3
"""Value of the objective, a logarithm, where nothing is proved."""
SLACKS = (1e-9, 1e-7, 1e-5, 1e-3)
DRIVES = 8
"""Exponent of the mean over drives: near the quantile that calibration takes, and
smooth.
"""


def propose_metric(
    weights: Exported,
    rows: Matrix,
    gaps: Float[np.ndarray, "drive worst rank"],
    start: Sequence[Vector],
) -> OutputMetric:
    """The P for which |C|_{P⁻¹} q(|d|_P) / (1 − α_P) is small, with the constants that the core accepts.

    Over P = L L' and multipliers of every vertex at once. The step in coordinates L'z
    has A' = L'A L'⁻¹, W_1' = W_1 L'⁻¹, W_L' = L'W_L; eliminating the hidden layers by
    Schur gives α² as a largest eigenvalue, which is differentiable.

    Args:
        weights: explicit, float64, of a polytope.
        rows: C, (output, rank).
        gaps: d of the worst steps of every drive; not those that calibrate.
        start: multipliers to begin with, of all vertices alike.

    Raises:
        Refuted: nothing below 1 was found.
    """
    vertices, rank = weights.operators.vertices, weights.operators.vertices.shape[-1]
    begin = (
        np.concatenate([np.log(np.concatenate(start))] * len(vertices))
        if start
        else np.zeros(0)
    )
    lower = np.tril_indices(rank)
    flat = np.concatenate([np.eye(rank)[lower], begin])
    with jax.enable_x64(True):
        objective = _objective(weights, rows, gaps)
        for sharpness, iterations in SHARPNESS:
            options = {"maxiter": iterations, "maxcor": 20}
            found = minimize(
                partial(objective, sharpness),
                flat,
                jac=True,
                method="L-BFGS-B",
                options=options,
            )
            flat = found.x
    factor = np.zeros((rank, rank))
    factor[lower] = flat[: len(lower[0])]
    metric = factor @ factor.T
    metric *= 2.0 / (np.trace(metric) / rank + np.max(np.abs(metric)))
    widths = np.cumsum([len(part) for part in start])[:-1]
    logs = flat[len(lower[0]) :].reshape(len(vertices), -1)
    scale = 2.0 / (
        np.trace(factor @ factor.T) / rank + np.max(np.abs(factor @ factor.T))
    )
    joint = [np.split(scale * np.exp(part), widths) if start else [] for part in logs]
    return _accepted(weights, rows, 0.5 * (metric + metric.T), joint)


def _accepted(
    weights: Exported, rows: Matrix, metric: Matrix, joint: list[list[Vector]]
) -> OutputMetric:
    """The smallest constants that the core accepts in this metric.

    Raises:
        Refuted: there are none.
    """
    vertices = list(weights.operators.vertices)
    rate = max(
        _rate(weights.residual, part, vertex, metric)
        for part, vertex in zip(joint, vertices, strict=True)
    )
    reach = float(
        np.sqrt(np.max(np.linalg.eigvalsh(rows @ np.linalg.solve(metric, rows.T))))
    )
    for slack in SLACKS:
        alpha, lipschitz = (
            float(SERVED * rate * (1 + slack)),
            float(SERVED * reach * (1 + slack)),
        )
        proved = check_vertices(weights.residual, joint, alpha, vertices, metric)
        if proved and alpha < 1.0 and reads_within(rows, lipschitz, metric):
            return OutputMetric(alpha, lipschitz, metric, joint)
    raise Refuted("no metric below 1 was found for this output")


def _rate(
    weights: Sequence[Matrix], joint: list[Vector], vertex: Matrix, metric: Matrix
) -> float:
    """α in this metric by the same elimination, not rigorous; infinity if the multipliers prove nothing."""
    matrix, _ = witness_matrix(weights, joint, 0.0, vertex, metric)
    rank = len(metric)
    try:
        root = np.linalg.cholesky(matrix[rank:, rank:])
        schur = (
            matrix[rank:, :rank].T @ cho_solve((root, True), matrix[rank:, :rank])
            - matrix[:rank, :rank]
        )
        return float(np.sqrt(eigh(schur, metric, eigvals_only=True)[-1]))
    except (np.linalg.LinAlgError, ValueError):
        return float("inf")


def _objective(
    weights: Exported, rows: Matrix, gaps: Any
) -> Callable[..., tuple[float, Vector]]:
    """(sharpness, flat (L, log λ)) -> log of the radius and its gradient, as scipy calls it."""
    operators = jnp.asarray(weights.operators.vertices)
    rank, hidden = operators.shape[-1], sum(len(part) for part in weights.residual[:-1])
    lower = jnp.tril_indices(rank)
    read, driven = jnp.asarray(rows.T), jnp.asarray(gaps)

    def value(flat: Array, sharpness: Array) -> Array:
        factor = jnp.zeros((rank, rank)).at[lower].set(flat[: len(lower[0])])
        logs = flat[len(lower[0]) :].reshape(len(operators), hidden)
        found = jax.vmap(partial(_squares, weights.residual, factor))(
            jnp.exp(logs), operators
        )
        alpha = jnp.sqrt(
            _power_mean(jnp.maximum(found, 1e-12).reshape(-1), sharpness, mean=False)
        )
        reach = jnp.linalg.norm(
            jax.scipy.linalg.solve_triangular(factor, read, lower=True)
        )
        sizes = jnp.linalg.norm(driven @ factor, axis=-1)
        worst = jax.vmap(lambda drive: _power_mean(drive, 32.0, mean=False))(sizes)
        return jnp.log(reach * _power_mean(worst, DRIVES, mean=True)) - jnp.log(
            1.0 - alpha
        )

    derived = jax.jit(jax.value_and_grad(value))

    def call(sharpness: int, flat: Vector) -> tuple[float, Vector]:
        loss, gradient = derived(jnp.asarray(flat), jnp.asarray(float(sharpness)))
        if not (np.isfinite(loss) and np.all(np.isfinite(gradient))):
            return INFEASIBLE, np.zeros_like(flat)
        return float(loss), np.asarray(gradient)

    return call


def _squares(
    weights: Sequence[Matrix], factor: Array, multipliers: Array, operator: Array
) -> Array:
    """Eigenvalues of A'A + X H⁻¹ X' in coordinates L'z; NaN where the multipliers prove nothing."""
    inverse = jax.scipy.linalg.solve_triangular(
        factor, jnp.eye(len(factor)), lower=True
    )
    linear = factor.T @ operator @ inverse.T
    if not weights:
        return jnp.linalg.eigvalsh(linear.T @ linear)
    edges = np.cumsum([0, *(len(part) for part in weights[:-1])])
    blocks = [slice(a, b) for a, b in pairwise(edges)]
    output = (
        jnp.zeros((len(factor), edges[-1]))
        .at[:, blocks[-1]]
        .set(factor.T @ weights[-1])
    )
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
    """(Σ x^p)^(1/p), or with the mean in the place of the sum; x > 0."""
    largest = jax.lax.stop_gradient(jnp.max(values))
    total = jnp.sum((values / largest) ** power)
    return largest * (total / len(values) if mean else total) ** (1.0 / power)
