"""Lipschitz bounds of networks, alone and beside A z, with known constants."""

import numpy as np
import pytest
from networks import rotation

from sfkd_jax.certification import lipschitz_upper
from sfkd_jax.certification._attack import attack_slopes
from sfkd_jax.certification._search import propose_multipliers

SIZE = 6
RANDOM = np.random.default_rng(0)


def diagonal(entries):
    """Every coordinate is a scalar chain of its own: max_i Π |d_i|, λ_k = Π_{j>k} d_j²."""
    multipliers = [entries[1] ** 2 * entries[2] ** 2, entries[2] ** 2]
    exact = np.max(np.abs(np.prod(entries, axis=0)))
    return [np.diag(row) for row in entries], multipliers, exact


def orthogonal(scales=(2.0, 0.5, 3.0)):
    """Aligned orthogonal factors: the product of the scales, λ_k = Π_{j>k} s_j²."""
    weights = [scale * rotation(SIZE, seed) for seed, scale in enumerate(scales)]
    multipliers = [
        np.full(SIZE, np.prod(np.square(scales[k + 1 :])))
        for k in range(len(scales) - 1)
    ]
    return weights, multipliers, float(np.prod(scales))


def positive(seed, shapes=((8, 6), (7, 8), (6, 7))):
    random = np.random.default_rng(seed)
    weights = [random.uniform(0.05, 0.5, shape) for shape in shapes]
    return weights, random.uniform(0.05, 0.5, (6, 6))


CHAINS = RANDOM.uniform(0.2, 2.0, (3, SIZE)) * RANDOM.choice([-1, 1], (3, SIZE))
SPIKY = CHAINS * np.asarray([[0.01], [1.0], [1.0]])
SPIKY[:, 4] = 5.0, 1.0, 1.0
"""One steep channel among many flat ones, seen by few samples."""
EXACT = {
    "orthogonal": orthogonal(),
    "orthogonal, five layers": orthogonal((1.1, 0.9, 2.0, 0.5, 1.0)),
    "diagonal": diagonal(CHAINS),
    "spiky": diagonal(SPIKY),
}


@pytest.mark.parametrize("name", EXACT)
def test_the_bound_of_a_network_with_a_known_constant_is_tight_from_above(name):
    weights, multipliers, exact = EXACT[name]
    bound = lipschitz_upper(weights, multipliers)[0]
    assert exact * (1 - 1e-14) <= bound <= exact * (1 + 1e-3)


@pytest.mark.parametrize("scale", [1e-5, 1e-8, 1e-30])
def test_a_network_that_training_made_negligible_has_a_bound(scale):
    weights, multipliers = positive(0)[0], [np.full(8, 0.5), np.full(7, 0.5)]
    weights = [scale * weights[0], 0.1 * weights[1], scale * weights[2]]
    bound = lipschitz_upper(weights, multipliers)[0]
    assert np.prod([np.linalg.norm(part, 2) for part in weights]) <= bound <= 1.01e-4


def test_useless_multipliers_prove_nothing():
    weights, multipliers, _ = EXACT["orthogonal"]
    spoiled = [
        [spoil * part for part in multipliers] for spoil in (np.nan, -1.0, 0.0, np.inf)
    ]
    for useless in (*spoiled, multipliers[:1], []):
        assert lipschitz_upper(weights, useless)[0] == np.inf


# --- A z + network(z) -----------------------------------------------------------------


def random_network(seed):
    random = np.random.default_rng(seed)
    shapes = (8, 6), (7, 8), (6, 7)
    return [random.standard_normal(shape) / shape[1] ** 0.5 for shape in shapes]


def best(weights, linear=None):
    return lipschitz_upper(weights, propose_multipliers(weights, (), linear), linear)[0]


TURN, LAST = rotation(SIZE, 3), rotation(SIZE, 4)
POSITIVE, OPERATOR = positive(0)
JOINT = {
    # Every slope at 1 is the worst of positive matrices.
    "positive": (
        POSITIVE,
        OPERATOR,
        np.linalg.norm(OPERATOR + np.linalg.multi_dot(POSITIVE[::-1]), 2),
    ),
    # A and the residual stretch the same direction: no better than the sum of norms.
    "aligned": ([0.15 * TURN, LAST, LAST.T], 0.8 * TURN, 0.95),
    "aligned, A = I": ([0.3 * np.eye(SIZE), np.eye(SIZE)], 0.6 * np.eye(SIZE), 0.9),
    "cancelling": ([0.3 * np.eye(SIZE), -np.eye(SIZE)], 0.9 * np.eye(SIZE), 0.9),
    "diagonal": (
        [np.diag(np.linspace(0.1, 0.6, SIZE)), np.eye(SIZE)],
        np.diag(np.linspace(0.9, 0.2, SIZE)),
        1.0,
    ),
}
"""W, A, and the exact constant."""


@pytest.mark.parametrize("name", JOINT)
def test_bound_and_attack_enclose_a_known_constant_tightly(name):
    weights, linear, constant = JOINT[name]
    assert constant * (1 - 1e-12) <= best(weights, linear) <= constant * 1.01
    assert attack_slopes(weights, linear) == pytest.approx(constant, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_joint_bound_lies_between_the_attack_and_the_sum_of_norms(seed):
    weights, linear = random_network(seed), 0.9 * rotation(SIZE, seed)
    joint = best(weights, linear)
    attack = attack_slopes(weights, linear)
    assert attack <= joint <= 0.9 + best(weights) + 1e-6
    assert joint <= 1.15 * attack


def test_witnesses_at_the_vertices_prove_the_bound_everywhere_in_their_hull():
    weights = random_network(1)
    vertices = [0.8 * rotation(SIZE, seed) for seed in range(4)]
    proposed = [propose_multipliers(weights, (), vertex) for vertex in vertices]
    bound = max(
        lipschitz_upper(weights, part, vertex)[0]
        for part, vertex in zip(proposed, vertices, strict=True)
    )
    for shares in RANDOM.dirichlet(np.full(4, 0.5), size=30):
        inside = np.tensordot(shares, vertices, 1)
        mixed = [
            np.tensordot(shares, layer, 1) for layer in zip(*proposed, strict=True)
        ]
        assert attack_slopes(weights, inside, starts=3) <= bound
        assert lipschitz_upper(weights, mixed, inside)[0] <= bound * (1 + 1e-3)
