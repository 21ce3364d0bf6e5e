"""Lipschitz bounds of networks with known constants, and faulty certifiers."""

import numpy as np
import pytest
from helpers import explicit, steepest_pattern

from sfkd_jax.certification import check_witness, lipschitz_upper, norm_upper

SIZE = 8


def rotation(seed, size=SIZE):
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))[0]


def perron(weights):
    """For positive weights every slope is 1 at worst: the constant is ||W_L … W_1||_2,
    and with x its top singular vector, h_k = W_k … W_1 x, the multipliers Λ_k h_k =
    W_{k+1}' Λ_{k+1} h_{k+1} prove it (an M-matrix, positive null vector).
    """
    product = np.linalg.multi_dot(weights[::-1]) if len(weights) > 1 else weights[0]
    x = np.abs(np.linalg.svd(product)[2][0])
    hidden = [x]
    for matrix in weights:
        hidden.append(matrix @ hidden[-1])
    multipliers, pulled = [], hidden[-1]
    for matrix, h in zip(weights[:0:-1], hidden[-2:0:-1], strict=True):
        pulled = matrix.T @ pulled
        multipliers.insert(0, pulled / h)
    return multipliers, np.linalg.norm(product, 2)


def diagonal(seed):
    """Every coordinate is a scalar chain of its own: max_i Π |d_i|, λ_k = Π_{j>k} d_j²."""
    entries = np.random.default_rng(seed).uniform(
        0.2, 2.0, (3, SIZE)
    ) * np.random.default_rng(seed).choice([-1, 1], (3, SIZE))
    multipliers = [entries[1] ** 2 * entries[2] ** 2, entries[2] ** 2]
    return (
        [np.diag(row) for row in entries],
        multipliers,
        np.max(np.abs(np.prod(entries, axis=0))),
    )


def orthogonal(scales=(2.0, 0.5, 3.0)):
    """Aligned orthogonal factors: the product of the scales, λ_k = Π_{j>k} s_j²."""
    weights = [scale * rotation(seed) for seed, scale in enumerate(scales)]
    multipliers = [
        np.full(SIZE, np.prod(np.square(scales[k + 1 :])))
        for k in range(len(scales) - 1)
    ]
    return weights, multipliers, float(np.prod(scales))


def positive(seed, shapes=((8, 5), (6, 8), (3, 6))):
    random = np.random.default_rng(seed)
    weights = [random.uniform(0.05, 1.0, shape) for shape in shapes]
    return weights, *perron(weights)


def spiky():
    """One steep channel among many flat ones, seen by few samples."""
    weights, _, _ = diagonal(3)
    weights = [0.01 * weights[0], weights[1], weights[2]]
    weights[0][4, 4], weights[1][4, 4], weights[2][4, 4] = 5.0, 1.0, 1.0
    entries = [np.diag(matrix) for matrix in weights]
    return weights, [entries[1] ** 2 * entries[2] ** 2, entries[2] ** 2], 5.0


EXACT = {
    "orthogonal": orthogonal(),
    "orthogonal, two layers": orthogonal((0.7, 1.3)),
    "orthogonal, five layers": orthogonal((1.1, 0.9, 2.0, 0.5, 1.0)),
    "diagonal": diagonal(0),
    "diagonal 2": diagonal(1),
    "positive": positive(0),
    "positive, two layers": positive(1, ((9, 4), (4, 9))),
    "spiky": spiky(),
}


@pytest.mark.parametrize("name", EXACT)
def test_the_bound_of_a_network_with_a_known_constant_is_tight_from_above(name):
    weights, multipliers, exact = EXACT[name]
    assert (
        exact * (1 - 1e-14)
        <= lipschitz_upper(weights, multipliers)
        <= exact * (1 + 1e-3)
    )


@pytest.mark.parametrize("factor", [0.3, 3.9])
def test_multipliers_off_by_a_common_factor_cost_little(factor):
    weights, multipliers, exact = EXACT["orthogonal"]
    bound = lipschitz_upper(weights, [factor * part for part in multipliers])
    assert exact * (1 - 1e-14) <= bound <= exact * 1.01


def test_useless_multipliers_prove_nothing():
    weights, multipliers, _ = EXACT["orthogonal"]
    for spoil in (np.nan, -1.0, 0.0, np.inf):
        assert (
            lipschitz_upper(weights, [spoil * part for part in multipliers]) == np.inf
        )
    assert lipschitz_upper(weights, multipliers[:1]) == np.inf
    assert lipschitz_upper(weights, []) == np.inf


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_the_multipliers_that_a_sandwich_carries_prove_its_own_bound(scale):
    weights = explicit("sfkd", scale)
    claimed = 0.1
    assert check_witness(
        weights.residual, weights.residual_multipliers, claimed * (1 + 1e-6)
    )
    true = steepest_pattern(weights.residual)
    assert not check_witness(weights.residual, weights.residual_multipliers, 0.9 * true)
    for spoil in (np.nan, -1.0):
        spoiled = [spoil * part for part in weights.residual_multipliers]
        assert not check_witness(weights.residual, spoiled, claimed * (1 + 1e-6))
    if scale == 1.0:
        halved = [0.5 * part for part in weights.residual_multipliers]
        assert not check_witness(weights.residual, halved, claimed * (1 + 1e-6))


# --- mutants: certifiers with a known fault, each of which a soundness check must catch


def power_iteration(matrix, steps=5):
    vector = np.random.default_rng(0).standard_normal(matrix.shape[1])
    for _ in range(steps):
        vector = matrix.T @ (matrix @ vector)
        vector = vector / np.linalg.norm(vector)
    return np.linalg.norm(matrix @ vector)


def sampled_norm(matrix, count=200):
    vectors = np.random.default_rng(0).standard_normal((matrix.shape[1], count))
    return np.max(
        np.linalg.norm(matrix @ vectors, axis=0) / np.linalg.norm(vectors, axis=0)
    )


def square(matrix):
    return matrix[: min(matrix.shape), : min(matrix.shape)]


NORMS = {
    "reference": norm_upper,
    "power iteration, 1 step": lambda matrix: power_iteration(matrix, 1),
    "power iteration, 5 steps": power_iteration,
    "Frobenius / sqrt(rank)": lambda matrix: (
        np.linalg.norm(matrix) / np.sqrt(np.linalg.matrix_rank(matrix))
    ),
    "spectral radius": lambda matrix: np.max(np.abs(np.linalg.eigvals(square(matrix)))),
    "0.999 of the norm": lambda matrix: 0.999 * norm_upper(matrix),
    "sampled": sampled_norm,
    "largest entry": lambda matrix: np.max(np.abs(matrix)),
    "NaN passes": lambda matrix: norm_upper(np.nan_to_num(matrix, nan=0.0)),
}

MATRICES = {
    "orthogonal": (rotation(0), 1.0),
    "close eigenvalues": (np.diag(np.linspace(0.9, 1.0, SIZE)), 1.0),
    "hidden direction": (
        0.5 * np.eye(SIZE) + 0.6 * np.outer(rotation(1)[0], rotation(1)[0]),
        1.1,
    ),
    "nilpotent": (np.diag([2.0] * (SIZE - 1), 1), 2.0),
    "rank 1": (
        np.outer(np.ones(SIZE), np.arange(1.0, SIZE + 1)),
        np.sqrt(SIZE * np.sum(np.arange(1.0, SIZE + 1) ** 2)),
    ),
    "NaN": (np.where(np.eye(SIZE) > 0, np.nan, 0.0), np.inf),
}


def passed(bound_of, cases):
    """Which soundness checks a certifier passes: a bound not below the constant; an
    error is a refusal.
    """
    verdicts = {}
    for name, (*inputs, exact) in cases.items():
        try:
            bound = bound_of(*inputs)
        except (np.linalg.LinAlgError, ValueError, FloatingPointError):
            bound = np.inf
        verdicts[name] = bool(bound >= exact * (1 - 1e-13))
    return verdicts


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("certifier", NORMS)
def test_every_mutant_of_the_norm_bound_is_caught_and_the_reference_is_not(certifier):
    verdicts = passed(NORMS[certifier], MATRICES)
    assert all(verdicts.values()) == (certifier == "reference"), verdicts


def product_of(norm):
    return lambda weights, multipliers: float(
        np.prod([norm(matrix) for matrix in weights])
    )


def jacobians(weights, count):
    """Largest Jacobian of a tanh network over random inputs: the paper's L_contr, used
    as a certificate.
    """
    random = np.random.default_rng(0)
    best = 0.0
    for _ in range(count):
        z, chained = (
            random.standard_normal(weights[0].shape[1]),
            np.eye(weights[0].shape[1]),
        )
        for k, matrix in enumerate(weights):
            before = matrix @ z
            slope = (
                np.ones_like(before)
                if k == len(weights) - 1
                else 1 - np.tanh(before) ** 2
            )
            chained, z = slope[:, None] * (matrix @ chained), np.tanh(before)
        best = max(best, np.linalg.norm(chained, 2))
    return best


def random_pairs(weights, count):
    random = np.random.default_rng(0)
    best = 0.0
    for _ in range(count):
        pair = random.standard_normal((2, weights[0].shape[1]))
        distance, values = np.linalg.norm(pair[0] - pair[1]), pair
        for matrix in weights[:-1]:
            values = np.tanh(values @ matrix.T)
        best = max(
            best, np.linalg.norm((values[0] - values[1]) @ weights[-1].T) / distance
        )
    return best


def unchecked(weights, multipliers, checker):
    """The smallest bound on a grid that some checker accepts."""
    grid = np.geomspace(1e-3, 1e3, 2000)
    return next(
        (bound for bound in grid if checker(weights, multipliers, bound)), np.inf
    )


def witness(weights, multipliers, bound, *, last=1.0, diagonal=2.0, tolerance=0.0):
    """The witness check with plain eigenvalues, and faults to choose."""
    sizes = [weights[0].shape[1], *(len(part) for part in multipliers)]
    edges = np.cumsum([0, *sizes])
    matrix = np.zeros((edges[-1], edges[-1]))
    matrix[: sizes[0], : sizes[0]] = bound**2 * np.eye(sizes[0])
    for k, part in enumerate(multipliers):
        here, before = slice(edges[k + 1], edges[k + 2]), slice(edges[k], edges[k + 1])
        matrix[here, here] = diagonal * np.diag(part)
        matrix[here, before] = -part[:, None] * weights[k]
        matrix[before, here] = matrix[here, before].T
    matrix[edges[-2] :, edges[-2] :] -= last * weights[-1].T @ weights[-1]
    if not np.all(np.isfinite(matrix)):
        return False
    return np.linalg.eigvalsh(matrix)[0] >= -tolerance


LIPSCHITZ = {
    "reference": lipschitz_upper,
    "power iteration per layer": product_of(power_iteration),
    "Frobenius / sqrt(rank) per layer": product_of(NORMS["Frobenius / sqrt(rank)"]),
    "spectral radius per layer": product_of(NORMS["spectral radius"]),
    "forgets the last layer": lambda weights, multipliers: product_of(norm_upper)(
        weights[:-1], multipliers
    ),
    "0.999 of the bound": lambda weights, multipliers: (
        0.999 * lipschitz_upper(weights, multipliers)
    ),
    "sampled Jacobian": lambda weights, multipliers: jacobians(weights, 300),
    "1.05 sampled Jacobian": lambda weights, multipliers: (
        1.05 * jacobians(weights, 300)
    ),
    "random pairs": lambda weights, multipliers: random_pairs(weights, 300),
    "no last layer in the witness": lambda *network: unchecked(
        *network, lambda *a: witness(*a, last=0.0)
    ),
    "3 Λ in the witness": lambda *network: unchecked(
        *network, lambda *a: witness(*a, diagonal=3.0)
    ),
    "loose eigenvalues in the witness": lambda *network: unchecked(
        *network, lambda *a: witness(*a, tolerance=1e-2)
    ),
    "any multipliers": lambda weights, multipliers: unchecked(
        weights, multipliers, lambda *a: True
    ),
    "NaN passes": lambda weights, multipliers: lipschitz_upper(
        [np.nan_to_num(w) for w in weights], multipliers
    ),
}

NETWORKS = EXACT | {
    "NaN": (
        [np.diag([np.nan] + [1.0] * (SIZE - 1)), np.eye(SIZE)],
        [np.ones(SIZE)],
        np.inf,
    )
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("certifier", LIPSCHITZ)
def test_every_mutant_of_the_lipschitz_bound_is_caught_and_the_reference_is_not(
    certifier,
):
    verdicts = passed(LIPSCHITZ[certifier], NETWORKS)
    assert all(verdicts.values()) == (certifier == "reference"), verdicts
