"""The trusted core: numpy float64, no solver, no search. What is proposed elsewhere counts only if it passes here."""

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
SMALLEST = np.nextafter(
    0.0, 1.0
)  # denormal: where a library makes the processor flush it to zero nothing is proved
# Relative; far above what norms, sums and differences of fewer than 10^4 rows lose by
# rounding.
MARGIN = 1e-6


@np.errstate(
    over="ignore", invalid="ignore"
)  # NaN and infinity are refused by the comparisons
def is_positive_definite(matrix: Matrix, error: float = 0.0) -> bool:
    """Whether every symmetric matrix within `error` (2-norm) of `matrix` is positive definite; rounding included.

    For every real L and every c, M = L L' + c I + R, and L L' ≥ 0: M is positive
    definite if ||R|| + error < c. The Cholesky factor of M − c I is one such L. LAPACK
    proposes it and is not believed: the norm of R is bounded here. M is scaled by a
    power of two to entries below 1, so that nothing overflows and what underflows is at
    most `lost`. False when in doubt: every comparison with NaN is false.
    """
    size, largest = len(matrix), np.max(np.abs(matrix), initial=0.0)
    if not (
        largest < np.inf
        and np.array_equal(matrix, matrix.T)
        and 0 <= error < np.inf
        and SMALLEST > 0
    ):
        return False
    exponent = -int(np.frexp(largest)[1])
    scaled, error = np.ldexp(matrix, exponent), float(np.ldexp(error, exponent))
    lost = 4 * size**2 * TINY
    shift = (
        4 * (size + 2) * UNIT * float(np.trace(scaled))
        + error * (1 + 4 * MARGIN)
        + 4 * lost
    )
    moved = shift * np.eye(size)
    try:
        factor = np.linalg.cholesky(scaled - moved)
    except np.linalg.LinAlgError:
        return False
    squared, rounding = product(factor, factor.T)
    rest = frobenius(scaled - squared - moved) + rounding
    return bool(rest * (1 + MARGIN) + error + lost < shift * (1 - MARGIN))


def frobenius(matrix: Matrix) -> float:
    """||M||_F, which is at least ||M||_2, without overflow or underflow of the squares."""
    flat = matrix.ravel(order="K")
    size = float(np.sqrt(flat.dot(flat)))
    if 1e-140 < size < 1e140:
        return size
    largest = float(np.max(np.abs(matrix), initial=0.0))
    return largest * float(np.linalg.norm(matrix / largest)) if largest > 0 else largest


def product(left: Matrix, right: Matrix) -> tuple[Matrix, float]:
    """A product in float64, and a bound on its rounding error (Frobenius norm) for any order of summation.

    |fl(X Y) − X Y| ≤ γ_k |X| |Y| entry by entry for k columns of X, and || |X| |Y| ||_F ≤ ||X||_F ||Y||_F.
    """
    left, right = (
        np.asarray(left, dtype=np.float64),
        np.asarray(right, dtype=np.float64),
    )
    error = (
        (left.shape[1] + 2) * UNIT * frobenius(left) * frobenius(right) * (1 + MARGIN)
    )
    return left @ right, error + left.size * right.shape[1] * TINY


def norm_upper(matrix: Matrix) -> float:
    """A proven upper bound on ||M||_2, tight to about 1e-12; infinity if M is not finite."""
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
    """Whether the multipliers prove |f(z) − f(z')|_P ≤ b |z − z'|_P for f = A z + W_L σ(… σ(W_1 z + b_1) …) + b_L.

    For any biases and any σ applied entry by entry with slopes in [0, 1]: with Λ_k =
    diag λ_k > 0 and P > 0 it suffices that

        [ b² P  −W_1'Λ_1           ]
        [   ·    2Λ_1   −W_2'Λ_2 … ]  −  [A 0 … W_L]' P [A 0 … W_L]  >  0    (LipSDP with diagonal multipliers)

    By Schur's complement this is linear in (A, Λ, b²): witnesses at the vertices of a
    polytope of A prove the largest of their bounds for every A in it. No weights: f = A
    z. No A: it is 0. No P: it is I, for z and f of any sizes.
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
    """`check_witness` at every vertex A, each with multipliers of its own; P is one for all and proved once."""
    if metric is not None and not is_positive_definite(metric):
        return False
    fits = len(witnesses) == len(vertices) and all(
        len(part) == max(len(weights) - 1, 0) for part in witnesses
    )
    positive = all(
        np.all(np.asarray(part) > 0)
        for multipliers in witnesses
        for part in multipliers
    )
    return bool(witnesses and fits and positive and 0 < bound < np.inf) and all(
        is_positive_definite(
            *witness_matrix(weights, multipliers, bound, vertex, metric)
        )
        for multipliers, vertex in zip(witnesses, vertices, strict=True)
    )


def witness_matrix(
    weights: Layers,
    multipliers: Multipliers,
    bound: float,
    linear: Matrix | None = None,
    metric: Matrix | None = None,
) -> tuple[Matrix, float]:
    """The matrix above, and a bound on its rounding error (2-norm)."""
    first = np.asarray(weights[0] if weights else linear, dtype=np.float64)
    start = np.square(bound) * (
        np.eye(first.shape[1])
        if metric is None
        else np.asarray(metric, dtype=np.float64)
    )
    edges = np.cumsum([0, first.shape[1], *(len(part) for part in multipliers)])
    blocks = [slice(a, b) for a, b in pairwise(edges)]
    matrix, error = np.zeros((edges[-1], edges[-1])), 0.0
    matrix[blocks[0], blocks[0]] = start
    for k, multiplier in enumerate(
        np.asarray(part, dtype=np.float64) for part in multipliers
    ):
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
    error += (
        frobenius(output) * (2 * before + 4 * UNIT * frobenius(weighted)) + 2 * rounding
    )
    matrix -= 0.5 * (squared + squared.T)
    error += (
        4 * UNIT * (frobenius(squared) + frobenius(start) + frobenius(matrix))
        + matrix.size * TINY
    )
    return matrix, error


def check_metric(
    metric: Matrix, operators: Sequence[Matrix], rate: float, condition: float
) -> bool:
    """Whether A' P A < ρ² P for every A, and λ_max(P) < κ λ_min(P), both recomputed from P: solvers only propose it.

    Then |A z|_P ≤ ρ |z|_P, also for every A in the convex hull, and β in the 2-norm is
    at most β √κ in the P-norm.
    """
    largest, size = norm_upper(metric), len(metric)
    if not (1 <= condition < np.inf and largest < np.inf):
        return False
    least = (
        largest / condition * (1 + 4 * UNIT)
    )  # P is at least this, or κ is too small
    proved = is_positive_definite(
        metric - least * np.eye(size), 4 * UNIT * size * largest
    )
    return proved and check_vertices((), [()] * len(operators), rate, operators, metric)
