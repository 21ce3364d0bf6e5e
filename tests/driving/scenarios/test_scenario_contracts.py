"""The contract of every scenario family: shapes, randomness, arrays, and the box of e."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, at, jit, same

from sfkd_jax.driving import paths, scenarios
from sfkd_jax.driving.lanes import circles

EVERY = tuple(scenarios.ROADS)
KEYS = jax.random.split(jax.random.key(7), 32)
STEPS, DT, STATES = 60, 0.1, 4


def make(name):
    return scenarios.scenario(
        name=name, duration=STEPS * DT, state_size=STATES, dt=DT, speed=9.0
    )


@cache
def sampled(name):
    """One compilation of a family serves all tests."""
    return jit(jax.vmap(make(name)))


@cache
def batch(name):
    return sampled(name)(KEYS)


@pytest.mark.parametrize("name", EVERY)
def test_a_batch_of_episodes_is_finite_starts_on_its_paths_and_stays_in_the_box(name):
    episodes = batch(name)
    leaves = jax.tree.leaves(episodes)
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    assert {leaf.dtype.name for leaf in leaves} <= {"float32", "bool"}
    assert {leaf.shape[0] for leaf in leaves} == {32}
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in leaves)
    assert episodes.envs.shape == episodes.observed_envs.shape == (32, STEPS, 2)
    start = np.tile(np.float32([0.0, 0.0, 0.0, 9.0]), (32, 1))
    np.testing.assert_array_equal(episodes.initial_state, start)
    np.testing.assert_array_equal(episodes.path.points[:, 0], np.zeros((32, 4)))
    np.testing.assert_array_equal(episodes.speed, np.full(32, np.float32(9.0)))
    np.testing.assert_array_equal(episodes.observed_envs, episodes.envs)
    low, high = np.asarray(ENV_LOW) - 1e-6, np.asarray(ENV_HIGH) + 1e-6
    assert np.all((episodes.envs >= low) & (episodes.envs <= high))


@pytest.mark.parametrize("name", EVERY)
def test_an_episode_follows_from_its_key_alone_and_another_key_makes_another(name):
    again = sampled(name)(KEYS[::-1])
    assert same(at(again, slice(None, None, -1)), batch(name), rtol=0, atol=0)
    curvatures, envs = np.asarray(again.path.points)[..., 3], np.asarray(again.envs)
    assert len(np.unique(curvatures.round(5), axis=0)) == len(KEYS)
    if name != "s1":  # whose friction is constant and whose air is calm
        assert len(np.unique(envs, axis=0)) > 1


@pytest.mark.parametrize("name", EVERY)
def test_no_key_is_used_twice(name):
    with jax.debug_key_reuse(True):
        jax.jit(make(name))(jax.random.key(0))


def test_obstacles_stand_as_far_apart_as_asked_and_are_seen_when_the_car_is_near():
    family = scenarios.scenario(name="obstacles", duration=60.0, state_size=4, dt=DT)
    made = jit(family)(KEYS[0])
    course, every = made.course, np.asarray(made.course.obstacles.position)[:, 0]
    along, present = np.asarray(course.along), np.asarray(course.obstacles.present)
    assert np.all((np.diff(along) >= 40.0) & (np.diff(along) <= 60.0))
    # All that are met in 60 s at 10 m/s are there.
    assert along[0] >= 70.0
    assert present[along < 600.0].all()
    foot, aside = jit(jax.vmap(paths.project, in_axes=(None, 0, 0)))(
        made.path, every, course.along
    )
    np.testing.assert_allclose(foot[present], along[present], atol=0.05)
    assert 0.5 < np.abs(aside).max() <= 1.501
    see = jit(scenarios.in_view)
    for progress in (0.0, 10.0, 200.0, along[2], along[-1]):
        shown = see(course, progress)
        seen = np.asarray(shown.position)[np.asarray(shown.present)][:, 0]
        ahead = along - progress
        near = every[present & (ahead > 0) & (ahead <= 60.0)]
        assert {*map(tuple, near)} <= {*map(tuple, seen)}
        assert not {*map(tuple, every[ahead > 60.0])} & {*map(tuple, seen)}


def test_the_clearance_of_a_car_is_that_of_its_box():
    obstacles = circles(jnp.asarray([[5.0, 0.0]]), 0.8)
    near = jit(partial(scenarios.car_clearance, size=(4.5, 2.0)))
    ahead, across = jnp.zeros(4), jnp.asarray([0.0, 0.0, np.pi / 2, 9.0])
    assert near(obstacles, ahead) == pytest.approx(5.0 - 2.25 - 0.8, abs=1e-4)
    assert near(obstacles, across) == pytest.approx(5.0 - 1.0 - 0.8, abs=1e-4)
    assert near(obstacles, ahead.at[:2].set(jnp.asarray([4.0, 0.5]))) < 0.0
