"""Whole episodes: repeatable, paired, and ordered as they must be; open-loop errors of
known models.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import at, driven, jit, model_and_params, same

from sfkd_jax import control, evaluation, models, plants, scenarios
from sfkd_jax.evaluation.metrics import SIGNALS
from sfkd_jax.types import Controller

PLANT = plants.kinematic()
HORIZON, STEPS = 12, 100
SENSORS = (0.02, 0.02, 0.005, 0.05)


@cache
def roads(count=2):
    family = scenarios.scenario(name="s3", duration=STEPS * 0.1, state_size=4, dt=0.1)
    return jit(jax.vmap(family))(jax.random.split(jax.random.key(0), count))


def one_episode(step, noise=SENSORS):
    """An episode with a planner over a one-step function."""
    task = control.path_tracking(
        models.physics(step),
        control.tracking_cost(dt=0.1),
        control.path_feedback(wheelbase=PLANT.wheelbase),
        dt=0.1,
        control_low=PLANT.control_low,
        control_high=PLANT.control_high,
    )
    controller = control.mppi(task, num_samples=96, horizon=HORIZON)
    return partial(
        evaluation.simulate,
        PLANT.step,
        controller,
        {},
        dt=0.1,
        horizon=HORIZON,
        observation_noise=noise,
        record={"expected": lambda info: info["predicted_states"][0, :2]},
    )


@cache
def driving(step, noise=SENSORS):
    """Several episodes, compiled once."""
    return jit(evaluation.over_episodes(one_episode(step, noise)))


def episodes(step, noise=SENSORS, seed=1):
    return driving(step, noise)(roads(), jax.random.split(jax.random.key(seed), 2))


def missed_by(batch):
    """Distance of the next position from where the plan had it [m]."""
    gap = batch.signals["expected"] - batch.states[..., 1:, :2]
    return np.linalg.norm(gap, axis=-1)


def test_an_episode_has_the_documented_shapes():
    one = at(episodes(PLANT.step), 0)
    assert one.states.shape == (STEPS + 1, 4)
    assert one.controls.shape == (STEPS, 2)
    assert one.assumed_envs.shape == (STEPS, 2)
    assert set(one.signals) == {*SIGNALS, "expected"}
    per_step = (one.lateral, one.progress, *(one.signals[name] for name in SIGNALS))
    assert all(leaf.shape == (STEPS,) for leaf in per_step)


def test_episodes_one_by_one_are_those_driven_at_once():
    at_once = jit(jax.vmap(one_episode(PLANT.step)))
    keys = jax.random.split(jax.random.key(1), 2)
    np.testing.assert_allclose(
        at_once(roads(), keys).states, episodes(PLANT.step).states, atol=1e-4
    )


def test_the_states_of_an_episode_are_the_plants():
    driven_episodes = episodes(PLANT.step)
    step = jit(jax.vmap(jax.vmap(PLANT.step)))
    expected = step(
        driven_episodes.states[:, :-1], driven_episodes.controls, roads().envs
    )
    np.testing.assert_allclose(driven_episodes.states[:, 1:], expected, atol=2e-5)


def test_lateral_deviation_and_progress_are_those_of_the_path():
    one, road = at(episodes(PLANT.step), 0), at(roads(), 0)
    points = np.asarray(
        jit(jax.vmap(scenarios.point_at, in_axes=(None, 0)))(road.path, one.progress)
    )
    normals = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])], axis=1)
    placed = points[:, :2] + np.asarray(one.lateral)[:, None] * normals
    np.testing.assert_allclose(placed, np.asarray(one.states)[1:, :2], atol=2e-3)
    assert np.all(np.diff(one.progress) > 0.5)


def test_the_oracle_drives_better_than_the_nominal_model():
    scores = [
        evaluation.score(episodes(step), np.asarray(roads().envs), dt=0.1)
        for step in (PLANT.step, PLANT.nominal)
    ]
    assert np.all(scores[0]["rmse_m"] < scores[1]["rmse_m"])
    assert np.all(scores[0]["rmse_m"] < 0.1)
    assert not np.any(scores[0]["departures"])


def test_without_sensor_noise_the_oracle_predicts_its_next_position_exactly():
    clean = episodes(PLANT.step, noise=())
    missed = missed_by(clean)
    np.testing.assert_allclose(missed, np.zeros((2, STEPS)), atol=1e-4)
    assert missed_by(episodes(PLANT.nominal)).max() > 1e-2


def test_the_same_key_makes_the_same_episode_and_another_key_another():
    first, again, other = (episodes(PLANT.step, seed=seed) for seed in (1, 1, 2))
    assert same(first, again, rtol=0, atol=0)
    assert not np.array_equal(first.controls, other.controls)


def recorder(gain, planner_draws):
    """A controller that answers with gain times what it observes, and keeps a random
    stream of its own.
    """

    def act(params, state, observation, env, reference):
        info = {"effective_samples": jnp.ones(()), "healthy": jnp.asarray(True)}
        info["predicted_states"] = jnp.tile(observation, (reference.shape[0], 1))
        for _ in range(planner_draws):
            state, _ = jax.random.split(state)
        return gain * observation[:2], state, info

    return Controller(lambda key: key, act)


def test_two_systems_meet_the_same_sensor_noise_whatever_they_do_with_their_own_key():
    """On a plant that stands still, what is observed is x_0 plus the noise."""
    road = at(roads(), 0)

    def observed(gain, draws):
        controller = recorder(gain, draws)
        still = partial(
            evaluation.simulate,
            lambda state, action, env: state,
            controller,
            {},
            dt=0.1,
            horizon=3,
        )
        episode = jit(partial(still, observation_noise=SENSORS))(
            road, jax.random.key(5)
        )
        return np.asarray(episode.controls) / gain

    first, second = observed(1.0, 0), observed(2.0, 3)
    np.testing.assert_allclose(first, second, rtol=1e-6)
    spread = first.std(axis=0)
    np.testing.assert_allclose(spread, SENSORS[:2], rtol=0.3)
    assert abs(np.mean(first[1:, 0] * first[:-1, 0])) < 0.3 * SENSORS[0] ** 2  # white


def test_the_noise_reaches_the_controller_and_not_the_truth():
    road = at(roads(), 0)
    still = partial(
        evaluation.simulate,
        lambda state, action, env: state,
        recorder(1.0, 0),
        {},
        dt=0.1,
        horizon=3,
    )
    episode = jit(partial(still, observation_noise=SENSORS))(road, jax.random.key(5))
    np.testing.assert_array_equal(
        episode.states, np.broadcast_to(road.initial_state, (STEPS + 1, 4))
    )
    quiet = jit(still)(road, jax.random.key(5))
    np.testing.assert_array_equal(quiet.controls, np.zeros((STEPS, 2)))


def test_no_key_is_used_twice():
    still = partial(
        evaluation.simulate,
        lambda state, action, env: state,
        recorder(1.0, 1),
        {},
        dt=0.1,
        horizon=3,
    )
    with jax.debug_key_reuse(True):
        jax.jit(partial(still, observation_noise=SENSORS))(
            at(roads(), 0), jax.random.key(0)
        )


def test_the_first_reference_starts_one_step_ahead():
    road = at(roads(), 0)
    window = jit(partial(evaluation.first_reference, horizon=4, dt=0.1))(road)
    assert window.shape == (4, 4)
    np.testing.assert_allclose(window[:, 0], [1.0, 2.0, 3.0, 4.0], atol=1e-3)
    np.testing.assert_array_equal(window[:, 3], np.full(4, 10.0))


def errors(name, data, horizon):
    model, params = model_and_params(name)
    return np.asarray(
        jit(partial(evaluation.open_loop, model, horizon=horizon))(params, data)
    )


def test_the_true_plant_predicts_without_error():
    np.testing.assert_allclose(
        errors("oracle", driven(), 12), np.zeros((12, 4)), atol=2e-5
    )


def test_a_wrong_model_errs_and_more_so_the_further_it_looks():
    result = errors("nominal", driven(), 12)
    assert np.all(result[:, :3] > 0)
    assert np.all(np.diff(result[:, 1]) > 0)
    assert result[-1, 1] > 5 * result[0, 1]


def test_errors_along_and_across_mean_the_same_on_every_heading():
    data = driven()
    turn = jnp.asarray([[0.0, -1.0], [1.0, 0.0]])
    states = (
        data.states.at[..., :2]
        .set(data.states[..., :2] @ turn.T)
        .at[..., 2]
        .add(jnp.pi / 2)
    )
    np.testing.assert_allclose(
        errors("nominal", data._replace(states=states), 6),
        errors("nominal", data, 6),
        atol=1e-4,
    )


def test_a_horizon_longer_than_the_trajectories_is_refused():
    model, params = model_and_params("oracle")
    with pytest.raises(
        ValueError, match="a horizon of 13 steps does not fit trajectories of 12 steps"
    ):
        evaluation.open_loop(model, params, driven(), horizon=13)
