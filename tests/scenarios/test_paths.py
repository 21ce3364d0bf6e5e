"""Paths by arc length: circles, clothoids, points between samples, projection."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.scenarios import path_from_curvature, point_at, project, reference_window, smooth_path

RADIUS = 50.0
POINTS = jit(jax.vmap(point_at, in_axes=(None, 0)))
PROJECT = jit(jax.vmap(project, in_axes=(None, 0, 0)))


@pytest.fixture(scope="module")
def circle():
    return path_from_curvature(jnp.full(400, 1.0 / RADIUS), spacing=0.5)


@pytest.fixture(scope="module")
def road():
    return jit(partial(smooth_path, length=300.0, peak_curvature=0.03))(jax.random.key(3))


def beside(path, s, offset):
    """The positions `offset` [m] to the left of the path at s."""
    points = POINTS(path, s)
    return points[:, :2] + offset[:, None] * jnp.stack([-jnp.sin(points[:, 2]), jnp.cos(points[:, 2])], axis=1)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_constant_curvature_makes_a_circle_of_exactly_that_radius(side):
    path = path_from_curvature(jnp.full(700, side / RADIUS), spacing=0.5)
    centre = jnp.asarray([0.0, side * RADIUS])
    samples = jnp.linalg.norm(path.points[:, :2] - centre, axis=1)
    between = POINTS(path, jnp.linspace(0.0, 349.0, 2001))
    np.testing.assert_allclose(samples, RADIUS, rtol=1e-5)  # chords of 0.5 m: relative error h²/24R² = 4e-6
    np.testing.assert_allclose(jnp.linalg.norm(between[:, :2] - centre, axis=1), RADIUS, rtol=2e-5)
    np.testing.assert_allclose(between[:, 3], side / RADIUS, rtol=1e-6)
    np.testing.assert_allclose(between[:, 2], side * jnp.linspace(0.0, 349.0, 2001) / RADIUS, atol=1e-4)


def test_zero_curvature_makes_a_straight_line():
    path = path_from_curvature(jnp.zeros(50), spacing=0.5)
    points = POINTS(path, jnp.asarray([0.0, 0.3, 7.77, 24.5]))
    np.testing.assert_allclose(points[:, 0], [0.0, 0.3, 7.77, 24.5], rtol=1e-6)
    np.testing.assert_array_equal(points[:, 1:], jnp.zeros((4, 3)))


def test_a_path_starts_at_the_origin_along_x_and_without_curvature(road):
    np.testing.assert_array_equal(road.points[0], jnp.zeros(4))


def test_points_between_samples_join_the_samples_without_a_jump(road):
    s = jnp.arange(1, 500) * road.spacing
    before, after = POINTS(road, s - 1e-3), POINTS(road, s + 1e-3)
    np.testing.assert_allclose(after[:, :2], before[:, :2], atol=2.5e-3)  # 2 mm of travel and float32 at 300 m
    np.testing.assert_allclose(after[:, 2:], before[:, 2:], atol=2e-4)
    np.testing.assert_allclose(POINTS(road, s)[:, :2], road.points[1:500, :2], atol=1e-3)


def test_points_between_samples_agree_with_integration_on_a_ten_times_finer_grid(road):
    curvature = np.asarray(road.points[:, 3], dtype=np.float64)
    s = np.arange(len(curvature)) * 0.5
    fine_s = np.arange(10 * (len(curvature) - 1) + 1) * 0.05
    kappa = np.interp(fine_s, s, curvature)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (kappa[1:] + kappa[:-1])) * 0.05])
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    x = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * 0.05])
    y = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * 0.05])
    points = POINTS(road, jnp.asarray(fine_s, dtype=jnp.float32))
    np.testing.assert_allclose(points[:, 0], x, atol=5e-3)
    np.testing.assert_allclose(points[:, 1], y, atol=5e-3)
    np.testing.assert_allclose(points[:, 2], yaw, atol=2e-4)
    np.testing.assert_allclose(points[:, 3], kappa, atol=2e-6)


def test_arc_length_is_clamped_to_the_path(circle):
    np.testing.assert_array_equal(POINTS(circle, jnp.asarray([-5.0]))[0], circle.points[0])
    np.testing.assert_allclose(POINTS(circle, jnp.asarray([1e4]))[0], circle.points[-1], atol=1e-4)


def test_projection_returns_the_distance_and_the_arc_length_that_a_point_was_placed_at(road):
    s_key, offset_key, guess_key = jax.random.split(jax.random.key(0), 3)
    s = jax.random.uniform(s_key, (300,), minval=5.0, maxval=290.0)
    offset = jax.random.uniform(offset_key, (300,), minval=-4.0, maxval=4.0)
    guess = s + jax.random.uniform(guess_key, (300,), minval=-2.0, maxval=2.0)
    found, lateral = PROJECT(road, beside(road, s, offset), guess)
    np.testing.assert_allclose(lateral, offset, atol=2e-3)
    np.testing.assert_allclose(found, s, atol=5e-3)


def test_left_of_the_path_is_positive(circle):
    found, lateral = PROJECT(circle, jnp.asarray([[0.0, 1.0], [0.0, -2.0]]), jnp.zeros(2))
    np.testing.assert_allclose(lateral, [1.0, -2.0], atol=1e-5)
    np.testing.assert_allclose(found, [0.0, 0.0], atol=1e-5)


def test_projection_stays_finite_far_from_the_path_and_at_the_centre_of_a_circle(circle):
    positions = jnp.asarray([[0.0, RADIUS], [500.0, 500.0], [-1e4, 0.0]])
    found, lateral = PROJECT(circle, positions, jnp.asarray([10.0, 50.0, 0.0]))
    assert bool(jnp.all(jnp.isfinite(found)) and jnp.all(jnp.isfinite(lateral)))


@pytest.mark.parametrize("peak", [0.01, 0.03])
def test_the_peak_curvature_is_reached_and_not_exceeded(peak):
    make = jit(jax.vmap(partial(smooth_path, length=200.0, peak_curvature=peak)))
    roads = make(jax.random.split(jax.random.key(1), 20))
    np.testing.assert_allclose(jnp.max(jnp.abs(roads.points[:, :, 3]), axis=1), peak, rtol=1e-5)


def test_the_curvature_is_smooth_at_the_shortest_wavelength(road):
    """|κ'| ≤ 2π κ_sum / λ_min; the three amplitudes may add up to three times the peak at most, the blend adds little."""
    slope = jnp.abs(jnp.diff(road.points[:, 3])) / road.spacing
    assert float(jnp.max(slope)) < 3 * 0.03 * 2 * np.pi / 50.0 + 1.5 * 0.03 / 20.0


def test_a_path_is_at_least_as_long_as_asked():
    for length in (10.0, 99.9, 100.0):
        path = jax.eval_shape(partial(smooth_path, length=length, spacing=0.5), jax.random.key(0))
        assert (path.points.shape[0] - 1) * 0.5 >= length


def test_different_keys_make_different_roads_and_the_same_key_the_same_road():
    make = jit(jax.vmap(partial(smooth_path, length=60.0)))
    keys = jax.random.split(jax.random.key(0), 8)
    first, again = make(keys), make(keys)
    np.testing.assert_array_equal(first.points, again.points)
    ends = np.asarray(first.points[:, -1, :2])
    apart = np.linalg.norm(ends[:, None] - ends[None], axis=2) + np.eye(8)
    assert apart.min() > 1e-3


def test_the_reference_window_holds_the_next_points_at_the_given_speed(circle):
    window = jit(partial(reference_window, dt=0.1, horizon=5))(circle, jnp.asarray(3.0), jnp.asarray(8.0))
    expected = POINTS(circle, 3.0 + 0.8 * jnp.arange(1, 6))
    np.testing.assert_allclose(window[:, :3], expected[:, :3], atol=1e-6)
    np.testing.assert_array_equal(window[:, 3], jnp.full(5, 8.0))
