"""Ridge regression, free and under a norm bound (eq:koopid), against a convex program."""

from functools import cache

import cvxpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import driven, jit, space, tiny

from sfkd_jax import models
from sfkd_jax.experiment import stages
from sfkd_jax.models._identification import bounded_ridge, ridge_regression
from sfkd_jax.models.sfkd import bounded
from sfkd_jax.models.sfkd._bounds import attainable, unbounded
from sfkd_jax.models.sfkd._budget import budget_factors
from sfkd_jax.rollout import defects

RIDGE, BOUND, RANK = 1e-3, 0.7, 4


def test_ridge_regression_minimises_its_objective():
    random = np.random.default_rng(0)
    X = random.standard_normal((200, 6)) * np.float64([1, 10, 0.1, 1, 1, 0])
    Y, ridges = random.standard_normal((200, 3)), np.float32([1e-6, 0.1])
    fits = ridge_regression(
        jnp.asarray(X, jnp.float32), jnp.asarray(Y, jnp.float32), jnp.asarray(ridges)
    )
    D = np.sqrt(np.mean(X**2, axis=0)) + np.float64([0, 0, 0, 0, 0, 1])
    for ridge, W in zip(ridges, fits, strict=True):
        expected = np.linalg.solve(X.T @ X + ridge * 200 * np.diag(D**2), X.T @ Y)
        np.testing.assert_allclose(W, expected, rtol=1e-4, atol=1e-5)


def test_regression_survives_columns_that_normal_equations_do_not():
    """Nearly parallel columns: in float32, X'X is singular."""
    random = np.random.default_rng(1)
    base = random.standard_normal(1000)
    X = np.stack([base, base + 3e-4 * random.standard_normal(1000)], axis=1)
    fits = ridge_regression(
        *(jnp.asarray(part, jnp.float32) for part in (X, X @ np.ones((2, 1)), [1e-12]))
    )
    np.testing.assert_allclose(fits[0, :, 0], [1.0, 1.0], atol=1e-2)


@cache
def problem():
    """Two vertices with operators of norm 2, states of unequal spread, and noise."""
    random = np.random.default_rng(2)
    states = random.standard_normal((80, RANK)) * np.float64([3.0, 1.0, 0.3, 0.1])
    mixtures = random.dirichlet([1.0, 1.0], 80)
    inputs = random.standard_normal((80, 3)) * np.float64([1.0, 5.0, 0.2])
    operators, gains = (
        random.standard_normal((2, RANK, RANK)),
        random.standard_normal((RANK, 3)),
    )
    targets = np.einsum("kj,jab,kb->ka", mixtures, operators, states) + inputs @ gains.T
    return states, mixtures, inputs, targets + 0.1 * random.standard_normal((80, RANK))


@cache
def solution(bound, iterations=200):
    given = [jnp.asarray(part, jnp.float32) for part in problem()]
    return bounded_ridge(*given, bound=bound, ridge=RIDGE, iterations=iterations)


def loss(operators, gains, square=lambda part: np.sum(np.square(part))):
    """The objective in the docstring, of arrays or of variables."""
    states, mixtures, inputs, targets = problem()
    products = [mixtures[:, j, None] * states for j in range(2)]
    spread = [np.sqrt(np.mean(part**2, axis=0)) for part in (*products, inputs)]
    predicted = sum(
        part @ A.T
        for part, A in zip((*products, inputs), (*operators, gains), strict=True)
    )
    lengths = [
        square(A @ np.diag(D)) for A, D in zip((*operators, gains), spread, strict=True)
    ]
    return square(targets - predicted) + RIDGE * len(states) * sum(lengths)


@cache
def optimum(bound):
    """The convex program, by an interior-point method."""
    operators, gains = (
        [cvxpy.Variable((RANK, RANK)) for _ in range(2)],
        cvxpy.Variable((RANK, 3)),
    )
    inside = [cvxpy.sigma_max(A) <= bound for A in operators]
    cvxpy.Problem(
        cvxpy.Minimize(loss(operators, gains, cvxpy.sum_squares)), inside
    ).solve(cvxpy.CLARABEL)
    return np.stack([A.value for A in operators]), gains.value


def test_where_the_bound_is_slack_the_closed_form_solves_the_convex_program():
    for exact, closed in zip(optimum(10.0), solution(10.0, 0), strict=True):
        np.testing.assert_allclose(closed, exact, atol=2e-4)
    for closed, steps in zip(solution(10.0, 0), solution(10.0), strict=True):
        np.testing.assert_allclose(steps, closed, atol=1e-5)


def test_where_it_binds_the_steps_reach_the_optimum_and_clipping_alone_does_not():
    best = loss(*optimum(BOUND))
    clipped, stepped = (
        loss(*(np.float64(part) for part in solution(BOUND, steps)))
        for steps in (0, 200)
    )
    for operators in (solution(BOUND)[0], solution(BOUND, 0)[0]):
        assert np.all(
            np.linalg.norm(np.float64(operators), 2, axis=(1, 2)) <= BOUND * (1 + 1e-6)
        )
    assert best * (1 - 1e-6) <= stepped <= 1.001 * best
    np.testing.assert_allclose(
        clipped / best, 1.18, atol=0.01
    )  # the page on the certificate quotes it


@pytest.mark.parametrize("size", [4, 32])
def test_raw_parameters_give_back_every_matrix_within_the_attainable_norm(size):
    random = np.random.default_rng(0)
    turned = np.linalg.qr(random.standard_normal((size, size)))[
        0
    ]  # all singular values alike: the worst for a Gram bound
    for matrix in (turned, 0.3 * turned, np.outer(turned[0], turned[1])):
        wanted = jnp.asarray(attainable(0.9, size) * matrix, jnp.float32)
        np.testing.assert_allclose(bounded(unbounded(wanted), 0.9), wanted, rtol=1e-6)
    assert 0.97 * 0.9 < attainable(0.9, size) < 0.9


def test_an_identified_start_predicts_better_than_a_drawn_one_within_its_bound_and_keeps_the_rest():
    model = tiny("joint")
    drawn = jit(model.init)(jax.random.key(0))
    start = jit(model.fitting.start)(drawn, driven(), jax.random.key(1))
    miss = jit(
        jax.vmap(
            lambda params, drive: defects(model, params, drive)[0], in_axes=(None, 0)
        )
    )
    before, after = (
        np.mean(np.square(miss(params, driven()))) for params in (drawn, start)
    )
    assert after < 0.5 * before
    raw, fitted = drawn["networks"], start["networks"]
    left, right = map(np.float64, budget_factors(raw["couplings"]))
    wanted = [
        0.995 * left @ np.float64(matrix) @ right.T for matrix in fitted["operators"]
    ]
    np.testing.assert_allclose(
        model.structure.explicit(start).operators.vertices, wanted, atol=1e-4
    )  # nothing was cut off
    for name, part in fitted.items():
        unchanged = all(
            map(np.array_equal, jax.tree.leaves(part), jax.tree.leaves(raw[name]))
        )
        assert unchanged == (name not in ("operators", "input_head"))


def test_a_start_that_a_model_does_not_have_is_refused_by_name():
    blind, data, ours = (
        models.FACTORIES["neural_ode"](space(), dt=0.1),
        driven(),
        tiny(),
    )
    with pytest.raises(
        ValueError, match=r"training\.start=identified needs a model=sfkd"
    ):
        stages.with_start(blind, "identified", data, 0)
    with pytest.raises(
        ValueError,
        match=r"training\.start must be one of random, identified, got 'identfied'",
    ):
        stages.with_start(ours, "identfied", data, 0)
    assert stages.with_start(blind, "random", data, 0) is blind
    assert stages.with_start(ours, "identified", data, 0).init is not ours.init
