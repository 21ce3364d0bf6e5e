"""Measured bounds: intervals of shares, conformal bounds, disturbances."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import driven, model_and_params

from sfkd_jax.certification._measured import (
    alarm_thresholds,
    conformal_bounds,
    coverage,
    coverage_interval,
    residuals,
)


@pytest.mark.parametrize(
    ("successes", "trials", "lower", "upper"),
    [
        (0, 200, 0.0, 1 - 0.025 ** (1 / 200)),
        (200, 200, 0.025 ** (1 / 200), 1.0),
        (0, 1, 0.0, 0.975),
        (6, 200, 0.01107, 0.06415),
        (5, 10, 0.18709, 0.81291),
        (950, 1000, 0.93462, 0.96267),
    ],
)
def test_the_interval_of_a_proportion_is_the_exact_one(successes, trials, lower, upper):
    np.testing.assert_allclose(
        coverage_interval(successes / trials, trials), (lower, upper), atol=1e-4
    )


def scores(random, count):
    """Exchangeable, correlated between kinds, heavy-tailed, in four different units."""
    common = random.standard_exponential((count, 1))
    return (common + random.standard_exponential((count, 4)) ** 2) * np.asarray(
        [1.0, 1e-3, 50.0, 7.0]
    )


@pytest.mark.parametrize(("level", "count"), [(0.9, 39), (0.95, 59), (0.8, 24)])
def test_conformal_bounds_cover_a_new_trajectory_as_often_as_they_say(level, count):
    """Split conformal, exactly: P(covered) = ⌈(n+1) level⌉/(n+1), here level to
    1/(n+1), for all four kinds at once.
    """
    random, shares = np.random.default_rng(0), []
    for _ in range(250):
        reference, calibration = scores(random, 50), scores(random, count)
        bounds = conformal_bounds(reference, calibration, level=level)
        shares.append(coverage(bounds, scores(random, 100)).share)
    exact = np.ceil((count + 1) * level) / (count + 1)
    assert abs(np.mean(shares) - exact) < 4 * np.std(shares) / np.sqrt(250)
    assert level - 1e-12 <= exact <= level + 1 / (count + 1)


@pytest.mark.parametrize(("count", "level"), [(18, 0.95), (98, 0.99)])
def test_too_few_trajectories_for_the_level_are_refused(count, level):
    random = np.random.default_rng(0)
    reference, table = scores(random, 50), scores(random, count + 1)
    message = (
        f"{count} calibration trajectories are too few for certification.level={level}"
    )
    with pytest.raises(ValueError, match=message):
        conformal_bounds(reference, table[:-1], level=level)
    assert np.all(np.isfinite(conformal_bounds(reference, table, level=level)))


@pytest.mark.parametrize("level", [0.0, 1.0, -0.5, 1.5, np.nan])
def test_a_level_that_is_none_is_refused(level):
    table = scores(np.random.default_rng(0), 50)
    with pytest.raises(ValueError, match="level must lie between 0 and 1"):
        conformal_bounds(table, table, level=level)


def test_segments_of_few_runs_give_the_interval_of_few_trials():
    between = (coverage_interval(0.5, 2)[0], coverage_interval(1.0, 2)[1])
    assert coverage_interval(0.9, 2) == between
    narrow, wide = coverage_interval(0.95, 600), coverage_interval(0.95, 4)
    assert wide[0] < narrow[0] < 0.95 < narrow[1] < wide[1]


def test_runs_without_a_bound_exceed_every_bound_and_too_many_are_refused():
    """NaN is no score. An infinite one is that of a run in which a simulator failed."""
    table = scores(np.random.default_rng(0), 50)
    for value, failed in ((np.nan, 1), (np.inf, 5)):
        spoiled = table.copy()
        spoiled[:failed, 0] = value
        with pytest.raises(ValueError, match="not finite"):
            conformal_bounds(table, spoiled, level=0.9)
        with pytest.raises(ValueError, match="not finite"):
            conformal_bounds(spoiled, table, level=0.9)
    few, largest = table.copy(), table.copy()
    few[:4, 0], largest[:4, 0] = np.inf, 1e9
    found = conformal_bounds(table, few, level=0.9)
    np.testing.assert_array_equal(found, conformal_bounds(table, largest, level=0.9))
    assert coverage(found, few).share <= 46 / 50


def largest(data):
    """Of the true plant as a model."""
    return residuals(*model_and_params("oracle"), data).largest()


def test_a_disturbance_is_the_largest_along_the_trajectory():
    """None of the true plant; a known sideways one of a single step exactly."""
    data = driven()
    kinds = largest(data)
    assert np.all(kinds < 5e-6)
    states = np.array(data.states)
    states[1, 5:, 3] += 0.25  # later steps differ too: the plant depends on v
    disturbed = largest(data._replace(states=jnp.asarray(states)))
    np.testing.assert_allclose(disturbed[[0, 2]], kinds[[0, 2]], atol=1e-7)
    assert disturbed[1, 3] >= 0.25 - 1e-5
    # The latent of a physics model is the body state.
    assert disturbed[1, 0] == pytest.approx(disturbed[1, 3], rel=1e-4)


def test_position_and_yaw_disturbances_are_those_of_the_pose_increment():
    data = driven()
    states = np.array(data.states)
    states[2, 4:, :2] += 0.3, 0.4
    moved = largest(data._replace(states=jnp.asarray(states)))
    np.testing.assert_allclose(moved[2], [0.0, 0.5, 0.0, 0.0], atol=1e-5)
    states[2, 4:, 2] += 0.1
    turned = largest(data._replace(states=jnp.asarray(states)))
    np.testing.assert_allclose(turned[2], [0.0, 0.5, 0.1, 0.0], atol=1e-5)


def test_thresholds_are_exceeded_as_rarely_as_asked():
    random = np.random.default_rng(0)
    draw = lambda count: random.standard_exponential((count, 3)) * [1.0, 20.0, 0.1]
    thresholds = alarm_thresholds(draw(2000), draw(2000), rate=1e-3)
    share = np.mean(np.any(draw(200_000) > thresholds, axis=1))
    assert 5e-4 < share < 2e-3
