"""Matrices chosen to fool a Cholesky factorisation, and their definiteness in exact
integer arithmetic.
"""

import itertools
import math
from fractions import Fraction

import numpy as np

EXTREMES = (1e-320, 1e-308, 1e-200, 1e-150, 1e-16, 1.0, 1e16, 1e150, 1e200, 1e300)


rational = np.vectorize(Fraction, otypes=[object])
"""A matrix of floats as one of fractions, without rounding."""


def is_definite(rows):
    """Whether a symmetric matrix of floats or fractions is positive definite:
    Sylvester's criterion by Bareiss.
    """
    exact, before = rational(rows), 1
    # Times one positive number that makes integers of them.
    common = math.lcm(*(entry.denominator for entry in exact.flat))
    matrix = [[int(entry * common) for entry in row] for row in exact]
    size = len(matrix)
    for k in range(size):
        pivot = matrix[k][k]  # the k-th leading minor
        if pivot <= 0:
            return False
        for i in range(k + 1, size):
            for j in range(k + 1, size):
                matrix[i][j] = (
                    matrix[i][j] * pivot - matrix[i][k] * matrix[k][j]
                ) // before
        before = pivot
    return True


def symmetric(matrix):
    """A matrix that is its own transpose, to the bit."""
    return np.tril(matrix) + np.tril(matrix, -1).T


@np.errstate(over="ignore", invalid="ignore")
def hostile_matrix(random):
    """A small symmetric matrix near the edge of the cone, and an error that is claimed
    to be tolerated.
    """
    size = int(random.integers(1, 6))
    half = random.integers(-4, 5, (size, size)) * np.exp2(
        random.integers(-30, 30, (size, 1)) * random.integers(0, 2)
    )
    kind = random.integers(9)
    if kind == 0:  # singular, every product exact
        half = half[: size - 1]
    if kind == 1 and size > 1:  # two equal rows and columns
        half[:, 0] = half[:, 1]
    if kind == 2 and size > 1:  # two rows that nearly agree
        half[:, 0] = half[:, 1] * (1 + np.exp2(-int(random.integers(20, 53))))
    matrix = half.T @ half
    if kind == 3:  # graded by rows of extreme scales
        grading = random.choice(EXTREMES, size)
        matrix = grading[:, None] * matrix * grading[None, :]
    if kind == 4:  # of one extreme scale
        matrix = matrix * random.choice(EXTREMES)
    if kind == 5:  # a tiny step across the edge
        matrix = matrix - np.exp2(-int(random.integers(0, 70))) * np.trace(
            matrix
        ) * np.eye(size)
    if kind == 6:  # an entry moved by units in the last place
        i, j = random.integers(size, size=2)
        matrix[max(i, j), min(i, j)] *= 1 + np.exp2(-52) * random.integers(-4, 5)
    if kind == 7:  # an entry that is no number, or hardly one
        i, j = random.integers(size, size=2)
        matrix[max(i, j), min(i, j)] = random.choice(
            [np.nan, np.inf, -np.inf, 5e-324, -5e-324, 1e308, 0.0]
        )
    if kind == 8:  # a pivot that nearly vanishes after a large coupling
        matrix = np.diag(np.exp2(random.integers(-40, 40, size).astype(float)))
        matrix[-1, 0] = np.sqrt(matrix[0, 0] * matrix[-1, -1]) * (
            1 + np.exp2(-50) * random.integers(-3, 4)
        )
    error = random.choice([0.0, 0.0, 5e-324, 1e-300, np.exp2(-40.0), 0.5, 1e300])
    return symmetric(matrix), float(error)


def hostile_network(random):
    """Weights, multipliers, a bound, A and P near the edge of what a witness proves; or
    spoiled.
    """
    inputs, hidden, outputs = (int(n) for n in random.integers(1, 4, 3))
    linear = random.choice([0, 1]) * random.integers(-3, 4, (outputs, inputs)) / 4 * 1.0
    layers = int(random.integers(0, 4))
    widths = itertools.pairwise([inputs, *[hidden] * max(layers - 1, 0), outputs])
    weights = [random.integers(-3, 4, (b, a)) / 4 * 1.0 for a, b in widths][:layers]
    scale = random.choice([1.0, 1.0, 1.0, 1e-7, 1e7, 1e-150, 1e150])
    multipliers = [
        random.choice([1e-7, 0.5, 0.51, 1.0, 2.5], len(part)) * scale
        for part in weights[:-1]
    ]
    bound = float(random.choice([0.3, 0.5, 0.999, 1.0, 1.5, 4.0, 40.0, 1e-160, 1e150]))
    metric = None
    if inputs == outputs and random.integers(2):
        half = random.integers(-3, 4, (inputs, inputs)) + 4.0 * np.eye(inputs)
        metric = half.T @ half * random.choice([1.0, 1.0, 1e-12, 1e12, -1.0])
    if not random.integers(12) and multipliers:
        multipliers[0][0] = random.choice([np.nan, np.inf, 0.0, -1.0, 5e-324])
    linear = linear if layers == 0 or random.integers(2) else None
    return weights, multipliers, bound, linear, metric


def exact_witness(weights, multipliers, bound, linear, metric):
    """The matrix that has to be positive definite, in fractions."""
    first = weights[0] if weights else linear
    inputs, outputs = first.shape[1], len(weights[-1] if weights else first)
    norm_in = rational(np.eye(inputs) if metric is None else metric)
    norm_out = rational(np.eye(outputs) if metric is None else metric)
    edges = np.cumsum([0, inputs, *(len(part) for part in multipliers)])
    matrix = rational(np.zeros((edges[-1], edges[-1])))
    matrix[:inputs, :inputs] = Fraction(bound) ** 2 * norm_in
    for k, part in enumerate(multipliers):
        before, here = slice(edges[k], edges[k + 1]), slice(edges[k + 1], edges[k + 2])
        coupling = rational(part)[:, None] * rational(weights[k])
        matrix[here, before] -= coupling
        matrix[before, here] -= coupling.T
        matrix[here, here] += 2 * np.diag(rational(part))
    output = rational(np.zeros((outputs, edges[-1])))
    if weights:
        output[:, edges[-2] :] += rational(weights[-1])
    if linear is not None:
        output[:, :inputs] += rational(linear)
    return matrix - output.T.dot(norm_out).dot(output), norm_in


def search(cases, seed):
    """Count the cases that hold and that the core accepts; fail at the first accepted
    case that is false.
    """
    from sfkd_jax.certification import check_witness, is_positive_definite

    random = np.random.default_rng(seed)
    counts = {"matrices": 0, "witnesses": 0, "true": 0, "accepted": 0}
    for number in range(cases):
        true = False
        if number % 2:
            shown = hostile_network(random)
            accepted = check_witness(*shown)
            if all(np.all(np.isfinite(m)) and np.all(m > 0) for m in shown[1]):
                true = all(map(is_definite, exact_witness(*shown)))
        else:
            shown = matrix, error = hostile_matrix(random)
            accepted = is_positive_definite(matrix, error)
            if np.all(np.isfinite(matrix)):
                moved = Fraction(error) * rational(np.eye(len(matrix)))
                true = is_definite(rational(matrix) - moved)
        counts["witnesses" if number % 2 else "matrices"] += 1
        counts["accepted"] += accepted
        counts["true"] += true
        if accepted and not true:
            raise AssertionError(
                f"case {number} of seed {seed} is accepted and false: {shown}"
            )
    return counts


def forged_witness():
    """A network of gain 52 and multipliers whose factorisation grows until a pivot is
    NaN; the bound claimed is 0.5.
    """
    small, chain = 3.2e-4, 62
    first, last = np.zeros((76, 64), np.float32), np.zeros((64, 76), np.float32)
    growing = np.arange(chain - 3)
    last[growing, growing] = last[growing + 1, growing] = last[0, chain] = small
    first[chain + 1 :, 0] = last[63, chain + 1 :] = 2.0
    multipliers = [
        1.0240223779264118e-07,
        0.5242630550075378,
        *57 * [0.513300755193718],
        0.49994975228662497,
    ]
    return [first, last], [np.asarray([*multipliers, *3 * [0.5], *13 * [2.5]])], 0.5
