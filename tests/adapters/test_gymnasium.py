"""The vehicles as a gymnasium environment: the checker, seeds, the same episode as in
brax, and refusals.
"""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sfkd_jax import adapters
from sfkd_jax.driving.lanes import Lane, Obstacles

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


def test_a_seed_is_an_episode(made):
    observations, taken = episode(made, 11)
    again, other = episode(made, 11)[0], episode(made, 8)[0]
    np.testing.assert_array_equal(observations, again)
    assert np.abs(observations - other).max() > 1e-2
    info = taken[-1][4]
    assert info["lateral"] == pytest.approx(abs(float(observations[-1, 0])), abs=1e-3)


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
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.unwrapped.step(ACTION)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must have shape \(2,\), got \(1,\)"):
        env.unwrapped.step(ACTION[:1])
    first = env.render()
    for _ in range(5):
        env.step(ACTION)
    assert (first.shape, str(first.dtype)) == ((480, 640, 3), "uint8")
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 10
    assert np.any(first != env.render())
    again = [env.reset(seed=0), env.render()][1]
    np.testing.assert_array_equal(again, first)
    # gymnasium's own checker last: it closes what it has checked.
    check_env(env.unwrapped)


def test_in_a_lane_obstacles_appear_and_what_touches_them_has_ended():
    settings = {"duration": 9.0, "render_mode": "rgb_array"}
    env = gymnasium.make("sfkd_jax/Lane-v0", **settings)
    seen, _ = env.reset(seed=0)
    inside = env.unwrapped
    assert not seen["obstacles"].any()
    for _ in range(90):
        x, y = seen["obstacles"][0, :2]
        # Straight on, then towards the first one.
        action = inside.action([np.arctan2(y, x), 0.0]) if x else None
        seen, _, terminated, truncated, _ = inside.step(action)
        if terminated or truncated:
            break
    state, _, (lane, obstacles) = inside.situation()
    assert (type(lane), type(obstacles)) == (Lane, Obstacles)
    apart = np.linalg.norm(obstacles.position[:, 0] - state[:2], axis=1)
    place = seen["obstacles"][seen["obstacles"][:, 6] > 0]
    assert (terminated, truncated) == (True, False)
    assert np.linalg.norm(place[0, :2]) == pytest.approx(apart[0], abs=1e-3)
    assert apart[0] - 0.8 < 2.5
    np.testing.assert_array_equal(seen["lane"][:, 4:], 5.25)
    assert np.any(env.render() != [env.reset(seed=0), env.render()][1])
    check_env(inside)
    with pytest.raises(ValueError, match="needs a scenario with obstacles"):
        adapters.GymnasiumLane(scenario="s3")


def test_it_refuses_bad_settings_and_a_forked_process(monkeypatch):
    inside = adapters.GymnasiumVehicle(**SETTINGS)
    monkeypatch.setattr("os.getpid", lambda: 0)
    with pytest.raises(RuntimeError, match=r'vector_kwargs=\{"context": "spawn"\}'):
        inside.reset(seed=0)
    with pytest.raises(ValueError, match="render_mode must be rgb_array"):
        adapters.GymnasiumVehicle(render_mode="ansi")
