"""Manoeuvres have the geometry, the pace and the environment that they state."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax import scenarios
from sfkd_jax.scenarios import pace_at, reference_window
from sfkd_jax.scenarios._silverstone import circuit_curvature, pace_of

SPEED, DT = 10.0, 0.1
KEYS = jax.random.split(jax.random.key(3), 8)


def episodes(name):
    family = scenarios.scenario(
        name=name, duration=30.0, state_size=4, dt=DT, speed=SPEED
    )
    return jax.device_get(jax.jit(jax.vmap(family))(KEYS))


def test_a_lane_change_ends_in_the_other_lane_and_comes_back():
    points = episodes("double_lane_change").path.points
    offset, heading = points[..., 1], points[..., 2]
    for lateral, yaw in zip(offset, heading, strict=True):
        assert np.max(np.abs(lateral)) == pytest.approx(3.5, rel=0.02)
        assert np.abs(lateral[:40]).max() == 0.0  # the run-up of at least 20 m
        apart = np.abs(lateral) > 3.4
        assert np.abs(yaw[apart]).max() < 0.08
        assert np.mean(np.abs(lateral) < 0.05) > 0.4
    assert {np.sign(one[np.abs(one).argmax()]) for one in offset} == {-1.0, 1.0}


@pytest.mark.parametrize("name", ["gust_step", "gust_cosine"])
def test_gusts_blow_on_a_straight_road_for_half_of_the_time(name):
    made = episodes(name)
    assert not made.path.points[..., 1:].any()
    friction, wind = made.envs[..., 0], made.envs[..., 1]
    assert (friction == np.float32(0.9)).all()
    assert np.abs(wind).max() == pytest.approx(8.0, rel=1e-3)
    assert not wind[:, :30].any()
    blowing = np.mean(np.abs(wind[:, 60:]) > 1e-3, axis=1)
    np.testing.assert_allclose(blowing, 0.5, atol=0.08)
    largest_step = np.abs(np.diff(wind, axis=1)).max()
    assert largest_step == pytest.approx(8.0 if name == "gust_step" else 0.84, rel=0.02)


def test_friction_falls_in_a_turn_of_fifty_metres():
    made = episodes("friction_step")
    curvature = made.path.points[..., 3]
    np.testing.assert_allclose(np.abs(curvature[:, 200:]), 1 / 50.0, rtol=1e-5)
    assert {np.sign(row[-1]) for row in curvature} == {-1.0, 1.0}
    assert set(np.unique(made.envs[..., 0])) == {np.float32(0.9), np.float32(0.35)}
    assert not made.envs[..., 1].any()


def test_the_speed_of_a_braking_turn_is_halved_and_regained_at_constant_acceleration():
    road = jax.tree.map(lambda leaf: leaf[0], episodes("braking_turn")).path
    assert road.pace.min() == pytest.approx(0.5)
    assert road.pace.max() == 1.0
    speed = SPEED * road.pace
    acceleration = np.diff(speed**2) / (2.0 * road.spacing)
    kinds = np.unique(acceleration.round(1))
    np.testing.assert_allclose(kinds, [-2.5, 0.0, 0.8])


def test_a_reference_follows_the_pace_of_its_path():
    """Points are v dt apart, v the pace at the point before, and carry their speed."""
    road = jax.tree.map(lambda leaf: leaf[0], episodes("braking_turn")).path
    road = jax.tree.map(jnp.asarray, road)
    s = jnp.asarray(95.0)
    window = reference_window(road, s, jnp.asarray(SPEED), dt=DT, horizon=40)
    speeds = np.asarray(window[:, 3])
    assert speeds.min() == pytest.approx(5.0, rel=1e-3)
    assert speeds[0] > 9.9
    gaps = np.linalg.norm(np.diff(window[:, :2], axis=0), axis=1)
    np.testing.assert_allclose(gaps, speeds[:-1] * DT, rtol=2e-3)


def test_a_pace_of_one_changes_nothing():
    family = scenarios.scenario(name="s1", duration=10.0, state_size=4, dt=DT)
    road = family(jax.random.key(0)).path
    paced = road._replace(pace=jnp.ones(road.points.shape[0]))
    s, speed = jnp.asarray(12.3), jnp.asarray(9.0)
    np.testing.assert_allclose(
        reference_window(paced, s, speed, dt=DT, horizon=20),
        reference_window(road, s, speed, dt=DT, horizon=20),
        atol=1e-4,
    )
    assert float(pace_at(road, s)) == 1.0


def test_a_lap_of_the_circuit_closes_and_has_its_published_length():
    """Otherwise the second lap would be beside the first."""
    curvature = circuit_curvature()
    assert curvature.shape[0] * 0.5 == 5891.0
    once_more = np.append(curvature, curvature[0])
    lap = scenarios.path_from_curvature(jnp.asarray(once_more), spacing=0.5).points
    np.testing.assert_allclose(lap[-1, :2], lap[0, :2], atol=0.2)
    assert lap[-1, 2] == pytest.approx(-2 * np.pi, abs=1e-3)  # driven clockwise


def test_the_pace_of_a_lap_keeps_its_limits_also_across_the_finish():
    curvature = circuit_curvature()
    squared = np.asarray(pace_of(curvature)) ** 2
    assert (squared * np.abs(curvature)).max() <= 0.02 * (1 + 1e-5)
    slope = np.diff(np.append(squared, squared[0])) / 0.5
    assert -0.05 * (1 + 1e-3) <= slope.min() < -0.04
    assert 0.015 < slope.max() <= 0.016 * (1 + 1e-3)
    assert squared.max() == 1.0


def test_laps_start_at_full_pace_at_different_places():
    road = episodes("silverstone").path
    assert (road.pace[:, 0] == 1.0).all()
    assert not road.points[:, 0].any()
    assert len(np.unique(road.points[:, 400, 2].round(3))) > 4
