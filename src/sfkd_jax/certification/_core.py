"""The trusted core: numpy float64, no solver, no search. What is proposed elsewhere counts only if it passes here."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, " _"]
UNIT = np.finfo(np.float64).eps / 2
TINY = np.finfo(np.float64).tiny


def is_positive_definite(matrix: Matrix, error: float = 0.0) -> bool:
    """Whether every symmetric matrix within `error` (2-norm) of `matrix` is positive definite; rounding included.

    A Cholesky factorisation of M − c I that runs to its end proves it, with c above the sum of `error` and of what
    the factorisation itself can lose, γ_{n+1}/(1 − γ_{n+1}) tr M (Rump, BIT 46, 2006). False when in doubt.
    """
    n = matrix.shape[0]
    if not np.all(np.isfinite(matrix)) or not np.isfinite(error) or error < 0:
        return False
    if not np.array_equal(matrix, matrix.T) or np.any(np.diag(matrix) <= 0):
        return False
    gamma = (n + 2) * UNIT / (1 - (n + 2) * UNIT)
    shift = 2 * gamma / (1 - gamma) * float(np.trace(matrix)) + error * (1 + 4 * UNIT) + n * n * TINY
    try:
        np.linalg.cholesky(matrix - shift * np.eye(n))
    except np.linalg.LinAlgError:
        return False
    return True


def product(left: Matrix, right: Matrix) -> tuple[Matrix, float]:
    """A product in float64 and a bound on the 2-norm of its rounding error."""
    left, right = np.asarray(left, dtype=np.float64), np.asarray(right, dtype=np.float64)
    error = (left.shape[1] + 2) * UNIT * float(np.linalg.norm(np.abs(left) @ np.abs(right)))
    return left @ right, 2 * error + left.size * right.shape[1] * TINY


def norm_upper(matrix: Matrix) -> float:
    """A proven upper bound on ||M||_2, tight to about 1e-12; infinity if M is not finite."""
    matrix = np.asarray(matrix, dtype=np.float64)
    if not np.all(np.isfinite(matrix)):
        return float("inf")
    gram, error = product(matrix.T, matrix)
    guess = float(np.linalg.norm(matrix, 2)) + TINY
    for slack in (1e-12, 1e-10, 1e-8, 1e-6, 1e-3, 1.0):
        bound = guess * (1 + slack)
        if is_positive_definite(bound**2 * (1 - 4 * UNIT) * np.eye(len(gram)) - 0.5 * (gram + gram.T), error):
            return bound
    return float(np.sum(np.abs(matrix))) * (1 + 1e-9)


def check_witness(
    weights: Sequence[Matrix], multipliers: Sequence[Vector], bound: float, linear: Matrix | None = None
) -> bool:
    """Whether the multipliers prove |f(z) − f(z')| ≤ bound |z − z'| for f = A z + W_L σ(… σ(W_1 z + b_1) …) + b_L.

    For any biases and any σ applied entry by entry with slopes in [0, 1]: with Λ_k = diag λ_k > 0 it suffices that

        [ b² I  −W_1'Λ_1           ]
        [   ·    2Λ_1   −W_2'Λ_2 … ]  −  [A 0 … W_L]' [A 0 … W_L]  >  0    (LipSDP with diagonal multipliers)

    By Schur's complement this is linear in (A, Λ, b²): witnesses at the vertices of a polytope of A prove the largest
    of their bounds for every A in it. No weights: f = A z. No A: it is 0.
    """
    if len(multipliers) != max(len(weights) - 1, 0) or not np.isfinite(bound) or bound <= 0:
        return False
    if any(not np.all(np.asarray(part) > 0) for part in multipliers):
        return False
    matrix, error = witness_matrix(weights, multipliers, linear)  # NaN or infinity in any part stays in it
    inputs = len(matrix) - sum(len(part) for part in multipliers)
    matrix[:inputs, :inputs] += bound**2 * (1 - 4 * UNIT) * np.eye(inputs)
    return is_positive_definite(matrix, error)


def witness_matrix(
    weights: Sequence[Matrix], multipliers: Sequence[Vector], linear: Matrix | None = None
) -> tuple[Matrix, float]:
    """The matrix above without its b² I, and a bound on its rounding error (2-norm)."""
    weights = [np.asarray(weight, dtype=np.float64) for weight in weights]
    first = weights[0] if weights else np.asarray(linear, dtype=np.float64)
    edges = np.cumsum([0, first.shape[1], *(len(part) for part in multipliers)])
    blocks = [slice(a, b) for a, b in pairwise(edges)]
    matrix, error = np.zeros((edges[-1], edges[-1])), 0.0
    for k, multiplier in enumerate(multipliers):
        coupling = np.asarray(multiplier, dtype=np.float64)[:, None] * weights[k]
        error += 4 * UNIT * float(np.linalg.norm(coupling))
        matrix[blocks[k + 1], blocks[k]] = -coupling
        matrix[blocks[k], blocks[k + 1]] = -coupling.T
        matrix[blocks[k + 1], blocks[k + 1]] = np.diag(2 * np.asarray(multiplier, dtype=np.float64))
    output = np.zeros((len(weights[-1] if weights else first), edges[-1]))
    if weights:
        output[:, blocks[-1]] = weights[-1]
    if linear is not None:
        output[:, blocks[0]] += linear
    emitted, rounding = product(output.T, output)
    matrix -= 0.5 * (emitted + emitted.T)
    return matrix, error + 2 * rounding + 4 * UNIT * float(np.linalg.norm(matrix))


def check_metric(metric: Matrix, operators: Sequence[Matrix], rate: float, condition: float) -> bool:
    """Whether A' P A < ρ² P for every A, and λ_max(P) < κ λ_min(P), both recomputed from P: solvers only propose it.

    Then |A z|_P ≤ ρ |z|_P, also for every A in the convex hull, and β in the 2-norm is at most β √κ in the P-norm.
    """
    largest, size = norm_upper(metric), len(metric)
    smallest = largest / condition * (1 + 4 * UNIT)  # P is at least this, or κ is too small
    proved = [is_positive_definite(metric - smallest * np.eye(size), 2 * UNIT * largest)]
    for operator in operators:
        half, first = product(metric, operator)
        moved, second = product(np.asarray(operator).T, half)
        error = first * norm_upper(operator) + second + 8 * UNIT * size * (rate**2 + 1) * largest
        proved.append(is_positive_definite(rate**2 * metric - 0.5 * (moved + moved.T), error))
    return all(proved) and rate > 0 and bool(1 <= condition < np.inf)
