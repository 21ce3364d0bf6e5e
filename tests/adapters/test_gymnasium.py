"""The vehicles as a gymnasium environment: the checker, seeds, the same episode as in
brax, and refusals.
"""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers import jit

from sfkd_jax import adapters

adapters.register_gymnasium()
SETTINGS = {"scenario": "s3", "duration": 3.0}
ACTION = np.asarray([0.02, 0.34], dtype=np.float32)


@pytest.fixture(scope="module")
def made():
    return gymnasium.make("sfkd_jax/Vehicle-v0", **SETTINGS)


def episode(env, seed, steps=30):
    first, _ = env.reset(seed=seed)
    taken = [env.step(ACTION) for _ in range(steps)]
    return np.stack([first, *(step[0] for step in taken)]), taken


def test_it_passes_the_checker(made):
    check_env(made.unwrapped, skip_render_check=True)


def test_registering_twice_changes_nothing():
    before = gymnasium.spec("sfkd_jax/Vehicle-v0")
    adapters.register_gymnasium()
    assert gymnasium.spec("sfkd_jax/Vehicle-v0") is before


def test_the_same_seed_is_the_same_episode_and_another_is_not(made):
    once, _ = episode(made, 7)
    again, _ = episode(made, 7)
    other, _ = episode(made, 8)
    np.testing.assert_array_equal(once, again)
    assert np.abs(once - other).max() > 1e-2


def test_episodes_after_a_seed_differ_and_repeat(made):
    roads = [
        [made.reset(seed=3)[0], episode(made, None, 5)[0], episode(made, None, 5)[0]]
        for _ in range(2)
    ]
    for once, again in zip(*roads, strict=True):
        np.testing.assert_array_equal(once, again)
    assert np.abs(roads[0][1] - roads[0][2]).max() > 1e-4


def test_it_drives_what_the_task_says(made):
    observations, taken = episode(made, 11)
    task = adapters.tracking_task(**SETTINGS)
    key = jax.random.key(int(gymnasium.utils.seeding.np_random(11)[0].integers(2**31)))
    road, moment = jit(task.reset)(key)
    step = jit(
        lambda moment: (
            task.step(road, moment, jnp.asarray(ACTION)),
            task.observe(road, moment),
        )
    )
    for seen, (_, reward, terminated, truncated, info) in zip(
        observations, taken, strict=False
    ):
        (moment, outcome), expected = step(moment)
        np.testing.assert_allclose(seen, expected, atol=1e-4)
        np.testing.assert_allclose(reward, outcome.reward, rtol=1e-3, atol=1e-3)
        assert (terminated, truncated) == (bool(outcome.left), bool(outcome.over))
        assert info == pytest.approx(
            {name: float(value) for name, value in outcome.measures.items()}, abs=1e-3
        )


def test_the_end_of_the_road_truncates_and_leaving_the_lane_terminates(made):
    _, taken = episode(made, 0)
    assert [step[2:4] for step in taken] == [(False, False)] * 29 + [(False, True)]
    made.reset(seed=0)
    for _ in range(30):
        _, reward, terminated, truncated, info = made.step(
            np.asarray([-1.0, 0.34], dtype=np.float32)
        )
        if terminated:
            break
    assert terminated
    assert not truncated
    assert info["lateral"] > 3.0
    assert reward < -2e4


def test_a_vector_of_them_steps():
    envs = gymnasium.make_vec(
        "sfkd_jax/Vehicle-v0", num_envs=2, vectorization_mode="sync", **SETTINGS
    )
    observations, _ = envs.reset(seed=1)
    after, rewards, *_ = envs.step(np.stack([ACTION, ACTION]))
    assert observations.shape == after.shape
    assert rewards.shape == (2,)
    assert np.any(observations[0] != observations[1])


def test_it_refuses_bad_settings_and_a_step_before_the_reset():
    with pytest.raises(
        ValueError, match="unknown scenario 's9'; choose one of"
    ) as refusal:
        gymnasium.make("sfkd_jax/Vehicle-v0", scenario="s9")
    assert "\n" not in str(refusal.value)
    with pytest.raises(gymnasium.error.ResetNeeded):
        adapters.GymnasiumVehicle().step(ACTION)
