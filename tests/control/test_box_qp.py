"""The quadratic program: against a convex solver, at its bounds, and warm started."""

from functools import partial

import cvxpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.control.planners._koopman_mpc import box_qp

SIZE = 24


def problem(seed, condition=1e3):
    """A random strictly convex cost; about half of its free minimum is outside the box."""
    random = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(random.standard_normal((SIZE, SIZE)))
    H = (axes * np.geomspace(1.0, condition, SIZE)) @ axes.T
    low, high = -random.uniform(0.1, 1.0, SIZE), random.uniform(0.1, 1.0, SIZE)
    return tuple(
        np.float32(part) for part in (H, -H @ random.standard_normal(SIZE), low, high)
    )


def cost(H, f, x):
    H, f, x = (np.asarray(part, np.float64) for part in (H, f, x))
    return 0.5 * x @ H @ x + f @ x


def by_clarabel(H, f, low, high):
    """The minimum, by an interior point method in float64."""
    x = cvxpy.Variable(len(f))
    H = np.asarray(H, np.float64)
    objective = 0.5 * cvxpy.quad_form(x, cvxpy.psd_wrap(0.5 * (H + H.T))) + f @ x
    cvxpy.Problem(cvxpy.Minimize(objective), [x >= low, x <= high]).solve(
        solver=cvxpy.CLARABEL
    )
    return x.value


SOLVERS = {n: jit(partial(box_qp, iterations=n)) for n in (*range(9), 12)}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("condition", [10.0, 1e5])
def test_the_cost_is_that_of_a_convex_solver(seed, condition):
    H, f, low, high = problem(seed, condition)
    solution = SOLVERS[12](H, f, low, high, np.zeros(SIZE, np.float32))
    best = cost(H, f, by_clarabel(H, f, low, high))
    assert 0 < np.sum((solution.primal == low) | (solution.primal == high)) < SIZE
    assert abs(cost(H, f, solution.primal) - best) <= 1e-4 * abs(best)
    assert float(solution.residual) < 1e-4


def test_independent_entries_are_clipped():
    diagonal, f = np.float32([1.0, 4.0, 100.0]), np.float32([-0.5, 8.0, -300.0])
    solution = SOLVERS[1](
        np.diag(diagonal),
        f,
        -np.ones(3, np.float32),
        np.ones(3, np.float32),
        np.zeros(3, np.float32),
    )
    np.testing.assert_allclose(
        solution.primal, np.clip(-f / diagonal, -1, 1), atol=1e-6
    )
    assert float(solution.residual) < 1e-6


def test_without_active_bounds_one_iteration_solves():
    H, f, _, _ = problem(0)
    wide = np.full(SIZE, 1e3, np.float32)
    solution = SOLVERS[1](H, f, -wide, wide, np.zeros(SIZE, np.float32))
    np.testing.assert_allclose(
        solution.primal, -np.linalg.solve(np.float64(H), f), atol=1e-4
    )


def iterations_needed(data, start):
    return next(n for n in range(9) if float(SOLVERS[n](*data, start).residual) < 1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_a_warm_start_needs_fewer_iterations(seed):
    data = problem(seed)
    H, f, low, high = data
    near = SOLVERS[12](
        H, np.float32(1.02 * f), low, high, np.zeros(SIZE, np.float32)
    ).primal
    cold, warm = (
        iterations_needed(data, start) for start in (np.zeros(SIZE, np.float32), near)
    )
    assert warm < cold
    assert iterations_needed(data, SOLVERS[12](H, f, low, high, near).primal) == 0


def test_the_cost_never_rises_and_the_box_is_never_left():
    H, f, low, high = problem(5, condition=1e5)
    start = np.full(SIZE, 7.0, np.float32)  # outside
    solutions = [SOLVERS[n](H, f, low, high, start).primal for n in range(9)]
    assert all(np.all((low <= x) & (x <= high)) for x in solutions)
    costs = np.asarray([cost(H, f, x) for x in solutions])
    assert np.all(np.diff(costs) <= 1e-6 * np.abs(costs[:-1]))


@pytest.mark.parametrize("part", [0, 1])
def test_what_is_not_finite_leaves_the_start(part):
    data = [np.array(entry) for entry in problem(1)]
    start = 0.5 * data[3]
    data[part].flat[0] = np.nan
    solution = SOLVERS[12](*data, start)
    np.testing.assert_array_equal(solution.primal, start)
    assert not float(solution.residual) < 1e-4


def test_a_cost_that_is_not_convex_still_ends_inside_the_box():
    solution = SOLVERS[12](
        -np.eye(3, dtype=np.float32),
        *np.float32([[0.1] * 3, [-1] * 3, [1] * 3, [0] * 3]),
    )
    assert np.all(np.abs(solution.primal) <= 1)


def test_a_batch_is_a_loop():
    batch = [
        np.stack(parts)
        for parts in zip(*(problem(seed) for seed in range(3)), strict=True)
    ]
    start = jnp.zeros((3, SIZE))
    together = jit(jax.vmap(partial(box_qp, iterations=8)))(*batch, start)
    for k in range(3):
        alone = SOLVERS[8](*(part[k] for part in batch), start[k])
        np.testing.assert_allclose(together.primal[k], alone.primal, atol=1e-4)
