"""Paths by arc length: circles, clothoids, points between samples, projection."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.driving import paths
from sfkd_jax.driving.paths import (
    path_from_curvature,
    point_at,
    project,
    reference_window,
)
from sfkd_jax.driving.scenarios import smooth_path

RADIUS = 50.0
POINTS = jit(jax.vmap(point_at, in_axes=(None, 0)))
PROJECT = jit(jax.vmap(project, in_axes=(None, 0, 0)))
INTEGRATE = jit(partial(path_from_curvature, spacing=0.5))


@pytest.fixture(scope="module")
def circle():
    return INTEGRATE(np.full(700, 1.0 / RADIUS, np.float32))


@pytest.fixture(scope="module")
def road():
    return jit(partial(smooth_path, length=300.0, peak_curvature=0.03))(
        jax.random.key(3)
    )


def left_of(path, s, offset):
    """The positions at distance `offset` [m] to the left of the path."""
    points = np.asarray(POINTS(path, s))
    return points[:, :2] + offset[:, None] * np.stack(
        [-np.sin(points[:, 2]), np.cos(points[:, 2])], axis=1
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_constant_curvature_makes_a_circle_of_exactly_that_radius(side):
    path = INTEGRATE(np.full(700, side / RADIUS, np.float32))
    s = np.linspace(0.0, 349.0, 2001, dtype=np.float32)
    centre = np.asarray([0.0, side * RADIUS])
    samples, between = np.asarray(path.points), np.asarray(POINTS(path, s))
    np.testing.assert_allclose(
        np.linalg.norm(samples[:, :2] - centre, axis=1), RADIUS, rtol=1e-5
    )
    np.testing.assert_allclose(
        np.linalg.norm(between[:, :2] - centre, axis=1), RADIUS, rtol=2e-5
    )
    np.testing.assert_allclose(between[:, 3], side / RADIUS, rtol=1e-6)
    np.testing.assert_allclose(between[:, 2], side * s / RADIUS, atol=1e-4)


def test_points_between_samples_agree_with_integration_on_a_ten_times_finer_grid(road):
    curvature = np.asarray(road.points, dtype=np.float64)[:, 3]
    s = np.arange(len(curvature)) * 0.5
    fine_s = np.arange(10 * (len(curvature) - 1) + 1) * 0.05
    kappa = np.interp(fine_s, s, curvature)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (kappa[1:] + kappa[:-1])) * 0.05])
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    x = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * 0.05])
    y = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * 0.05])
    points = np.asarray(POINTS(road, fine_s.astype(np.float32)))
    np.testing.assert_allclose(points[:, 0], x, atol=5e-3)
    np.testing.assert_allclose(points[:, 1], y, atol=5e-3)
    np.testing.assert_allclose(points[:, 2], yaw, atol=2e-4)
    np.testing.assert_allclose(points[:, 3], kappa, atol=2e-6)


def test_projection_returns_the_distance_and_the_arc_length_of_a_point(road):
    random = np.random.default_rng(0)
    s, offset = (
        random.uniform(*edges, 300).astype(np.float32)
        for edges in ((5.0, 290.0), (-4.0, 4.0))
    )
    guess = s + random.uniform(-2.0, 2.0, 300).astype(np.float32)
    arc_length, lateral = PROJECT(road, left_of(road, s, offset), guess)
    np.testing.assert_allclose(lateral, offset, atol=2e-3)
    np.testing.assert_allclose(arc_length, s, atol=5e-3)


def test_projection_stays_finite_far_from_the_path_and_at_the_centre_of_a_circle(
    circle,
):
    positions = np.float32([[0.0, RADIUS], [500.0, 500.0], [-1e4, 0.0]])
    arc_length, lateral = PROJECT(circle, positions, np.float32([10.0, 50.0, 0.0]))
    assert np.all(np.isfinite(arc_length))
    assert np.all(np.isfinite(lateral))


@pytest.mark.parametrize("peak", [0.01, 0.03])
def test_the_peak_curvature_is_reached_and_not_exceeded(peak):
    make = jit(jax.vmap(partial(smooth_path, length=200.0, peak_curvature=peak)))
    roads = make(jax.random.split(jax.random.key(1), 20))
    np.testing.assert_allclose(
        np.max(np.abs(roads.points)[..., 3], axis=1), peak, rtol=1e-5
    )


def test_the_reference_window_holds_the_next_points_at_the_given_speed(circle):
    window = jit(partial(reference_window, dt=0.1, horizon=5))(
        circle, jnp.asarray(3.0), jnp.asarray(8.0)
    )
    expected = np.asarray(POINTS(circle, np.float32(3.0 + 0.8 * np.arange(1, 6))))
    np.testing.assert_allclose(np.asarray(window)[:, :3], expected[:, :3], atol=1e-6)
    np.testing.assert_array_equal(np.asarray(window)[:, 3], np.full(5, 8.0))


def test_beyond_its_end_a_path_is_its_last_point_and_the_reference_stands_there(road):
    end, beyond = np.asarray(road.points)[-1], road.length + 30.0
    position = end[:2] + 30.0 * np.asarray([np.cos(end[2]), np.sin(end[2])])
    for guess in (0.9 * beyond, beyond):
        s, lateral = project(road, jnp.asarray(position), guess)
        assert s == road.length
        np.testing.assert_allclose(lateral, 0.0, atol=1e-3)
    window = reference_window(road, s, jnp.asarray(10.0), dt=0.1, horizon=4)
    np.testing.assert_allclose(window, np.tile([*end[:3], 0.0], (4, 1)), rtol=1e-5)


@pytest.mark.parametrize("left", [100.0, 15.0, 3.0])
def test_before_the_end_the_points_brake_to_it(road, left):
    """Their speeds are those of their distances, and fall by 2 m/s a second."""
    speed, dt = 9.0, 0.01
    window = np.asarray(
        jit(partial(reference_window, dt=dt, horizon=3000, deceleration=2.0))(
            road, road.length - left, jnp.asarray(speed)
        )
    )
    np.testing.assert_allclose(window[-1, :2], road.points[-1, :2], rtol=1e-6)
    assert window[-1, 3] == 0.0
    gaps = np.hypot(*np.diff(window[:, :2], axis=0).T) / dt
    np.testing.assert_allclose(gaps, window[1:, 3], atol=0.03)
    assert np.min(np.diff(window[:, 3])) > -2.0 * dt - 1e-4
    assert window[0, 3] <= min(speed, np.sqrt(2 * 2.0 * left))


@pytest.mark.parametrize("repeated", [False, True])
def test_a_closed_path_goes_round_for_ever(repeated):
    """Distances, points and the window are the same in the second lap."""
    angle = np.linspace(0.0, 2 * np.pi, 3000, endpoint=repeated)
    points = 60.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    lap = paths.path_through(jnp.asarray(points, jnp.float32), closed=True)
    np.testing.assert_allclose(lap.length, 2 * np.pi * 60.0, rtol=1e-4)
    np.testing.assert_allclose(np.asarray(lap.points)[:, 3], 1 / 60.0, rtol=0.02)
    np.testing.assert_allclose(lap.points[0, :2], lap.points[-1, :2], atol=1e-4)
    place = jnp.asarray([60.5 * np.cos(0.01), 60.5 * np.sin(0.01)])
    for guess in (0.0, lap.length - 1.0, lap.length + 1.0, -1.0):
        s, lateral = project(lap, place, jnp.asarray(guess))
        np.testing.assert_allclose([s, lateral], [0.6, -0.5], atol=5e-3)
    window = partial(reference_window, lap, speed=jnp.asarray(9.0), dt=0.1, horizon=5)
    first, second = window(lap.length - 2.0), window(2 * lap.length - 2.0)
    np.testing.assert_allclose(first[:, [0, 1, 3]], second[:, [0, 1, 3]], atol=1e-3)
    np.testing.assert_allclose(np.diff(first[:, 2]), 0.9 / 60.0, rtol=0.05)
    np.testing.assert_allclose(second[:, 2] - first[:, 2], 2 * np.pi, atol=1e-3)


def test_a_path_through_positions_on_a_circle_is_that_circle():
    radius, angle = 40.0, np.linspace(0.0, 1.5, 400)
    points = np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle))])
    path = paths.path_through(jnp.asarray(points, dtype=jnp.float32))
    inside = np.asarray(path.points)[3:-3]
    np.testing.assert_allclose(inside[:, 3], 1 / radius, rtol=0.02)
    np.testing.assert_allclose(
        np.hypot(inside[:, 0], inside[:, 1] - radius), radius, atol=1e-3
    )


@pytest.mark.parametrize("noise", [0.01, 0.02, 0.05])
def test_a_path_recorded_with_noise_is_smoothed_or_refused(noise):
    """A straight road, a position every half metre: curvatures of a class are 0.05."""
    s = np.arange(0.0, 200.1, 0.5)
    recorded = np.column_stack([s, 0.0 * s])
    recorded += noise * np.random.default_rng(0).standard_normal(recorded.shape)
    recorded = jnp.asarray(recorded, jnp.float32)
    with pytest.raises(ValueError, match=r"a curvature of 0\.\d+ 1/m at \d.*tolerance"):
        paths.path_through(recorded, curvature=0.05)
    tolerance = noise * np.sqrt(2.0)
    path = paths.path_through(recorded, tolerance=tolerance, curvature=0.002)
    assert np.abs(path.points[:, 1]).max() < noise
    np.testing.assert_allclose(path.length, 200.0, atol=1.0)


@pytest.mark.parametrize("apart", [2, 5, 10])
def test_a_path_bends_smoothly_beside_way_points_far_apart(apart):
    """Its curvature is a sine of 0.026 1/m; straight between them it would be 0.25."""
    s = np.arange(0.0, 300.05, 0.1)
    bend = 0.026 * np.sin(s / 25.0)
    road = jax.jit(partial(path_from_curvature, spacing=0.1))(np.float32(bend))
    sparse = road.points[:: 10 * apart, :2]
    path = paths.path_through(sparse, tolerance=0.01, curvature=0.027)
    samples = np.asarray(path.points)
    away = samples[:, None, :2] - np.asarray(road.points)[None, :, :2]
    away = np.linalg.norm(away, axis=2)
    assert away.min(axis=1).max() < 0.15
    # Beyond the first and the last way-point nothing says how it goes on.
    inside = (samples[:, 0] > 20.0) & (np.arange(len(samples)) < len(samples) - 40)
    off = np.abs(samples[:, 3] - bend[away.argmin(axis=1)])
    assert off[inside].max() < 2e-3


def test_a_smooth_lap_closes_and_few_positions_are_a_straight_path():
    angle = np.linspace(0.0, 2 * np.pi, 100, endpoint=False)
    ring = 50.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    ring += 0.03 * np.random.default_rng(0).standard_normal(ring.shape)
    lap = paths.path_through(jnp.asarray(ring), closed=True, tolerance=0.04)
    assert isinstance(lap, paths.Lap)
    samples = np.asarray(lap.points)
    np.testing.assert_allclose(samples[0, :2], samples[-1, :2], atol=1e-4)
    np.testing.assert_allclose(samples[-1, 2] - samples[0, 2], 2 * np.pi, atol=1e-4)
    np.testing.assert_allclose(samples[0, 3], samples[-1, 3], atol=1e-5)
    np.testing.assert_allclose(samples[:, 3], 0.02, atol=2e-3)
    steps = np.linalg.norm(np.diff(samples[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(steps, lap.spacing, rtol=1e-3)
    ends = jnp.asarray([[9e2, 5e2], [1e3, 5e2]])
    two = np.asarray(paths.path_through(ends, tolerance=0.1).points)
    np.testing.assert_allclose(two[:, 0], np.linspace(9e2, 1e3, 201), rtol=1e-6)
    np.testing.assert_allclose(two[:, 1:], [[5e2, 0.0, 0.0]] * 201, atol=1e-6)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([[0.0, 0.0], [0.0, 0.0], [5.0, 0.0]], "no two in a row"),
        ([[0.0, 0.0], [jnp.nan, 0.0]], "finite"),
        ([[0.0, 0.0], [0.3, 0.0]], "too few samples"),
    ],
)
def test_positions_that_make_no_path_are_refused(points, words):
    with pytest.raises(ValueError, match=words):
        paths.path_through(jnp.asarray(points))


@pytest.mark.parametrize("tolerance", [-0.1, np.nan, np.inf])
def test_a_tolerance_that_is_no_distance_is_refused(tolerance):
    with pytest.raises(ValueError, match="tolerance must be 0 or more"):
        paths.path_through(jnp.asarray([[0.0, 0.0], [9.0, 0.0]]), tolerance=tolerance)
