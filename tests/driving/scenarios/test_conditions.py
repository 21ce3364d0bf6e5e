"""Friction and wind over time: the three schedules of the benchmark, and the gusts."""

from functools import partial

import jax
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.driving.scenarios import (
    gusts,
    scenario,
    switching_road,
    uniform_road,
    wet_road,
)

STEPS, DT = 600, 0.1
KEYS = jax.random.split(jax.random.key(7), 64)


def many(schedule, keys=KEYS, **settings):
    return np.asarray(jit(jax.vmap(partial(schedule, **settings)))(keys))


@pytest.fixture(scope="module")
def s3():
    return many(switching_road, steps=STEPS, dt=DT)


@pytest.fixture(scope="module")
def s2():
    return many(wet_road, steps=STEPS, dt=DT)


def test_s1_with_a_range_draws_one_level_an_episode_evenly():
    envs = many(
        uniform_road,
        steps=5,
        friction=(0.3, 0.9),
        keys=jax.random.split(jax.random.key(1), 2000),
    )
    assert np.all(envs == envs[:, :1])
    assert kolmogorov_distance(envs[:, 0, 0], 0.3, 0.9) < 1.63 / np.sqrt(2000)


def test_s2_drops_once_and_exactly_at_five_seconds(s2):
    before, after = s2[:, : round(5 / DT), 0], s2[:, round(5 / DT) :, 0]
    np.testing.assert_array_equal(before, np.full_like(before, 0.7))
    np.testing.assert_array_equal(after, np.full_like(after, 0.35))


def test_gusts_cover_the_whole_range_evenly():
    """Levels are held for 2 s on average and joined by ramps of 0.5 s; one level is
    independent of the next.
    """
    keys = jax.random.split(jax.random.key(11), 3000)
    wind = many(gusts, keys=keys, steps=60, dt=DT, peak=8.0)
    # At the start every value is a level: a true Kolmogorov-Smirnov test at 1 %.
    assert kolmogorov_distance(wind[:, 0], -8.0, 8.0) < 1.63 / np.sqrt(3000)
    # Later a quarter of the values are on ramps, which favour the middle a little.
    assert kolmogorov_distance(wind[:, 40], -8.0, 8.0) < 0.06


def test_gusts_are_smooth():
    """A 1 − cos ramp of height h and duration τ is never steeper than π h / (2 τ)."""
    wind = many(gusts, steps=STEPS, dt=DT, peak=8.0)
    assert np.abs(np.diff(wind, axis=1)).max() <= np.pi * 16.0 / (2 * 0.5) * DT + 1e-4


def test_s3_visits_a_b_c_b_a_for_exactly_three_seconds_each(s3):
    visit = np.arange(STEPS) // round(3 / DT)
    friction = np.float32([0.9, 0.6, 0.3, 0.6])[visit % 4]
    wind = np.float32([0.0, 4.0, 8.0, 4.0])[visit % 4]
    np.testing.assert_array_equal(s3[..., 0], np.broadcast_to(friction, s3.shape[:2]))
    np.testing.assert_array_equal(
        np.abs(s3[..., 1]), np.broadcast_to(wind, s3.shape[:2])
    )


def test_s3_holds_the_side_of_the_wind_for_a_visit_and_draws_it_anew_for_the_next(s3):
    visits = s3[..., 1].reshape(len(KEYS), -1, 30)
    assert np.all(visits == visits[..., :1])
    windy = np.sign(visits[:, :, 0][:, np.arange(20) % 4 > 0])
    assert abs(windy.mean()) < 4 / np.sqrt(windy.size)
    repeated = np.mean(windy[:, 1:] == windy[:, :-1])
    assert abs(repeated - 0.5) < 4 * 0.5 / np.sqrt(windy[:, 1:].size)


@pytest.mark.parametrize("name", ["s1", "s2", "s3"])
def test_levels_are_shares_of_the_box_and_of_the_benchmarks_own_to_the_bit(name):
    """One entry, two, and three of which the last has no other side."""
    sample = lambda **box: np.asarray(jit(make(name, **box))(KEYS[3]).envs)
    known = sample()
    own = sample(env_low=(0.3, -8.0), env_high=(0.9, 8.0))
    np.testing.assert_array_equal(known, own)
    one = sample(env_low=(10.0,), env_high=(70.0,))
    np.testing.assert_allclose(one[:, 0], 100.0 * known[:, 0] - 20.0, rtol=1e-5)
    wide = sample(env_low=(0.0, -1.0, 100.0), env_high=(6.0, 4.0, 900.0))
    share = known[:, 1] / 8.0
    expected = [10.0 * known[:, 0] - 3.0, np.where(share < 0, share, 4 * share)]
    expected += [100.0 + 800.0 * np.abs(share)]
    np.testing.assert_allclose(wide, np.stack(expected, axis=1), rtol=1e-5, atol=1e-5)


def kolmogorov_distance(values, low, high):
    """sup |empirical distribution − uniform distribution|."""
    ranks = np.arange(len(values) + 1) / len(values)
    uniform = (np.sort(values) - low) / (high - low)
    return max(np.max(ranks[1:] - uniform), np.max(uniform - ranks[:-1]))


def make(name, duration=6.0, **settings):
    return scenario(name=name, duration=duration, state_size=4, dt=DT, **settings)


def test_an_unknown_name_lists_the_choices():
    with pytest.raises(ValueError, match=r"'s4'.*s1, s2, s3"):
        make("s4")


def test_road_and_weather_come_from_independent_streams():
    """The same key gives the same road in every family."""
    roads = [jit(make(name))(KEYS[0]).path.points for name in ("s1", "s2", "s3")]
    np.testing.assert_array_equal(roads[0], roads[1])
    np.testing.assert_array_equal(roads[0], roads[2])
