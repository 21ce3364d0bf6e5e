"""Splits by trajectory, windows, and measured scales."""

from itertools import chain

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, SHARES, dataset, jit, segments

from sfkd_jax import data as datasets
from sfkd_jax.types import Trajectory

LOW, HIGH = jnp.asarray(ENV_LOW), jnp.asarray(ENV_HIGH)


def numbered(count, steps=6):
    """Trajectories that carry their own number and time."""
    number, time = np.arange(count)[:, None, None], np.arange(steps + 1)[None, :, None]
    states = np.broadcast_to(100.0 * number + time, (count, steps + 1, 4)).astype(
        np.float32
    )
    middle = np.broadcast_to(np.float32([0.6, 0.0]), (count, steps, 2))
    return Trajectory(
        jnp.asarray(states), jnp.asarray(states[:, :-1, :2]), jnp.asarray(middle)
    )


def split(trajectories, seed=0, shares=SHARES, low=LOW, high=HIGH):
    return datasets.split(
        trajectories, jax.random.key(seed), shares=shares, env_low=low, env_high=high
    )


def members(part):
    return (np.asarray(part.states)[:, 0, 0] / 100).astype(int).tolist()


@pytest.mark.parametrize(
    "shares", [SHARES, (0.7, 0.1, 0.1, 0.1), (0.25, 0.25, 0.25, 0.25)]
)
def test_every_trajectory_is_assigned_exactly_once(shares):
    parts_of = split(numbered(43), shares=shares)
    parts = [members(part) for part in parts_of[:4]]
    assert sorted(chain(*parts)) == list(range(43))
    assert all(
        abs(len(part) - share * 43) <= 1
        for part, share in zip(parts, shares, strict=True)
    )


def test_states_controls_and_environments_stay_together():
    part = split(numbered(43)).train
    np.testing.assert_array_equal(np.asarray(part.states)[:, :-1, :2], part.controls)


def test_the_split_is_shuffled_by_its_key():
    orders = [members(split(numbered(43), seed).train) for seed in (0, 0, 1)]
    assert orders[0] == orders[1] != orders[2]
    assert orders[0] != sorted(orders[0])


@pytest.mark.parametrize(
    "shares",
    [
        (0.5, 0.5, 0.1, -0.1),
        (0.5, 0.3, 0.2, 0.0),
        (0.5, 0.2, 0.2, 0.2),
        (0.1, 0.1, 0.1, 0.1),
    ],
)
def test_bad_shares_are_refused_by_name(shares):
    with pytest.raises(ValueError, match=r"shares.*positive numbers of sum 1"):
        split(numbered(43), shares=shares)


def test_too_few_trajectories_are_refused_with_their_number():
    with pytest.raises(ValueError, match="3 trajectories are too few"):
        split(numbered(3))


@pytest.mark.parametrize(
    ("channel", "value"), [(0, 0.2), (0, 0.95), (1, 9.0), (1, -8.5)]
)
def test_an_environment_outside_its_box_is_refused(channel, value):
    data = numbered(43)
    strayed = data._replace(envs=data.envs.at[7, 3, channel].set(value))
    with pytest.raises(ValueError, match="environments leave the box"):
        split(strayed)


def test_an_environment_that_is_not_a_number_is_refused():
    data = numbered(43)
    with pytest.raises(ValueError, match="environments leave the box"):
        split(data._replace(envs=data.envs.at[7, 3, 0].set(jnp.nan)))


def test_windows_are_slices():
    data = segments()
    rows, starts = np.asarray([5, 0, 119]), np.asarray([0, 7, 17])
    cut = datasets.windows(data, jnp.asarray(rows), jnp.asarray(starts), length=8)
    for k, (row, start) in enumerate(zip(rows, starts, strict=True)):
        np.testing.assert_array_equal(
            cut.states[k], np.asarray(data.states)[row, start : start + 9]
        )
        np.testing.assert_array_equal(
            cut.controls[k], np.asarray(data.controls)[row, start : start + 8]
        )
        np.testing.assert_array_equal(
            cut.envs[k], np.asarray(data.envs)[row, start : start + 8]
        )


def test_random_windows_reach_every_trajectory_and_every_start_evenly():
    drawn = datasets.random_windows(
        numbered(4), jax.random.key(0), batch=4000, length=4
    )
    first = np.asarray(drawn.states)[:, 0, 0].astype(int)
    assert sorted(set(first)) == [
        100 * row + start for row in range(4) for start in range(3)
    ]
    counts = np.unique(first, return_counts=True)[1]
    assert np.all(np.abs(counts - 4000 / 12) < 5 * np.sqrt(4000 / 12))


def test_a_window_may_be_as_long_as_the_trajectory_and_no_longer():
    drawn = datasets.random_windows(numbered(3), jax.random.key(0), batch=5, length=6)
    assert np.all(np.asarray(drawn.states)[:, 0, 0] % 100 == 0)
    with pytest.raises(
        ValueError, match="windows of 7 steps do not fit trajectories of 6 steps"
    ):
        datasets.random_windows(numbered(3), jax.random.key(0), batch=5, length=7)


def test_scales_are_those_of_the_training_split_and_of_the_box():
    data = dataset()
    measured = jax.tree.map(np.asarray, jit(datasets.measure_space)(data))
    np.testing.assert_allclose(measured.env_mean, [0.6, 0.0], atol=1e-6)
    np.testing.assert_allclose(measured.env_scale, [0.3, 8.0], atol=1e-6)
    speed = np.asarray(data.train.states)[..., 3]
    assert measured.body_mean.shape == measured.body_scale.shape == (1,)
    inside = np.abs(speed - measured.body_mean[0]) <= measured.body_scale[0]
    assert 0.99 < inside.mean() <= 1.0
    reach = np.ptp(np.asarray(data.train.controls).reshape(-1, 2), axis=0)
    assert np.all(2 * measured.control_scale <= reach + 1e-6)
    assert np.all(2 * measured.control_scale > 0.8 * reach)
    assert abs(measured.increment_mean[0] - 0.1 * speed.mean()) < 0.02


def test_scales_come_from_the_training_split_alone():
    data = dataset()
    poisoned = data._replace(
        **{
            name: jax.tree.map(lambda leaf: 1e3 * leaf, getattr(data, name))
            for name in ("validation", "calibration", "test")
        }
    )
    measure = jit(datasets.measure_space)
    for honest, other in zip(measure(data), measure(poisoned), strict=True):
        np.testing.assert_array_equal(honest, other)


def test_a_channel_that_never_moves_gets_scale_one():
    data = numbered(43)
    still = data._replace(controls=jnp.zeros_like(data.controls))
    measured = datasets.measure_space(split(still))
    np.testing.assert_array_equal(measured.control_scale, np.ones(2))


def test_scenarios_of_segments_stay_with_their_trajectories():
    """Half of the segments of `generate` are S1, without wind; S2 has wind."""
    data = dataset()
    for part in datasets._splits.PARTS:
        windy = np.abs(np.asarray(getattr(data, part).envs)[..., 1]).max(axis=1) > 0
        names = np.asarray(datasets.SCENARIOS)[np.asarray(data.scenarios[part])]
        np.testing.assert_array_equal(names, np.where(windy, "s2", "s1"))


@pytest.mark.parametrize("segments", [4, 7, 101])
def test_every_segment_has_a_scenario(segments):
    for labels, names in (
        (datasets.segment_scenarios(segments), {"s1", "s2"}),
        (datasets.segment_scenarios_along_path(segments), set(datasets.SCENARIOS)),
    ):
        assert len(labels) == segments
        assert {datasets.SCENARIOS[code] for code in labels} == names
