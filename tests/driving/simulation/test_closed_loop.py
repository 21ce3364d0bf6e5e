"""Whole episodes: repeatable, paired, and ordered as they must be; what sensors make of
the environment, and forces that nobody measures.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import at, jit, same

from sfkd_jax import control, models
from sfkd_jax.driving import path_following, paths, plants, scenarios, simulation
from sfkd_jax.driving.simulation import _loops, disturbed_environment
from sfkd_jax.driving.simulation.metrics import SIGNALS
from sfkd_jax.info import ControllerInfo, PlanInfo
from sfkd_jax.latency import Latency
from sfkd_jax.types import Controller

PLANT, DYNAMIC = plants.kinematic(), plants.dynamic()
DT, HORIZON, STEPS = 0.1, 12, 100
SENSORS = (0.02, 0.02, 0.005, 0.05)


@cache
def roads():
    family = scenarios.scenario(name="s3", duration=STEPS * DT, state_size=4, dt=DT)
    return jit(jax.vmap(family))(jax.random.split(jax.random.key(0), 2))


@cache
def program(step):
    """(noise of the sensors, roads, keys) -> episodes planned with a step function."""
    task = path_following.path_tracking(
        models.physics(step),
        path_following.tracking_cost(dt=DT),
        path_following.path_feedback(wheelbase=PLANT.wheelbase),
        dt=DT,
        control_low=PLANT.control_low,
        control_high=PLANT.control_high,
    )
    planner = control.mppi(task, num_samples=96, horizon=HORIZON)

    def one(noise, road, key):
        return simulation.simulate(
            PLANT.step,
            planner,
            {},
            road,
            key,
            dt=DT,
            horizon=HORIZON,
            observation_noise=tuple(noise),
            record={"expected": lambda info: info.plan.states[0, :2]},
        )

    return jit(jax.vmap(one, in_axes=(None, 0, 0)))


@cache
def episodes(step, noise=SENSORS, seed=1):
    keys = jax.random.split(jax.random.key(seed), 2)
    return program(step)(jnp.asarray(noise), roads(), keys)


def missed_by(batch):
    """Distance of the next position from where the plan had it [m]."""
    gap = batch.signals["expected"] - batch.states[..., 1:, :2]
    return np.linalg.norm(gap, axis=-1)


def test_an_episode_has_the_documented_shapes_and_the_states_of_the_plant():
    batch, one = episodes(PLANT.step), at(episodes(PLANT.step), 0)
    assert one.states.shape == (STEPS + 1, 4)
    assert one.controls.shape == (STEPS, 2)
    assert set(one.signals) == {*SIGNALS, "expected"}
    per_step = (one.lateral, one.progress, *(one.signals[name] for name in SIGNALS))
    assert all(leaf.shape == (STEPS,) for leaf in per_step)
    step = jit(jax.vmap(jax.vmap(PLANT.step)))
    expected = step(batch.states[:, :-1], batch.controls, roads().envs)
    np.testing.assert_allclose(batch.states[:, 1:], expected, atol=2e-5)


def test_lateral_deviation_and_progress_are_those_of_the_path():
    one, road = at(episodes(PLANT.step), 0), at(roads(), 0)
    points = np.asarray(
        jit(jax.vmap(paths.point_at, in_axes=(None, 0)))(road.path, one.progress)
    )
    normals = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])], axis=1)
    placed = points[:, :2] + np.asarray(one.lateral)[:, None] * normals
    np.testing.assert_allclose(placed, np.asarray(one.states)[1:, :2], atol=2e-3)
    assert np.all(np.diff(one.progress) > 0.5)


def test_the_oracle_drives_better_than_the_nominal_model_and_predicts_exactly():
    scores = [
        simulation.score(episodes(step), dt=DT, size=PLANT.size)
        for step in (PLANT.step, PLANT.nominal)
    ]
    assert np.all(scores[0]["rmse_m"] < scores[1]["rmse_m"])
    assert np.all(scores[0]["rmse_m"] < 0.1)
    assert not np.any(scores[0]["departures"])
    assert missed_by(episodes(PLANT.step, noise=(0.0, 0.0, 0.0, 0.0))).max() < 1e-4
    assert missed_by(episodes(PLANT.nominal)).max() > 1e-2


def test_the_same_key_makes_the_same_episode_and_another_key_another():
    again = episodes.__wrapped__(PLANT.step)
    assert same(episodes(PLANT.step), again, rtol=0, atol=0)
    assert not np.array_equal(again.controls, episodes(PLANT.step, seed=2).controls)


def still(gain=1.0, planner_draws=1):
    """An episode of a plant that stands, whose controls are gain times what is
    observed: x_0 plus the noise.
    """

    def act(params, state, observation, env, reference):
        info = ControllerInfo(plan=PlanInfo(effective_samples=env[1]))
        for _ in range(planner_draws):
            state, _ = jax.random.split(state)
        return gain * observation[:2], state, info

    return partial(
        simulation.simulate,
        lambda state, action, env: state,
        Controller(lambda key: key, act),
        {},
        dt=DT,
        horizon=3,
    )


def test_two_systems_meet_the_same_sensor_noise_whatever_they_do_with_their_own_key():
    road, key = at(roads(), 0), jax.random.key(5)
    noisy = {"observation_noise": SENSORS}
    first = jit(partial(still(1.0, 0), **noisy))(road, key)
    second = jit(partial(still(2.0, 3), **noisy))(road, key)
    np.testing.assert_allclose(first.controls, second.controls / 2.0, rtol=1e-6)
    seen = np.asarray(first.controls)
    np.testing.assert_allclose(seen.std(axis=0), SENSORS[:2], rtol=0.3)
    assert abs(np.mean(seen[1:, 0] * seen[:-1, 0])) < 0.3 * SENSORS[0] ** 2  # white
    # The noise reaches the controller and not the truth.
    truth = np.broadcast_to(road.initial_state, (STEPS + 1, 4))
    np.testing.assert_array_equal(first.states, truth)
    quiet = jit(still())(road, key)
    np.testing.assert_array_equal(quiet.controls, np.zeros((STEPS, 2)))


def test_late_sensors_show_the_past_and_late_commands_act_later():
    """A car that keeps its speed is seen where it was, beside the reference of there."""
    road, key = at(roads(), 0), jax.random.key(5)
    speed = 8.0

    def plant(state, command, env):
        # What acted is written where nothing else is.
        return state.at[0].add(DT * speed).at[3].set(command[0])

    def act(params, state, observation, env, reference):
        info = ControllerInfo(planner=(observation, reference[0]))
        return jnp.stack([state, 0.0 * state]), state + 1.0, info

    drive = partial(
        simulation.simulate,
        plant,
        Controller(lambda key: jnp.zeros(()), act),
        {},
        dt=DT,
        horizon=3,
        record={"seen": lambda info: info.planner},
    )
    prompt = jit(drive)(road, key)
    late = jit(partial(drive, latency=Latency((2.0 * DT,), (1.5 * DT,))))(road, key)
    seen, first = (np.asarray(part) for part in late.signals["seen"])
    truth, ahead = (np.asarray(part) for part in prompt.signals["seen"])
    np.testing.assert_allclose(seen[2:, 0], truth[:-2, 0], atol=1e-4)
    # Before the first call it drove on at the speed of its start.
    before = truth[0, 0] - DT * truth[0, 3] * np.asarray([2.0, 1.0])
    np.testing.assert_allclose(seen[:2, 0], before, atol=1e-4)
    np.testing.assert_allclose(first[2:], ahead[:-2], atol=0.05)
    # Command k is the number k: half of k − 2 and half of k − 1 act in period k.
    acted = np.asarray(late.states)[1:, 3]
    np.testing.assert_allclose(acted[2:], np.arange(2, len(acted)) - 1.5, atol=1e-4)


def test_no_key_is_used_twice_and_pushes_have_a_stream_of_their_own():
    road, key = at(roads(), 0), jax.random.key(4)
    stream = jax.random.fold_in(key, _loops.FORCE_STREAM)
    streams = [jax.random.key_data(k) for k in (stream, *jax.random.split(key))]
    assert len({tuple(np.asarray(data)) for data in streams}) == 3
    with jax.debug_key_reuse(True):
        envs = disturbed_environment(PLANT, road.envs, key, largest=100.0)
        run = jax.jit(partial(still(), observation_noise=SENSORS))
        run(road._replace(envs=envs), key)


# --- sensors of the environment ------------------------------------------------------

ENVS = jnp.stack([jnp.linspace(0.9, 0.3, 300), jnp.linspace(-8.0, 8.0, 300)], axis=1)
OBSERVE = partial(simulation.observed_environment, ENVS, dt=DT)


def test_a_perfect_sensor_tells_the_truth_and_another_delays_or_biases_it(key):
    """To the last bit; a delay repeats the first value; friction stays positive."""
    np.testing.assert_array_equal(OBSERVE(key), ENVS)
    for steps in (1, 40):
        observed = OBSERVE(key, delay_s=0.1 * steps)
        expected = jnp.concatenate([jnp.tile(ENVS[:1], (steps, 1)), ENVS[:-steps]])
        np.testing.assert_array_equal(observed, expected)
    biased = OBSERVE(key, bias=(0.1, -2.0))
    np.testing.assert_allclose(biased, ENVS + jnp.asarray([0.1, -2.0]), rtol=1e-6)
    assert float(OBSERVE(key, bias=(-0.9, 0.0))[:, 0].min()) == pytest.approx(0.05)


def test_noise_has_the_configured_spread_and_differs_between_episodes(key):
    observe = jax.vmap(lambda episode: OBSERVE(episode, noise=(0.02, 1.0)))
    errors = observe(jax.random.split(key, 200)) - ENVS
    np.testing.assert_allclose(errors.std(axis=(0, 1)), [0.02, 1.0], rtol=0.02)
    np.testing.assert_allclose(errors.mean(axis=(0, 1)), [0.0, 0.0], atol=0.015)
    assert not np.allclose(errors[0], errors[1])


# --- forces that nobody measures -----------------------------------------------------


@pytest.mark.parametrize("plant", [PLANT, DYNAMIC], ids=lambda plant: plant.name)
@pytest.mark.parametrize(
    ("wind", "force"), [(0.0, 250.0), (-8.0, 1000.0), (3.0, -900.0)]
)
def test_a_push_is_the_wind_that_pushes_as_hard(plant, wind, force):
    felt = plants.equivalent_wind(
        jnp.asarray(wind), jnp.asarray(force), wind_force=plant.wind_force
    )
    pushed = plant.wind_force * felt * abs(felt)
    expected = plant.wind_force * wind * abs(wind) + force
    np.testing.assert_allclose(pushed, expected, rtol=1e-5, atol=1e-3)


def test_a_push_moves_the_car_and_none_changes_no_bit():
    keys = jax.random.split(jax.random.key(1), 2)

    def pushed(largest):
        push = jax.vmap(partial(disturbed_environment, PLANT, largest=largest))
        disturbed = roads()._replace(envs=push(roads().envs, keys))
        return program(PLANT.step)(jnp.asarray(SENSORS), disturbed, keys)

    alone, hard = episodes(PLANT.step), pushed(800.0)
    assert same(alone, pushed(0.0), rtol=0, atol=0)
    assert float(jnp.max(jnp.abs(hard.lateral - alone.lateral))) > 0.02


def test_pushes_are_redrawn_every_second_evenly_within_their_bound_and_grow_with_it():
    pushes = partial(scenarios.random_side_forces, jax.random.key(1), dt=DT)
    force = np.asarray(pushes(steps=20005, largest=300.0))
    assert len(force) == 20005
    levels = force[:20000].reshape(-1, 10)
    assert np.all(levels == levels[:, :1])
    assert len(np.unique(levels[:, 0])) == 2000
    assert np.max(np.abs(force)) <= 300.0
    quantiles = np.quantile(force, [0.1, 0.5, 0.9])
    np.testing.assert_allclose(quantiles, [-240.0, 0.0, 240.0], atol=20.0)
    np.testing.assert_allclose(pushes(steps=20005, largest=600.0), 2 * force, rtol=1e-6)
