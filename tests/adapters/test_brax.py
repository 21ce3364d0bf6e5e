"""The vehicles as a brax environment: its own physics, brax's wrappers, the end of
episodes, and refusals.
"""

import inspect
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from brax.envs.wrappers.training import EvalWrapper, wrap
from helpers import at, jit, same

from sfkd_jax import adapters, assembly, geometry
from sfkd_jax.driving import path_following, plants, simulation
from sfkd_jax.info import ControllerInfo
from sfkd_jax.types import Controller

STEPS = 25
CALM = {"scenario": "s1", "duration": STEPS * 0.1}
GUSTS = {"vehicle": "dynamic", "scenario": "s2", "duration": 6.0}
envs.register_environment("sfkd_vehicle", adapters.BraxVehicle)


@cache
def env(name="kinematic"):
    """The kinematic car on calm roads of 25 steps, and the dynamic one in gusts."""
    return envs.get_environment(
        "sfkd_vehicle", **{"kinematic": CALM, "dynamic": GUSTS}[name]
    )


@cache
def compiled(name="kinematic"):
    """reset, and the states of an episode under a list of actions."""
    inner = env(name)

    def drive(state, actions):
        def step(state, action):
            after = inner.step(state, action)
            return after, after

        return jax.lax.scan(step, state, actions)[1]

    return jit(inner.reset), jit(drive)


def driven(actions, name="kinematic"):
    reset, drive = compiled(name)
    start = reset(jax.random.key(0))
    return start, drive(start, jnp.asarray(actions))


def gentle(steps=STEPS, seed=3):
    """Random actions about going on straight at the same speed."""
    spread = jnp.asarray([0.1, 0.3])
    return jnp.asarray([0.0, 0.34]) + spread * jax.random.uniform(
        jax.random.key(seed), (steps, 2), minval=-1.0
    )


def test_a_controller_drives_it_as_the_test_track_has_it_driven():
    """The controls of a simulated episode, as actions: the same motion, and the same
    questions to the controller.
    """
    plant, law = plants.kinematic(), assembly.build_driver(plants.kinematic())

    def act(params, state, observation, env, reference):
        return law(observation, reference), state, ControllerInfo()

    start = compiled()[0](jax.random.key(0))
    controller, given = Controller(lambda key: (), act), {"dt": plant.dt, "horizon": 10}
    run = jit(partial(simulation.simulate, plant.step, controller, {}, **given))
    episode = run(start.info["road"], jax.random.key(0))
    _, after = driven(jax.vmap(env().action)(episode.controls))
    moments = after.pipeline_state
    np.testing.assert_allclose(moments.state, episode.states[1:], atol=2e-4)
    np.testing.assert_allclose(moments.lateral, episode.lateral, atol=2e-4)
    answers = jit(jax.vmap(lambda state: law(*env().situation(state)[::2])))(after)
    np.testing.assert_allclose(answers[:-1], episode.controls[1:], atol=1e-4)


def test_the_observation_has_the_documented_order():
    start, after = driven(gentle(), "dynamic")
    last, road = at(after, -1), start.info["road"]

    @jit
    def observed(state):
        pose, environment, reference = env("dynamic").situation(state)
        rows = state.obs[10:].reshape(10, 4)
        back = jax.vmap(geometry.compose, in_axes=(None, 0))(pose[:3], rows[:, :3])
        return environment, reference, jnp.concatenate([back, rows[:, 3:]], axis=1)

    environment, reference, seen = observed(last)
    moment = last.pipeline_state
    np.testing.assert_allclose(last.obs[0], moment.lateral, atol=1e-6)
    np.testing.assert_allclose(last.obs[2:6], moment.state[3:], atol=1e-6)
    np.testing.assert_allclose(last.obs[6:8], gentle()[-1], atol=1e-5)
    np.testing.assert_allclose(last.obs[8:10], environment)
    np.testing.assert_allclose(environment, road.envs[STEPS])
    np.testing.assert_allclose(seen, reference, atol=2e-5)
    np.testing.assert_allclose(reference[:, 3], road.speed)


def test_the_reward_is_minus_the_cost_of_lateral_speed_and_steering_rate_as_the_planner_weighs_them():
    start, after = driven(gentle())
    moments = jax.tree.map(np.asarray, after.pipeline_state)
    steering = np.concatenate(
        [start.pipeline_state.control[None, :1], moments.control[:, :1]]
    )[:, 0]
    parts = (moments.lateral, moments.state[:, 3] - 10.0, np.diff(steering) / env().dt)
    names = ("lateral", "speed", "steering_rate")
    planner = inspect.signature(path_following.tracking_cost).parameters
    weights = [planner[name].default for name in names]
    cost = sum(weight * part**2 for weight, part in zip(weights, parts, strict=True))
    np.testing.assert_allclose(after.reward, -cost, rtol=1e-4)
    for name, part in zip(
        ("lateral", "speed_error", "steering_rate"), parts, strict=True
    ):
        np.testing.assert_allclose(after.metrics[name], np.abs(part), atol=1e-4)


def test_leaving_the_lane_ends_an_episode_and_costs_what_it_says():
    hard = jnp.tile(jnp.asarray([1.0, 0.34]), (STEPS, 1))
    _, after = driven(hard)
    outside = np.abs(np.asarray(after.pipeline_state.lateral)) > 3.0
    first = int(np.argmax(outside))
    assert 5 < first < STEPS
    assert after.done[: first + 1].tolist() == [0.0] * first + [1.0]
    assert after.info["time_out"][first] == 0.0
    moments = at(after.pipeline_state, first)
    staying = 200.0 * moments.lateral**2 + (moments.state[3] - 10.0) ** 2
    np.testing.assert_allclose(after.reward[first], -staying - 2e4, rtol=1e-5)


def test_what_is_not_finite_ends_an_episode_and_does_not_get_out():
    actions = gentle().at[3].set(jnp.nan)
    _, after = driven(actions)
    assert after.done[:4].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert all(
        np.all(np.isfinite(leaf))
        for leaf in jax.tree.leaves((after.obs, after.reward, after.pipeline_state))
    )


def test_every_key_is_another_road_whose_end_is_a_time_out_and_no_failure():
    start, after = driven(gentle())
    other, raw = (compiled()[0](k) for k in (jax.random.key(2), jax.random.PRNGKey(0)))
    assert same(start, raw, rtol=0, atol=0)
    paths = [np.asarray(one.info["road"].path.points) for one in (start, other)]
    assert np.abs(paths[0] - paths[1]).max() > 1.0
    last = [0.0] * (STEPS - 1) + [1.0]
    assert after.done.tolist() == after.info["time_out"].tolist() == last
    assert np.all(np.asarray(after.reward) > -2e4)


def test_driving_beyond_the_path_is_a_time_out_and_facing_backwards_is_not():
    reset, drive = compiled()
    start = reset(jax.random.key(0))
    moment, path = start.pipeline_state, start.info["road"].path
    length = float((path.points.shape[0] - 1) * path.spacing)
    near = path.points[-11]
    placed = moment.state.at[:3].set(near[:3])
    placed = moment._replace(state=placed, progress=length - 5.0)
    after = drive(start.replace(pipeline_state=placed), gentle())
    first = int(np.argmax(after.done))
    assert 3 <= first <= 7
    assert after.info["time_out"][first] == 1.0
    turned = moment.state.at[2].add(jnp.pi)
    after = drive(start.replace(pipeline_state=moment._replace(state=turned)), gentle())
    assert (after.done[0], after.info["time_out"][0]) == (1.0, 0.0)
    assert after.reward[0] < -2e4


def test_under_brax_wrappers_episodes_end_in_time_and_begin_again():
    """A batch of three with raw keys, episodes of 10 periods, two a step."""
    outer = EvalWrapper(wrap(env(), episode_length=10, action_repeat=2))

    def run(keys, actions):
        start = outer.reset(keys)

        def step(state, action):
            after = outer.step(state, jnp.tile(action, (3, 1)))
            return after, after

        return start, jax.lax.scan(step, start, actions)[1]

    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    start, after = jit(run)(keys, gentle(24))
    ends = [4, 9, 14, 19]
    assert after.done.shape == (24, 3)
    for car in range(3):
        assert np.flatnonzero(after.done[:, car]).tolist() == ends
    np.testing.assert_array_equal(after.info["truncation"], after.done)
    np.testing.assert_array_equal(after.obs[4], start.obs)
    np.testing.assert_array_equal(after.pipeline_state.count[4:6, 0], [0, 2])
    paths = np.asarray(start.info["road"].path.points)
    assert np.abs(np.diff(paths, axis=0)).max(axis=(1, 2)).min() > 1.0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"vehicle": "boat"}, "unknown vehicle 'boat'; choose one of dynamic"),
        ({"scenario": "s9"}, "unknown scenario 's9'"),
        ({"duration": 0.05}, "duration must be at least a step"),
        ({"preview": 0}, r"preview must be in \[1, inf\), got 0"),
        ({"lane": 0.0}, r"lane must be in \(0, inf\)"),
        ({"leaving": float("nan")}, r"leaving must be in \[0, inf\), got nan"),
        (
            {"vehicle": "dynamic", "scenario": "family"},
            r"the scenario starts in a state of shape \(4,\), 'dynamic'",
        ),
    ],
)
def test_bad_settings_are_refused_in_one_line(settings, message):
    if settings.get("scenario") == "family":
        family = assembly.build_scenario(
            {"name": "s1"}, plants.kinematic(), duration=2.0
        )
        settings = settings | {"scenario": family}
    with pytest.raises(ValueError, match=message) as refusal:
        envs.get_environment("sfkd_vehicle", **settings)
    assert "\n" not in str(refusal.value)


def test_a_plant_and_a_family_of_ones_own():
    plant = plants.with_speed_loop(plants.dynamic(dt=0.05))
    family = assembly.build_scenario({"name": "s1"}, plant, duration=1.0)
    task = adapters.BraxVehicle(vehicle=plant, scenario=family).task
    assert (task.plant.dt, task.observation_size) == (0.05, 50)
    control = jnp.asarray([0.1, 12.0])
    np.testing.assert_allclose(task.control(task.action(control)), control, atol=1e-5)
    np.testing.assert_allclose(task.control(jnp.asarray([-9.0, 9.0])), [-0.5, 25.0])
