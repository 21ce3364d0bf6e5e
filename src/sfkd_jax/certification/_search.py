"""Search for multipliers and constants; only the trusted core decides what holds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import scipy  # its parts are imported where they are used, not to verify

from sfkd_jax.certification._claims import (
    COMPILATION_SLACK,
    Claims,
    decoders,
    hull_scope,
    listed,
    readouts,
)
from sfkd_jax.certification._core import (
    Matrix,
    Vector,
    check_witness,
    norm_upper,
    witness_matrix,
)
from sfkd_jax.certification._weights import Exported, one_thread, require

SCALES = np.geomspace(0.25, 4.0, 33)
SLACKS = (1e-9, 1e-7, 1e-5, 1e-3)
SHARPNESS = (8, 64, 512)
"""Exponents of the p-norm that smooths the largest eigenvalue, one L-BFGS run each."""
INFEASIBLE = 1e3
"""Value of the logarithmic objective where the multipliers prove nothing."""


@one_thread()
def prove(weights: Exported) -> Claims:
    """Search for the smallest constants that the core accepts, or refuse."""
    bound, start = _best_multipliers(weights.residual, weights.residual_multipliers)
    beta = COMPILATION_SLACK * bound
    unproved = "no multipliers prove a Lipschitz bound of the"
    require(np.isfinite(beta), f"{unproved} residual")
    witnesses: dict[str, Any] = {"residual": start}
    norms = [norm_upper(vertex) for vertex in weights.operators.vertices]
    rho = COMPILATION_SLACK * max(norms)
    alpha_joint, witnesses["joint"] = joint_bound(weights, start)
    lipschitz = {
        name: COMPILATION_SLACK * norm_upper(rows)
        for name, rows in readouts(weights).items()
    }
    for name, network in decoders(weights).items():
        bound, witnesses[name] = _best_multipliers(network, weights.decoder_multipliers)
        lipschitz[name] = COMPILATION_SLACK * bound
    require(np.all(np.isfinite([*lipschitz.values()])), f"{unproved} decoder")
    separate = rho + beta
    return Claims(
        scope=hull_scope(weights),
        alpha=min(separate, alpha_joint),
        alpha_separate=separate,
        alpha_joint=alpha_joint,
        rho=rho,
        beta=beta,
        lipschitz=lipschitz,
        witnesses=listed(witnesses),
    )


def joint_bound(
    weights: Exported, start: Sequence[Vector]
) -> tuple[float, list[list[Vector]]]:
    """Return α of z ↦ A z + r(z) as one map, and multipliers for each vertex."""
    bounds = []
    witnesses = []
    for vertex in weights.operators.vertices:
        # From the answer of the last vertex: operators and multipliers are alike.
        start = propose_multipliers(weights.residual, start, vertex)
        bound, start = lipschitz_upper(weights.residual, start, vertex)
        bounds.append(bound)
        witnesses.append(start)
    return COMPILATION_SLACK * max(bounds), witnesses


def _best_multipliers(
    weights: Sequence[Matrix], start: Sequence[Vector]
) -> tuple[float, list[Vector]]:
    """Return the better bound of the model's multipliers and those from L-BFGS."""
    # One layer is linear: its norm is exact, and there are no slopes.
    if len(weights) < 2 or not np.any(weights[-1]):
        return (norm_upper(weights[-1]) if weights else 0.0), []
    # The model's own multipliers prove its design bound, which L-BFGS may miss.
    given = lipschitz_upper(weights, start) if start else (float("inf"), [])
    proposed = lipschitz_upper(weights, propose_multipliers(weights, start))
    return min(given, proposed, key=lambda pair: pair[0])


def lipschitz_upper(
    weights: Sequence[Matrix],
    multipliers: Sequence[Vector],
    linear: Matrix | None = None,
) -> tuple[float, list[Vector]]:
    """Return the smallest Lipschitz bound that scaled multipliers prove, or infinity.

    The network W_1 … W_L has slopes in [0, 1]; with `linear` A z is added to it.
    """
    if not multipliers and len(weights) <= 1:
        given = (part for part in (*weights, linear) if part is not None)
        parts = [np.asarray(part, dtype=np.float64) for part in given]
        # Widened by the rounding of the sum itself, which `norm_upper` does not see.
        return norm_upper(sum(parts[1:], parts[0])) * (1 + (len(parts) - 1) * 1e-12), []
    if len(multipliers) != len(weights) - 1:
        return float("inf"), []
    best: tuple[float, list[Vector]] = (float("inf"), [])
    # The bound is not invariant to a common factor of the multipliers.
    for scale in SCALES:
        scaled = [scale * np.asarray(part, dtype=np.float64) for part in multipliers]
        eigenvalues, *_ = reduced(weights, scaled, linear)
        guess = float(np.sqrt(np.max(eigenvalues)))
        for slack in SLACKS:
            bound = guess * (1 + slack)
            # Not better than the best so far: more slack only makes it worse.
            if not bound < best[0]:
                break
            # The eigenvalue is not rigorous, the core is
            if check_witness(weights, scaled, bound, linear):
                best = bound, scaled
                break
    return best


def propose_multipliers(
    weights: Sequence[Matrix],
    start: Sequence[Vector] = (),
    linear: Matrix | None = None,
) -> list[Vector]:
    """Return multipliers near the LipSDP optimum, by L-BFGS over their logarithms.

    For fixed multipliers the best bound is the root of the largest eigenvalue of the
    Schur complement C'S⁻¹C − K. With a top eigenvector v and the hidden values
    y = −S⁻¹Cv, its gradient is dλ_k ↦ −2 y_k ∘ (y_k − W_k y_{k−1}).

    Without `start` the search begins at those that prove the product of norms.
    """
    weights = [np.asarray(weight, dtype=np.float64) for weight in weights]
    if len(weights) < 2 or not all(np.all(np.isfinite(part)) for part in weights):
        return []
    begin = _starting_point(weights, start, linear)
    # A network that emits a constant needs none; the search would drive them to zero
    if not np.any(weights[-1]):
        return begin
    widths = np.cumsum([len(part) for part in begin])[:-1]
    logs = np.log(np.concatenate(begin))

    def objective(logs: Vector, sharpness: int) -> tuple[float, Vector]:
        multipliers = np.split(np.exp(logs), widths)
        eigenvalues, vectors, hidden = reduced(weights, multipliers, linear)
        if not np.all(np.isfinite(eigenvalues)):
            return INFEASIBLE, np.zeros_like(logs)
        largest = eigenvalues[-1]
        # Eigenvalues below 0 count nothing in a p-norm; a power of them would be NaN.
        powers = np.maximum(eigenvalues / largest, 0.0) ** (sharpness - 1)
        total = np.sum(powers * eigenvalues / largest)
        gradient = []
        for k, (before, here) in enumerate(pairwise([vectors, *hidden])):
            each = -2.0 * here * (here - weights[k] @ before)
            gradient.append(multipliers[k] * (each @ powers) / (largest * total))
        value = 0.5 * (np.log(largest) + np.log(total) / sharpness)
        return value, 0.5 * np.concatenate(gradient)

    options = {"maxiter": 150, "maxcor": 30}
    # Smooth first: a sharp p-norm has a gradient of the top vector alone.
    for sharpness in SHARPNESS:
        search = {"args": (sharpness,), "method": "L-BFGS-B", "options": options}
        logs = scipy.optimize.minimize(objective, logs, jac=True, **search).x
    return np.split(np.exp(logs), widths)


def _starting_point(
    weights: list[Matrix], start: Sequence[Vector], linear: Matrix | None
) -> list[Vector]:
    """Return `start` if it proves anything, else λ_k = Π_{j>k} ||W_j||², rescaled."""
    squares = [max(float(np.linalg.norm(weight, 2)) ** 2, 1e-6) for weight in weights]
    norms = [
        # A thousandth above the product of norms, so that the inequality is strict.
        np.full(len(weights[k]), 1.001 * np.prod(squares[k + 1 :]))
        for k in range(len(weights) - 1)
    ]
    # With the factor that proves most: the search begins where something is proved.
    for begin in (start, norms):
        if begin and (best := lipschitz_upper(weights, begin, linear)[1]):
            return best
    return norms


def reduced(
    weights: Sequence[Matrix], multipliers: Sequence[Vector], linear: Matrix | None
) -> tuple[Vector, Matrix, list[Matrix]]:
    """Return eigenvalues (ascending) and vectors of C'S⁻¹C − K, and y; not rigorous."""
    matrix, _ = witness_matrix(weights, multipliers, 0.0, linear)
    widths = np.cumsum([len(part) for part in multipliers], dtype=int)
    inputs = len(matrix) - sum(len(part) for part in multipliers)
    coupling = matrix[inputs:, :inputs]
    lower = matrix[inputs:, inputs:]
    infeasible = np.full(inputs, np.inf), np.eye(inputs), []
    if not np.all(np.isfinite(matrix)):
        return infeasible
    try:
        hidden = scipy.linalg.cho_solve((np.linalg.cholesky(lower), True), coupling)
    except np.linalg.LinAlgError:
        return infeasible
    schur = coupling.T @ hidden - matrix[:inputs, :inputs]
    # Rounding makes the Schur complement slightly asymmetric.
    eigenvalues, vectors = np.linalg.eigh(0.5 * (schur + schur.T))
    return eigenvalues, vectors, np.split(-hidden @ vectors, widths[:-1])
