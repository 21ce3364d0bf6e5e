"""Path errors, the hand-made feedback law, and the tracking cost."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit, straight

from sfkd_jax import control, models
from sfkd_jax.driving import path_coordinates, path_following, paths, plants
from sfkd_jax.driving.path_coordinates import followable
from sfkd_jax.driving.path_following import PathErrors, StageInputs
from sfkd_jax.driving.paths import reference_window

ERRORS = jit(jax.vmap(path_following.path_errors))
RADIUS = 40.0


def on_circle(along):
    """Poses along a left-hand circle through the origin at `along` [m]."""
    yaw = along / RADIUS
    x, y = RADIUS * np.sin(yaw), RADIUS * (1 - np.cos(yaw))
    return np.column_stack([x, y, yaw, np.full_like(yaw, 9.0)])


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
    curvature = jit(path_coordinates.reference_curvature)(window)
    chord = 2 * RADIUS * np.sin(0.5 / RADIUS)
    np.testing.assert_allclose(curvature, np.full(8, 1 / RADIUS / chord), rtol=1e-4)
    assert curvature.shape == (8,)


@pytest.mark.parametrize("window", [straight(6), np.zeros((6, 4), np.float32)])
def test_a_straight_or_standing_reference_has_no_curvature(window):
    np.testing.assert_array_equal(
        jit(path_coordinates.reference_curvature)(window), np.zeros(6)
    )


def scalar(value):
    return jnp.asarray(value, dtype=jnp.float32)


def test_the_law_steers_and_brakes_against_its_errors():
    law = path_following.path_feedback(
        wheelbase=2.7, lateral_gain=0.03, heading_gain=0.4, speed_gain=2.0
    )
    off = PathErrors(scalar(0.4), scalar(0.1), scalar(0.5))
    np.testing.assert_allclose(
        law(off, scalar(0.0), scalar(9.0)), [-0.012 - 0.04, -1.0], rtol=1e-5
    )
    commanded = path_following.path_feedback(
        wheelbase=2.7, speed_gain=2.0, speed_loop=True
    )
    np.testing.assert_allclose(
        commanded(off, scalar(0.0), scalar(9.0))[1], 8.0, rtol=1e-6
    )


def test_near_the_path_and_above_5_m_s_the_law_is_linear_bit_for_bit():
    random = np.random.default_rng(0)
    errors = PathErrors(
        *(scalar(random.uniform(-e, e, 500)) for e in path_following.NEAR)
    )
    road = scalar(random.uniform(-0.02, 0.02, 500)), scalar(random.uniform(6, 13, 500))
    for loop in (False, True):
        laws = (
            jax.vmap(law(wheelbase=2.7, speed_loop=loop))(errors, *road)
            for law in (path_following.LinearFeedback, path_following.path_feedback)
        )
        np.testing.assert_array_equal(*laws)


@pytest.mark.parametrize("name", ["kinematic", "dynamic"])
def test_the_law_comes_back_from_anywhere(name):
    """Within 0.3 m and 0.3 rad for good after 21 s; linear, a fifth of these do not."""
    plant = getattr(plants, name)()
    law = path_following.path_feedback(wheelbase=plant.wheelbase)
    limits = jnp.asarray(plant.control_low), jnp.asarray(plant.control_high)

    @jit
    @jax.vmap
    def drive(start, friction):
        def step(state, _):
            point = jnp.stack([state[0], 0.0, 0.0, 10.0])
            errors = path_following.path_errors(state, point, jnp.zeros(()))
            u = jnp.clip(law(errors, jnp.zeros(()), point[3]), *limits)
            state = plant.step(state, u, jnp.stack([friction, 0.0]))
            return state, state[1:3]

        return jax.lax.scan(step, start, length=250)[1]

    places = itertools.product((0.3, 3.0, -20.0), (0.0, 1.6, -2.5, 3.1), (6.0, 10.0))
    places = np.asarray([(*place, mu) for place in places for mu in (0.3, 0.9)])
    starts = np.zeros((len(places), len(plant.state_names)), np.float32)
    starts[:, 1:4] = places[:, :3]
    driven = np.asarray(drive(starts, np.float32(places[:, 3])))[:, 210:]
    assert np.max(np.abs(driven[..., 0])) < 0.3
    assert np.max(np.abs(np.sin(driven[..., 1] / 2))) < np.sin(0.15)


def planned(wheelbase, starts, speeds):
    """States, controls and health of 25 s on 60 m of straight road, from these starts
    at these reference speeds, planned with 64 samples.
    """
    road = paths.path_through(jnp.asarray([[0.0, 0.0], [30.0, 0.0], [60.0, 0.0]]))
    limits = {"control_low": (-0.5, -6.0), "control_high": (0.5, 3.0)}
    step = plants.own(wheelbase=wheelbase, **limits).nominal
    law = path_following.path_feedback(wheelbase=wheelbase)
    cost = path_following.tracking_cost(dt=0.1)
    task = path_following.path_tracking(
        models.physics(step), cost, law, dt=0.1, **limits
    )
    planner = control.mppi(task, num_samples=64, horizon=10, effective_samples=20.0)

    @jit
    @jax.vmap
    def drive(start, speed):
        def advance(carry, _):
            state, along, memory = carry
            window = reference_window(road, along, speed, dt=0.1, horizon=10)
            u, memory, info = planner.act({}, memory, state, jnp.zeros(2), window)
            state = step(state, u, jnp.zeros(2))
            along, _ = paths.project(road, state[:2], along)
            return (state, along, memory), (state, u, info.healthy)

        begin = (start, start[0], planner.init(jax.random.key(0)))
        return jax.lax.scan(advance, begin, length=250)[1]

    return map(np.asarray, drive(scalar(starts), scalar(speeds)))


SLOW = np.asarray([0.3, 0.5, 1.0, 2.0])


@pytest.mark.parametrize("wheelbase", [0.33, 2.7])
def test_a_slow_planner_drives_on_its_path_a_stopped_one_stays_and_a_road_ends(
    wheelbase,
):
    starts = [[0.0, 0.3, 0.0, speed] for speed in SLOW]
    # Told to stop; near the end of the road; told to reverse.
    starts += [[0.0, 0.3, 0.0, 3.0], [20.0, 0.0, 0.0, 8.0], [0.0, 0.0, 0.0, 3.0]]
    speeds = np.asarray([*SLOW, 0.0, 8.0, -2.0])
    states, controls, healthy = planned(wheelbase, starts, speeds)
    assert np.max(np.abs(states[:4, 99, 1])) < 0.02
    assert np.min(np.mean(states[:4, 100:150, 3], axis=1) / SLOW) > 0.98
    still, steering = states[4:, 150:], controls[4:, 150:, 0]
    assert np.max(still[..., 3]) < 1e-3
    np.testing.assert_allclose(still, still[:, :1] + 0.0 * still, atol=1e-3)
    assert np.max(np.abs(np.diff(steering, axis=1))) < 1e-4
    assert 59.5 < still[1, 0, 0] < 60.5
    np.testing.assert_array_equal(np.all(healthy, axis=1), speeds >= 0.0)


@pytest.mark.parametrize("change", [{3: -1.0}, {0: 5.0}])
def test_a_reference_that_cannot_be_followed_is_one_to_stop(change):
    """Backwards, or at one place at a speed."""
    window = straight(6)
    assert jit(followable)(window)[1]
    for column, value in change.items():
        window = window.at[3:, column].set(value)
    stopped, known = jit(followable)(window)
    assert not known
    assert np.all(stopped[4:, 3] == 0.0)
    assert np.all(stopped[:3] == window[:3])


def test_a_car_that_stops_in_a_bend_keeps_its_curvature():
    window = on_circle(np.minimum(np.arange(1.0, 9.0), 4.0)).astype(np.float32)
    curvature = jit(path_coordinates.reference_curvature)(window)
    np.testing.assert_allclose(curvature, np.full(8, 1 / RADIUS), rtol=1e-3)


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
    cost = path_following.tracking_cost(dt=0.1, **settings)
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
