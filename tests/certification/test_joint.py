"""The joint bound: exact cases, hulls, the semidefinite optimum, and mutants."""

import numpy as np
import pytest
from helpers import certified, explicit

from sfkd_jax.certification import lipschitz_upper
from sfkd_jax.certification._attack import attack_slopes
from sfkd_jax.certification._search import propose_multipliers

SIZE = 6
RANDOM = np.random.default_rng(0)


def rotation(seed, size=SIZE):
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))[0]


def random_network(seed, shapes=((8, 6), (7, 8), (6, 7))):
    random = np.random.default_rng(seed)
    return [random.standard_normal(shape) / shape[1] ** 0.5 for shape in shapes]


def positive(seed, shapes=((8, 6), (7, 8), (6, 7))):
    random = np.random.default_rng(seed)
    return [random.uniform(0.05, 0.5, shape) for shape in shapes], random.uniform(
        0.05, 0.5, (6, 6)
    )


def best(weights, linear=None):
    return lipschitz_upper(weights, propose_multipliers(weights, (), linear), linear)[0]


def aligned(share):
    """A and the residual stretch the same direction: no joint certificate can be better
    than the sum of norms.
    """
    turn = rotation(3)
    return [share * turn, rotation(4), rotation(4).T], 0.8 * turn, 0.8 + share


JOINT = {
    "positive": (*positive(0), None),
    "aligned": aligned(0.15),
    "aligned, A = I": ([0.3 * np.eye(SIZE), np.eye(SIZE)], 0.6 * np.eye(SIZE), 0.9),
    "cancelling": ([0.3 * np.eye(SIZE), -np.eye(SIZE)], 0.9 * np.eye(SIZE), 0.9),
    "diagonal": (
        [np.diag(np.linspace(0.1, 0.6, SIZE)), np.eye(SIZE)],
        np.diag(np.linspace(0.9, 0.2, SIZE)),
        1.0,
    ),
}
"""W, A, and the exact constant where it is known by heart (else that of all slopes at
1: positive matrices).
"""


def exact(weights, linear, known):
    chained = np.linalg.multi_dot(weights[::-1])
    return known if known is not None else np.linalg.norm(linear + chained, 2)


@pytest.mark.parametrize("name", JOINT)
def test_bound_and_attack_enclose_a_known_constant_tightly(name):
    weights, linear, known = JOINT[name]
    constant = exact(weights, linear, known)
    assert constant * (1 - 1e-12) <= best(weights, linear) <= constant * 1.01
    assert attack_slopes(weights, linear) == pytest.approx(constant, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_joint_bound_lies_between_the_attack_and_the_sum_of_norms(seed):
    weights, linear = random_network(seed), 0.9 * rotation(seed)
    joint = best(weights, linear)
    attack = attack_slopes(weights, linear)
    assert attack <= joint <= 0.9 + best(weights) + 1e-6
    assert joint <= 1.15 * attack


def test_witnesses_at_the_vertices_prove_the_bound_everywhere_in_their_hull():
    weights = random_network(1)
    vertices = [0.8 * rotation(seed) for seed in range(4)]
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


def test_slopes_anywhere_in_the_hull_of_a_model_stay_below_its_joint_alpha():
    weights, proved = explicit("sfkd"), certified("sfkd")
    vertices = weights.operators.vertices
    for operator in (*vertices, vertices.mean(axis=0)):
        assert attack_slopes(weights.residual, operator) <= proved.alpha_joint
    assert proved.alpha_joint <= proved.alpha_separate * (1 + 1e-6)


# --- solvers that lie -----------------------------------------------------------------


@pytest.mark.parametrize(
    "garbage",
    [
        lambda parts: [np.full_like(part, np.nan) for part in parts],
        lambda parts: [0.01 * part for part in parts],
        lambda parts: [-part for part in parts],
        lambda parts: parts[:1],
        lambda parts: [],
        lambda parts: [
            part * np.exp(RANDOM.normal(0, 0.3, len(part))) for part in parts
        ],
    ],
)
def test_what_a_solver_returns_never_makes_a_bound_smaller(garbage):
    """Whatever it calls its status: the bound is recomputed from the multipliers, or
    there is none.
    """
    weights, linear, known = JOINT["aligned"]
    constant = exact(weights, linear, known)
    proposed = garbage(propose_multipliers(weights, (), linear))
    assert lipschitz_upper(weights, proposed, linear)[0] >= constant * (1 - 1e-12)
