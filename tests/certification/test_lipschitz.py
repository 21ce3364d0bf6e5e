"""Lipschitz bounds of networks with known constants, and faulty certifiers."""

import numpy as np
import pytest
from helpers import explicit, steepest_pattern

from sfkd_jax.certification import check_witness, lipschitz_upper

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
    random = np.random.default_rng(seed)
    entries = random.uniform(0.2, 2.0, (3, SIZE)) * random.choice([-1, 1], (3, SIZE))
    multipliers = [entries[1] ** 2 * entries[2] ** 2, entries[2] ** 2]
    exact = np.max(np.abs(np.prod(entries, axis=0)))
    return [np.diag(row) for row in entries], multipliers, exact


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
    "orthogonal, five layers": orthogonal((1.1, 0.9, 2.0, 0.5, 1.0)),
    "diagonal": diagonal(0),
    "positive": positive(0),
    "spiky": spiky(),
}


@pytest.mark.parametrize("name", EXACT)
def test_the_bound_of_a_network_with_a_known_constant_is_tight_from_above(name):
    weights, multipliers, exact = EXACT[name]
    assert (
        exact * (1 - 1e-14)
        <= lipschitz_upper(weights, multipliers)[0]
        <= exact * (1 + 1e-3)
    )


@pytest.mark.parametrize("factor", [0.3, 3.9])
def test_multipliers_off_by_a_common_factor_cost_little(factor):
    weights, multipliers, exact = EXACT["orthogonal"]
    bound = lipschitz_upper(weights, [factor * part for part in multipliers])[0]
    assert exact * (1 - 1e-14) <= bound <= exact * 1.01


def test_useless_multipliers_prove_nothing():
    weights, multipliers, _ = EXACT["orthogonal"]
    for spoil in (np.nan, -1.0, 0.0, np.inf):
        assert (
            lipschitz_upper(weights, [spoil * part for part in multipliers])[0]
            == np.inf
        )
    assert lipschitz_upper(weights, multipliers[:1])[0] == np.inf
    assert lipschitz_upper(weights, [])[0] == np.inf


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
