"""Splits by trajectory, windows, and measured scales."""

from itertools import chain

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, SHARES, dataset, jit, segments

from sfkd_jax import data as datasets
from sfkd_jax.driving import drives
from sfkd_jax.driving.logs._segments import assign_parts
from sfkd_jax.rollout import windows
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


@pytest.mark.parametrize("shares", [SHARES, (0.25, 0.25, 0.25, 0.25)])
def test_every_trajectory_is_assigned_exactly_once(shares):
    parts_of = split(numbered(43), shares=shares)
    parts = [members(part) for part in parts_of[:4]]
    assert sorted(chain(*parts)) == list(range(43))
    assert all(
        abs(len(part) - share * 43) <= 1
        for part, share in zip(parts, shares, strict=True)
    )
    part = parts_of.train  # states and controls stay together
    np.testing.assert_array_equal(np.asarray(part.states)[:, :-1, :2], part.controls)


@pytest.mark.parametrize(
    ("count", "shares", "message"),
    [
        (43, (0.5, 0.5, 0.1, -0.1), r"shares.*positive numbers of sum 1"),
        (43, (0.5, 0.2, 0.2, 0.2), r"shares.*positive numbers of sum 1"),
        (3, SHARES, "3 trajectories are too few"),
    ],
)
def test_what_cannot_be_split_is_refused(count, shares, message):
    with pytest.raises(ValueError, match=message):
        split(numbered(count), shares=shares)


@pytest.mark.parametrize("value", [9.0, -8.5, jnp.nan])
def test_an_environment_outside_its_box_is_refused(value):
    data = numbered(43)
    strayed = data._replace(envs=data.envs.at[7, 3, 1].set(value))
    with pytest.raises(ValueError, match="environments leave the box"):
        split(strayed)


def test_windows_are_slices():
    data = segments()
    rows, starts = np.asarray([5, 0, 119]), np.asarray([0, 7, 17])
    cut = windows(data, jnp.asarray(rows), jnp.asarray(starts), length=8)
    for leaf, whole, size in zip(cut, data, (9, 8, 8), strict=True):
        for k, (row, start) in enumerate(zip(rows, starts, strict=True)):
            np.testing.assert_array_equal(leaf[k], whole[row, start : start + size])


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
    # A channel that never moves gets scale one.
    still = data.train._replace(controls=jnp.zeros_like(data.train.controls))
    scale = measure(data._replace(train=still)).control_scale
    np.testing.assert_array_equal(scale, np.ones(2))


def test_scenarios_of_segments_stay_with_their_trajectories():
    """Half of the segments of `generate` are on a uniform road, without wind."""
    data = dataset()
    for part in datasets.PARTS:
        windy = np.abs(np.asarray(getattr(data, part).envs)[..., 1]).max(axis=1) > 0
        names = np.asarray(drives.SCENARIOS)[np.asarray(data.scenarios[part])]
        np.testing.assert_array_equal(names, np.where(windy, "wet", "uniform"))
    for count in (4, 7, 101):
        labels = drives.segment_scenarios(count, along_path=True)
        assert len(labels) == count
        assert set(labels) == set(range(len(drives.SCENARIOS)))


RECORDED = (0.6, 0.1, 0.2, 0.1)


def assign(runs):
    return assign_parts(np.asarray(runs), shares=RECORDED, seed=0)


@pytest.mark.parametrize("runs", [20, 50, 200])
def test_runs_are_assigned_whole_where_there_are_enough(runs):
    labels = np.repeat(np.arange(runs), 7)
    parts, whole = assign(labels)
    assert whole
    assert all(len(set(parts[labels == run])) == 1 for run in range(runs))
    shares = np.bincount(parts) / len(labels)
    assert np.all(np.abs(shares - RECORDED) <= 1.0 / runs + 1e-9)


@pytest.mark.parametrize("sizes", [(40,), (20, 20), (100, 1, 1, 1, 1, 1)])
def test_too_few_runs_are_cut_in_time(sizes):
    parts, whole = assign(np.repeat(np.arange(len(sizes)), sizes))
    assert not whole
    first = parts[: sizes[0]]
    assert np.all(np.diff(first) >= 0)
    np.testing.assert_allclose(
        np.bincount(first) / sizes[0], RECORDED, atol=1.0 / sizes[0]
    )


def test_coverage_counts_the_tenths_that_were_visited():
    values = np.concatenate([np.linspace(0.0, 0.499, 999), [1.0]])
    covered = datasets.coverage({"v": values, "still": np.zeros(5)})
    assert covered["v"]["low"] == 0.0
    assert covered["v"]["high"] == 1.0
    assert covered["v"]["bins_visited"] == 0.6
    assert covered["still"]["bins_visited"] == 0.0
