"""Constraints are kept where a sample can keep them, and the least violated otherwise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax import control

HORIZON = 10
NOTHING = jnp.zeros(0)
GOAL = jnp.asarray([2.0, 0.0])
CIRCLE = jnp.asarray([[1.0, 0.0, 0.4]])


POINT = control.free_task(
    lambda params, x, u, e: x + 0.25 * u,
    lambda weights, x, u, before, target: jnp.sum((x - GOAL) ** 2),
    control_low=(-1.0, -1.0),
    control_high=(1.0, 1.0),
)
"""A point that moves by u and wants to be at the goal, 2 m ahead."""


def point_mass(constraint, data, **settings):
    task = control.constrained(POINT, constraint, data)
    options = {"num_samples": 512, "horizon": HORIZON, "noise_std": (0.7, 0.7)}
    return control.mppi(task, **(options | {"temperature": 0.5} | settings))


def circles(data, x, u, target, at):
    return control.outside_circles(x, data["circles"], data["margin"])


def drive(controller, start, steps=25):
    def step(carry, _):
        x, state = carry
        u, state, info = controller.act({}, state, x, NOTHING, ())
        x = x + 0.25 * u
        return (x, state), (x, info.plan.violation, (info.plan.violation <= 0.0))

    first = (start, controller.init(jax.random.key(0)))
    return jax.lax.scan(step, first, length=steps)[1]


def test_an_obstacle_on_the_line_to_the_goal_is_passed():
    data = {"circles": CIRCLE, "margin": 0.05}
    controller = point_mass(circles, data, effective_samples=30.0)
    places, _, kept = jit(lambda: drive(controller, jnp.zeros(2)))()
    clearance = np.linalg.norm(places - CIRCLE[0, :2], axis=1) - 0.4
    assert clearance.min() >= 0.05 - 1e-5
    assert np.linalg.norm(places[-1] - GOAL) < 0.2
    assert kept.all()


def test_the_mean_of_passing_on_both_sides_is_not_driven():
    """From a start on the axis of symmetry, with a plan of zeros."""
    controller = point_mass(
        circles, {"circles": CIRCLE, "margin": 0.0}, temperature=1e3
    )
    state = controller.init(jax.random.key(1))
    _, state, info = jit(controller.act)(
        {}, state, jnp.asarray([0.3, 0.0]), NOTHING, ()
    )
    assert info.plan.violation <= 0.0
    clearance = jnp.linalg.norm(info.plan.states - CIRCLE[0, :2], axis=1)
    assert clearance.min() >= 0.4


def test_where_nothing_is_feasible_the_violation_falls():
    """From inside the obstacle, whose goal's cost would keep the point there."""
    data = {"circles": jnp.asarray([[2.0, 0.0, 0.8]]), "margin": 0.0}
    controller = point_mass(circles, data)
    places, violations, kept = jit(lambda: drive(controller, jnp.asarray([1.9, 0.0])))()
    assert not kept[0]
    assert kept[-1]
    assert violations[-1] <= 0.0 < violations[0]
    assert np.linalg.norm(places[-1] - GOAL) >= 0.8 - 1e-5


def test_obstacles_move_and_change_without_another_compilation():
    controller = point_mass(circles, {"circles": CIRCLE, "margin": 0.0})
    act = jit(controller.act)
    state = controller.init(jax.random.key(0))
    for shift in (0.0, 0.3, 0.6):
        moved = {"circles": CIRCLE + jnp.asarray([shift, 0.0, 0.0]), "margin": 0.1}
        state = control.tuned(state, constraints=moved)
        state = act({}, state, jnp.zeros(2), NOTHING, ())[1]
    assert act._cache_size() == 1
    with pytest.raises(ValueError, match="shape"):
        control.tuned(state, constraints={"circles": jnp.zeros((2, 3)), "margin": 0.1})


def test_a_violation_that_is_not_a_number_is_not_kept():
    controller = point_mass(lambda data, x, u, target, at: jnp.full(1, jnp.nan), ())
    state = controller.init(jax.random.key(0))
    u, _, info = jit(controller.act)({}, state, GOAL, NOTHING, ())
    assert not (info.plan.violation <= 0.0)
    assert jnp.all(jnp.isfinite(u))


def test_cem_keeps_constraints_too():
    data = {"circles": CIRCLE, "margin": 0.05}
    controller = control.cem(
        control.constrained(POINT, circles, data),
        num_samples=300,
        elites=30,
        horizon=HORIZON,
        noise_std=(0.7, 0.7),
    )
    places, _, kept = jit(lambda: drive(controller, jnp.zeros(2)))()
    assert kept.all()
    assert np.linalg.norm(places - CIRCLE[0, :2], axis=1).min() >= 0.45 - 1e-5


def test_a_search_that_does_not_rank_is_refused():
    task = control.constrained(POINT, lambda data, x, u, target, at: x)
    with pytest.raises(ValueError, match="constraints need mppi"):
        control.gradient_planner(task, horizon=4, noise_std=(1.0, 1.0))


def test_depths_inside_shapes_are_those_of_geometry():
    point = jnp.asarray([1.0, 2.0])
    np.testing.assert_allclose(
        control.outside_circles(
            point, jnp.asarray([[1.0, 0.0, 0.5], [1.0, 2.0, 0.5]]), 0.1
        ),
        [-1.4, 0.6],
        atol=1e-5,
    )
    boxes = jnp.asarray(
        [
            [1.0, 0.0, jnp.pi / 2, 2.0, 1.0],
            [1.0, 2.0, 0.3, 4.0, 2.0],
            [4.0, 6.0, 0.0, 0.0, 0.0],
        ]
    )
    np.testing.assert_allclose(
        control.outside_boxes(point, boxes), [-1.0, 1.0, -5.0], atol=1e-5
    )
    assert jnp.all(
        jnp.isfinite(jax.jacobian(control.outside_boxes)(boxes[1, :2], boxes))
    )
