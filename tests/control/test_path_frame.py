"""Path errors, the hand-made feedback law, and the tracking cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit, straight

from sfkd_jax import control
from sfkd_jax.control import PathErrors, StageInputs

ERRORS = jit(jax.vmap(control.path_errors))
RADIUS = 40.0


def on_circle(along, offset=0.0):
    """Poses along a left-hand circle through the origin at `along` [m], `offset` [m] to
    its left.
    """
    yaw = along / RADIUS
    radius = RADIUS - offset
    return np.stack(
        [
            radius * np.sin(yaw),
            RADIUS - radius * np.cos(yaw),
            yaw,
            np.full_like(yaw, 9.0),
        ],
        axis=1,
    )


def errors_at(states, point=(0.0, 0.0, 0.0, 9.0), curvature=1 / RADIUS):
    count = len(states)
    points = np.broadcast_to(np.float32(point), (count, 4))
    return ERRORS(
        states.astype(np.float32), points, np.full(count, curvature, np.float32)
    )


def test_path_errors_vanish_on_the_circle_that_the_reference_describes():
    """To second order in the distance s along it: the lateral error is below s⁴/(8 R³)."""
    along = np.linspace(-4.0, 4.0, 17)
    errors = errors_at(on_circle(along))
    assert np.all(np.abs(errors.lateral) <= along**4 / (8 * RADIUS**3) + 1e-5)
    assert np.all(np.abs(errors.heading) <= np.abs(along) ** 3 / (6 * RADIUS**3) + 1e-5)
    np.testing.assert_array_equal(errors.speed, np.zeros(17))


def test_path_errors_are_the_offset_the_turn_and_the_speed_at_the_reference_point():
    states = np.asarray([[0.0, 0.3, 0.1, 10.0], [0.0, -0.3, -0.1, 8.0]])
    errors = errors_at(states)
    np.testing.assert_allclose(errors.lateral, [0.3, -0.3], atol=1e-6)
    np.testing.assert_allclose(errors.heading, [0.1, -0.1], atol=1e-6)
    np.testing.assert_allclose(errors.speed, [1.0, -1.0], atol=1e-6)


def test_path_errors_do_not_depend_on_where_the_world_puts_its_origin():
    random = np.random.default_rng(0)
    states, points = random.normal(0.0, 2.0, (20, 4)), random.normal(0.0, 2.0, (20, 4))
    yaw, shift = 2.0, np.asarray([5.0, -3.0])
    turn = np.asarray([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])

    def moved(poses):
        return np.column_stack(
            [poses[:, :2] @ turn.T + shift, poses[:, 2] + yaw, poses[:, 3]]
        ).astype(np.float32)

    curvature = np.full(20, 0.02, np.float32)
    here = ERRORS(states.astype(np.float32), points.astype(np.float32), curvature)
    there = ERRORS(moved(states), moved(points), curvature)
    np.testing.assert_allclose(np.stack(here), np.stack(there), atol=2e-5)


def test_the_curvature_of_a_reference_is_that_of_its_circle():
    window = on_circle(np.arange(1.0, 9.0)).astype(np.float32)
    curvature = jit(control.reference_curvature)(window)
    chord = 2 * RADIUS * np.sin(0.5 / RADIUS)
    np.testing.assert_allclose(curvature, np.full(8, 1 / RADIUS / chord), rtol=1e-4)
    assert curvature.shape == (8,)


@pytest.mark.parametrize("window", [straight(6), np.zeros((6, 4), np.float32)])
def test_a_straight_or_standing_reference_has_no_curvature(window):
    np.testing.assert_array_equal(jit(control.reference_curvature)(window), np.zeros(6))


def scalar(value):
    return jnp.asarray(value, dtype=jnp.float32)


def test_the_law_steers_and_brakes_against_its_errors():
    law = control.path_feedback(
        wheelbase=2.7, lateral_gain=0.03, heading_gain=0.4, speed_gain=2.0
    )
    off = PathErrors(scalar(1.0), scalar(0.1), scalar(0.5))
    np.testing.assert_allclose(
        law(off, scalar(0.0), scalar(9.0)), [-0.03 - 0.04, -1.0], rtol=1e-5
    )
    commanded = control.path_feedback(wheelbase=2.7, speed_gain=2.0, speed_loop=True)
    np.testing.assert_allclose(
        commanded(off, scalar(0.0), scalar(9.0))[1], 8.0, rtol=1e-6
    )


def stage(
    lateral=0.0,
    before=0.0,
    heading=0.0,
    fast=0.0,
    steering=0.0,
    steering_before=0.0,
    acceleration=0.0,
):
    now = PathErrors(scalar(lateral), scalar(heading), scalar(fast))
    then = PathErrors(scalar(before), scalar(heading), scalar(fast))
    used = jnp.asarray([steering, acceleration]), jnp.asarray([steering_before, 0.0])
    return StageInputs(now, then, *used, scalar(10.0))


def charge(seen, **settings):
    """The cost with the weights it was made with."""
    cost = control.tracking_cost(dt=0.1, **settings)
    return cost.stage(cost.weights, seen)


def test_the_cost_is_zero_on_the_path_whatever_the_body_heading():
    """A car that crabs in a side wind keeps its course, not its heading."""
    assert float(charge(stage(heading=0.3, steering=0.1, steering_before=0.1))) == 0.0


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"lateral": 0.1, "before": 0.1}, 200 * 0.01),
        ({"before": 0.1}, 20 * (0.1 / (10.0 * 0.1 + 1e-3)) ** 2),
        ({"fast": 0.5}, 0.25),
        ({"steering": 0.02}, 5 * 0.2**2),
        ({"acceleration": 2.0}, 0.02 * 4),
    ],
)
def test_every_term_of_the_cost_is_the_square_it_states(change, expected):
    np.testing.assert_allclose(charge(stage(**change)), expected, rtol=1e-4)
