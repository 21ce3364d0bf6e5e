"""Linear MPC in a lift: its cost, its solution, its driving, and its limits."""

from functools import cache, partial

import cvxpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import dataset, jit, model_and_params

from sfkd_jax import data as datasets
from sfkd_jax import paper
from sfkd_jax.driving import (
    path_coordinates,
    path_following,
    paths,
    plants,
    scenarios,
    simulation,
)
from sfkd_jax.driving.path_following import StageInputs
from sfkd_jax.paper._koopman_mpc import box_qp

PLANT = plants.kinematic()
LIMITS = {"control_low": PLANT.control_low, "control_high": PLANT.control_high}
HORIZON = 15
ENV = jnp.asarray([0.8, 0.0])
OFFSET = jnp.asarray([0.0, 0.3, 0.05, 9.5])


@cache
def koopman():
    """A predictor of the kinematic car from a few segments of driving."""
    model = paper.koopman(
        datasets.measure_space(dataset()), functions=20, environment_degree=1
    )
    return model, jit(model.fitting.identify)(
        dataset().train, dataset().validation, jax.random.key(3)
    )


@cache
def compiled():
    cost = path_following.tracking_cost(dt=PLANT.dt)
    controller = paper.koopman_mpc(koopman()[0], cost, horizon=HORIZON, **LIMITS)
    return controller, jit(controller.act)


def on_arc(curvature):
    """A reference at 10 m/s along a circle that leaves the origin along x."""
    turn = curvature * np.arange(1, HORIZON + 1)
    x, y = np.sin(turn) / curvature, (1 - np.cos(turn)) / curvature
    return jnp.asarray(np.stack([x, y, turn, 0 * x + 10.0], axis=1), jnp.float32)


BEND = on_arc(0.015)


def act(observation=OFFSET, state=None):
    controller, run = compiled()
    state = controller.init(jax.random.key(0)) if state is None else state
    return run(koopman()[1], state, observation, ENV, BEND)


def test_the_cost_is_the_tracking_cost_of_what_is_predicted():
    """Step by step along the linear predictor, with the cost function of the sampling
    planner.
    """
    model, params = koopman()
    first, state, _ = act()
    moved = jnp.asarray([1.0, 0.25, 0.04, 9.6])
    action, after, info = act(moved, state)
    linear = model.structure.linear(model.fiber(params, ENV))
    tracking = path_following.tracking_cost(dt=0.1)
    curvature = path_coordinates.reference_curvature(BEND)
    errors = path_following.path_errors(moved, BEND[0], curvature[0])
    z = linear.lift(moved.at[:3].set(jnp.stack([0.0, errors.lateral, errors.heading])))
    total, before = 0.0, first
    # The plan of which `action` was the first step.
    for k, now in enumerate(np.concatenate([action[None], after.plan[:-1]])):
        z = linear.A @ z + linear.B @ now + linear.d * curvature[k] + linear.c
        x = linear.C @ z + linear.o
        later = path_following.PathErrors(x[1], x[2], x[3] - BEND[k, 3])
        cost = tracking.stage(
            tracking.weights, StageInputs(later, errors, now, before, BEND[k, 3])
        )
        total, errors, before = total + (1 + (k == HORIZON - 1)) * cost, later, now
    np.testing.assert_allclose(info.plan.cost, total, rtol=2e-3)
    assert np.isnan(info.plan.effective_samples)


@cache
def drive(curvature, offset):
    """An episode beside a path of constant curvature, without sensor noise."""
    path = paths.path_from_curvature(jnp.full(300, curvature), spacing=0.5)
    start = jnp.asarray([0.0, offset, 0.0, 10.0])
    envs = jnp.tile(ENV, (50, 1))
    road = scenarios.Scenario(start, envs, envs, path, jnp.asarray(10.0))
    run = partial(
        simulation.simulate,
        PLANT.step,
        compiled()[0],
        dt=0.1,
        horizon=HORIZON,
        record={"expected": lambda info: info.plan.states[0, :2]},
    )
    return jit(run)(koopman()[1], road, jax.random.key(0))


def test_a_car_beside_a_straight_path_comes_back_to_it():
    episode = drive(0.0, 0.5)
    assert np.max(np.abs(episode.lateral[30:])) < 0.05
    assert np.max(-episode.lateral) < 0.15
    np.testing.assert_allclose(episode.states[-1, 3], 10.0, atol=0.3)


def test_predictions_are_told_in_the_world():
    """One step ahead the car is where it was predicted, on a bend and beside the path."""
    for curvature, offset in ((-0.015, 0.0), (0.0, 0.5)):
        episode = drive(curvature, offset)
        gap = episode.signals["expected"] - episode.states[1:, :2]
        assert np.max(np.linalg.norm(gap, axis=1)) < 0.04


def test_a_model_that_is_not_linear_in_a_lift_is_refused():
    cost = path_following.tracking_cost(dt=0.1)
    with pytest.raises(ValueError, match="linear"):
        paper.koopman_mpc(model_and_params("oracle")[0], cost, **LIMITS)


# ---- the quadratic program

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


def residual(x, H, f, low, high):
    """The largest move of a scaled step of projected descent: 0 at the optimum."""
    moved = np.clip(x - (H @ x + f) / np.diagonal(H), low, high)
    return np.max(np.abs(x - moved))


ITERATE = jit(partial(box_qp, iterations=1))


def solved(data, start, iterations=12):
    """The solver after some iterations; an iteration knows nothing of those before."""
    x = np.clip(start, *data[2:])
    for _ in range(iterations):
        x = ITERATE(*data, x)
    return x


@pytest.mark.parametrize("seed", range(3))
def test_a_quadratic_program_is_solved_as_by_a_convex_solver(seed):
    data = problem(seed)
    solution, best = solved(data, np.zeros(SIZE)), by_clarabel(*data)
    assert abs(cost(*data[:2], solution) - cost(*data[:2], best)) <= 1e-4
    assert residual(solution, *data) < 1e-3
    assert np.any(solution == data[3])  # bounds matter


def test_the_cost_never_rises_and_the_box_is_never_left():
    H, f, low, high = problem(5, condition=1e5)
    start = np.full(SIZE, 7.0, np.float32)  # outside
    solutions = [solved((H, f, low, high), start, n) for n in range(9)]
    assert all(np.all((low <= x) & (x <= high)) for x in solutions)
    costs = np.asarray([cost(H, f, x) for x in solutions])
    assert np.all(np.diff(costs) <= 1e-6 * np.abs(costs[:-1]))


@pytest.mark.parametrize("part", [0, 1])
def test_what_is_not_finite_leaves_the_start(part):
    data = [np.array(entry) for entry in problem(1)]
    start = 0.5 * data[3]
    data[part].flat[0] = np.nan
    solution = solved(data, start)
    np.testing.assert_array_equal(solution, start)
