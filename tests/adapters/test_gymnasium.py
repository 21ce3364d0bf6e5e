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


def test_it_passes_the_checker_also_where_it_draws():
    env = gymnasium.make("sfkd_jax/Vehicle-v0", render_mode="rgb_array", **SETTINGS)
    check_env(env.unwrapped)


def test_the_same_seed_is_the_same_episode_and_another_is_not(made):
    once, _ = episode(made, 7)
    again, _ = episode(made, 7)
    other, _ = episode(made, 8)
    np.testing.assert_array_equal(once, again)
    assert np.abs(once - other).max() > 1e-2


def test_it_drives_what_the_task_says(made):
    observations, taken = episode(made, 11)
    task = adapters.DrivingTask(**SETTINGS)
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


def test_an_image_shows_the_car_and_changes_as_it_drives():
    env = gymnasium.make("sfkd_jax/Vehicle-v0", render_mode="rgb_array", **SETTINGS)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.unwrapped.render()
    images = []
    env.reset(seed=0)
    for _ in range(3):
        images.append(env.render())
        for _ in range(5):
            env.step(ACTION)
    assert {(image.shape, str(image.dtype)) for image in images} == {
        ((480, 640, 3), "uint8")
    }
    assert all(len(np.unique(image.reshape(-1, 3), axis=0)) > 10 for image in images)
    assert np.any(images[0] != images[1])
    again = [env.reset(seed=0), env.render()][1]
    np.testing.assert_array_equal(again, images[0])
    env.close()


def test_observations_and_actions_have_limits_where_there_are_any(made):
    space = made.observation_space
    bounded = np.isfinite(space.high)
    # Of e_y, e_ψ, v, two actions, friction, wind, then ten points (x, y, ψ, v).
    head, point = (0, 1, 0, 1, 1, 0, 0), (0, 0, 1, 0)
    np.testing.assert_array_equal(bounded, np.asarray([*head, *10 * point], bool))
    np.testing.assert_allclose(space.high[[1, 3, 4]], [np.pi, 1.0, 1.0], rtol=1e-6)
    assert space.low[5] == 0.0
    observations, _ = episode(made, 5)
    assert all(space.contains(observation) for observation in observations)
    for action in (made.action_space.high, made.action_space.low):
        made.reset(seed=1)
        observation, *_ = made.step(action)
        assert space.contains(observation)


def test_it_refuses_bad_settings_and_a_step_before_the_reset():
    with pytest.raises(
        ValueError, match="unknown scenario 's9'; choose one of"
    ) as refusal:
        gymnasium.make("sfkd_jax/Vehicle-v0", scenario="s9")
    assert "\n" not in str(refusal.value)
    with pytest.raises(gymnasium.error.ResetNeeded):
        adapters.GymnasiumVehicle().step(ACTION)
    with pytest.raises(ValueError, match="render_mode must be one of human, rgb_array"):
        adapters.GymnasiumVehicle(render_mode="ansi")
