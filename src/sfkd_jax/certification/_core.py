"""Trusted core: every proof is checked here, in numpy float64, without a solver."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

Matrix = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, " _"]
Layers = Sequence[Matrix]
Multipliers = Sequence[Vector]
Vertices = Sequence[Matrix | None]
UNIT, TINY = np.finfo(np.float64).eps / 2, np.finfo(np.float64).tiny
SMALLEST = np.nextafter(0.0, 1.0)
"""A denormal number. Nothing is proved if the processor flushes it to zero."""
MARGIN = 1e-6
"""Relative margin, far above the rounding of norms and sums of fewer than 10^4 rows."""


@np.errstate(over="ignore", invalid="ignore")  # comparisons refuse NaN and infinity
def is_positive_definite(matrix: Matrix, error: float = 0.0) -> bool:
    """Check that every symmetric matrix within `error` of M is positive definite.

    For every real L and c, M = L L' + c I + R with L L' ≥ 0. If ||R|| + error < c in
    the 2-norm, M is positive definite. L is LAPACK's Cholesky factor of M − c I; it
    need not be exact, because the norm of R is bounded here, including rounding. M is
    scaled by a power of two to entries below 1, so nothing overflows and underflow
    loses at most `lost`. Returns False if in doubt: comparisons with NaN are false.
    """
    size, largest = len(matrix), np.max(np.abs(matrix), initial=0.0)
    symmetric = np.array_equal(matrix, matrix.T)
    if not (largest < np.inf and symmetric and 0 <= error < np.inf and SMALLEST > 0):
        return False
    exponent = -int(np.frexp(largest)[1])
    scaled, error = np.ldexp(matrix, exponent), float(np.ldexp(error, exponent))
    lost = 4 * size**2 * TINY
    factorisation = 4 * (size + 2) * UNIT * float(np.trace(scaled))
    shift = factorisation + error * (1 + 4 * MARGIN) + 4 * lost
    moved = shift * np.eye(size)
    try:
        factor = np.linalg.cholesky(scaled - moved)
    except np.linalg.LinAlgError:
        return False
    squared, rounding = product(factor, factor.T)
    residual = frobenius(scaled - squared - moved) + rounding
    return bool(residual * (1 + MARGIN) + error + lost < shift * (1 - MARGIN))


def frobenius(matrix: Matrix) -> float:
    """Return ||M||_F ≥ ||M||_2 without overflow or underflow of the squares."""
    flat = matrix.ravel(order="K")
    size = float(np.sqrt(flat.dot(flat)))
    if 1e-140 < size < 1e140:
        return size
    largest = float(np.max(np.abs(matrix), initial=0.0))
    return largest * float(np.linalg.norm(matrix / largest)) if largest > 0 else largest


def product(left: Matrix, right: Matrix) -> tuple[Matrix, float]:
    """Return a product and a bound on its rounding error (Frobenius norm).

    For k columns of X and any order of summation, |fl(X Y) − X Y| ≤ γ_k |X| |Y| entry
    by entry, and || |X| |Y| ||_F ≤ ||X||_F ||Y||_F.
    """
    left, right = (np.asarray(matrix, dtype=np.float64) for matrix in (left, right))
    error = (left.shape[1] + 2) * UNIT * frobenius(left) * frobenius(right)
    return left @ right, error * (1 + MARGIN) + left.size * right.shape[1] * TINY


def norm_upper(matrix: Matrix) -> float:
    """Return a proven upper bound on ||M||_2, infinity if M is not finite."""
    matrix = np.asarray(matrix, dtype=np.float64)
    if not np.all(np.isfinite(matrix)):
        return float("inf")
    guess = float(np.linalg.norm(matrix, 2))
    for slack in (1e-12, 1e-10, 1e-8, 1e-6, 1e-3, 1.0):
        if check_witness((), (), bound := guess * (1 + slack), matrix):
            return bound
    return float(np.sum(np.abs(matrix))) * (1 + MARGIN)


def check_witness(
    weights: Layers,
    multipliers: Multipliers,
    bound: float,
    linear: Matrix | None = None,
    metric: Matrix | None = None,
) -> bool:
    """Check that multipliers λ prove |f(z) − f(z')|_P ≤ b |z − z'|_P for all z, z'.

    Here f = A z + W_L σ(… σ(W_1 z + b_1) …) + b_L, with any biases and any σ that acts
    entry by entry with slopes in [0, 1]. With Λ_k = diag λ_k > 0 and P > 0 it suffices
    (LipSDP with diagonal multipliers) that

        [ b² P  −W_1'Λ_1           ]
        [   ·    2Λ_1   −W_2'Λ_2 … ]  −  [A 0 … W_L]' P [A 0 … W_L]  >  0

    By Schur's complement this is linear in (A, Λ, b²): witnesses at the vertices of a
    polytope of A prove the largest of their bounds for every A in it. Without weights
    f = A z, without A it is 0, without P it is I (then z and f may have any sizes).
    """
    return check_vertices(weights, [multipliers], bound, [linear], metric)


@np.errstate(over="ignore", invalid="ignore")
def check_vertices(
    weights: Layers,
    witnesses: Sequence[Multipliers],
    bound: float,
    vertices: Vertices,
    metric: Matrix | None = None,
) -> bool:
    """`check_witness` at every vertex A with its own multipliers and a common P."""
    if metric is not None and not is_positive_definite(metric):
        return False
    hidden = max(len(weights) - 1, 0)
    fits = len(witnesses) == len(vertices) and all(len(w) == hidden for w in witnesses)
    positive = all(np.all(np.asarray(part) > 0) for w in witnesses for part in w)
    if not (witnesses and fits and positive and 0 < bound < np.inf):
        return False
    return all(
        is_positive_definite(*witness_matrix(weights, w, bound, vertex, metric))
        for w, vertex in zip(witnesses, vertices, strict=True)
    )


def witness_matrix(
    weights: Layers,
    multipliers: Multipliers,
    bound: float,
    linear: Matrix | None = None,
    metric: Matrix | None = None,
) -> tuple[Matrix, float]:
    """Return the matrix of `check_witness` and a bound on its rounding error."""
    first = np.asarray(weights[0] if weights else linear, dtype=np.float64)
    form = np.eye(first.shape[1]) if metric is None else np.asarray(metric, np.float64)
    start = np.square(bound) * form
    edges = np.cumsum([0, first.shape[1], *map(len, multipliers)])
    blocks = [slice(a, b) for a, b in pairwise(edges)]
    matrix, error = np.zeros((edges[-1], edges[-1])), 0.0
    matrix[blocks[0], blocks[0]] = start
    for k, part in enumerate(multipliers):
        multiplier = np.asarray(part, dtype=np.float64)
        coupling = multiplier[:, None] * np.asarray(weights[k], dtype=np.float64)
        matrix[blocks[k + 1], blocks[k]] = -coupling
        matrix[blocks[k], blocks[k + 1]] = -coupling.T
        matrix[blocks[k + 1], blocks[k + 1]] = np.diag(2 * multiplier)
        error += 4 * UNIT * frobenius(coupling)
    output = np.zeros((len(weights[-1] if weights else first), edges[-1]))
    if weights:
        output[:, blocks[-1]] = weights[-1]
    if linear is not None:
        output[:, blocks[0]] += linear
    weighted, before = (output, 0.0) if metric is None else product(metric, output)
    squared, rounding = product(output.T, weighted)
    inexact = 2 * before + 4 * UNIT * frobenius(weighted)
    error += frobenius(output) * inexact + 2 * rounding
    matrix -= 0.5 * (squared + squared.T)
    summands = frobenius(squared) + frobenius(start) + frobenius(matrix)
    error += 4 * UNIT * summands + matrix.size * TINY
    return matrix, error


def check_metric(
    metric: Matrix, operators: Sequence[Matrix], rate: float, condition: float
) -> bool:
    """Check that A' P A < ρ² P for every operator A and λ_max(P) < κ λ_min(P).

    Then |A z|_P ≤ ρ |z|_P, also for every A in the convex hull, and a Lipschitz
    constant β in the 2-norm is at most β √κ in the P-norm.
    """
    largest, size = norm_upper(metric), len(metric)
    if not (1 <= condition < np.inf and largest < np.inf):
        return False
    least = largest / condition * (1 + 4 * UNIT)  # P ≥ least I, or κ is too small
    error = 4 * UNIT * size * largest
    if not is_positive_definite(metric - least * np.eye(size), error):
        return False
    return check_vertices((), [()] * len(operators), rate, operators, metric)
