"""MPPI: its convergence, its limits, and its compiled program."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from helpers import ENV_HIGH, ENV_LOW, jit, model_and_params, straight

from sfkd_jax import control, evaluation, models, plants, scenarios
from sfkd_jax.control.planners._noise import SamplingPlanner

PLANT = plants.kinematic()
LIMITS = {"control_low": PLANT.control_low, "control_high": PLANT.control_high}
WIDE = {"control_low": (-1e3, -1e3), "control_high": (1e3, 1e3)}
BOX = {"env_low": ENV_LOW, "env_high": ENV_HIGH}
COST = control.tracking_cost(dt=0.1)
FEEDBACK = control.path_feedback(wheelbase=PLANT.wheelbase)
HORIZON = 8
OFFSET = np.float32([0.0, 0.3, 0.0, 10.0])
ENV = np.float32([0.7, 3.0])
REFERENCE = np.asarray(straight(HORIZON))


def planner_task(model=None, law=FEEDBACK, limits=LIMITS):
    model = model or models.physics(PLANT.nominal)
    return control.path_tracking(model, COST, law, dt=0.1, **limits)


def planner(model, law=FEEDBACK, limits="actuators", **settings):
    limits = {"actuators": LIMITS, "wide": WIDE}[limits]
    return control.mppi(
        planner_task(model, law, limits),
        **{"num_samples": 64, "horizon": HORIZON, **BOX, **settings},
    )


@cache
def compiled(name="oracle", **settings):
    """A planner over a model by name: controller, params, compiled act."""
    model, params = model_and_params(name)
    controller = planner(model, **settings)
    return controller, params, jit(controller.act)


def act_once(
    name="oracle", seed=0, observation=OFFSET, env=ENV, state=None, **settings
):
    controller, params, act = compiled(name, **settings)
    state = controller.init(jax.random.key(seed)) if state is None else state
    return act(params, state, observation, env, REFERENCE)


def test_as_the_temperature_falls_the_plan_becomes_the_best_samples():
    """Every sample is rolled out again by hand; the planner must have chosen the
    cheapest.
    """
    _, state, info = act_once(
        law=control.no_feedback(), temperature=1e-4, limits="wide"
    )
    noise_key, _ = jax.random.split(jax.random.key(0))
    sampler = SamplingPlanner(planner_task(), num_samples=64, horizon=HORIZON)
    noise = sampler.draw(noise_key, jnp.asarray([0.02, 0.3]))
    plans = np.array(noise)
    plans[:, 0] = 0.0
    step = jit(jax.vmap(PLANT.step, in_axes=(0, 0, None)))
    states = np.broadcast_to(OFFSET, (64, 4))
    y, before, costs = np.full(64, 0.3), np.zeros(64), np.zeros(64)
    for k, controls in enumerate(plans):
        states = np.asarray(step(states, controls, ENV))
        course = (states[:, 1] - y) / (10.0 * 0.1 + 1e-3)
        rate = (controls[:, 0] - before) / 0.1
        stage = (
            200 * states[:, 1] ** 2
            + 20 * course**2
            + (states[:, 3] - 10.0) ** 2
            + 5 * rate**2
        )
        costs += (1 + (k == HORIZON - 1)) * (stage + 0.02 * controls[:, 1] ** 2)
        y, before = states[:, 1], controls[:, 0]
    best = int(np.argmin(costs))
    assert best != 0
    np.testing.assert_allclose(info["cost"], costs[best], rtol=1e-4)
    np.testing.assert_allclose(info["mean_cost"], costs[best], rtol=1e-4)
    np.testing.assert_allclose(info["effective_samples"], 1.0, rtol=1e-5)
    np.testing.assert_allclose(state.plan[:-1], plans[1:, best], atol=1e-6)
    np.testing.assert_allclose(state.previous, plans[0, best], atol=1e-6)


def test_a_reading_far_off_leaves_no_more_in_the_plan_than_the_actuators_can_do():
    """The law requests thousands of radians; a perturbation that compensates for them
    would persist.
    """
    controller, params, act = compiled(law=control.ModelLaw())
    span = np.subtract(PLANT.control_high, PLANT.control_low)
    for entry, value in ((0, 4e4), (1, -4e4), (3, 1e6)):
        state, seen = controller.init(jax.random.key(0)), OFFSET.copy()
        seen[entry] = value
        _, state, info = act(params, state, seen, ENV, REFERENCE)
        assert bool(info["healthy"])
        assert np.all(np.abs(state.plan) <= span * (1 + 1e-6))


def test_an_environment_outside_the_box_is_clamped_and_flagged():
    outside, edge = np.float32([1.5, -20.0]), np.float32([0.9, -8.0])
    strayed, clamped = act_once(env=outside), act_once(env=edge)
    assert not bool(strayed[2]["env_inside"])
    assert bool(clamped[2]["env_inside"])
    assert bool(strayed[2]["healthy"])
    np.testing.assert_array_equal(strayed[0], clamped[0])
    assert not np.array_equal(act_once()[1].controls, clamped[1].controls)


def test_a_nominal_model_of_a_nominal_plant_converges_to_the_path():
    """Without the law; around it the plan of zeros already does."""
    plain = {"law": control.no_feedback(), "noise_std": (0.06, 0.6)}
    controller = planner(models.physics(PLANT.nominal), num_samples=128, **plain)
    road = scenarios.Scenario(
        jnp.asarray(OFFSET),
        *[jnp.tile(jnp.asarray([[0.9, 0.0]]), (60, 1))] * 2,
        scenarios.path_from_curvature(jnp.zeros(300), spacing=0.5),
        jnp.asarray(10.0),
    )
    drive = partial(
        evaluation.simulate, PLANT.nominal, controller, {}, dt=0.1, horizon=HORIZON
    )
    episode = jit(drive)(road, jax.random.key(0))
    lateral = np.abs(np.asarray(episode.lateral))
    assert lateral[0] > 0.2
    assert np.all(lateral[-20:] < 0.05)
    assert np.all(lateral < 0.32)
    assert np.all(np.abs(np.asarray(episode.states)[-20:, 3] - 10.0) < 0.3)
    assert np.all(episode.signals["healthy"])


def test_no_key_is_used_twice():
    controller = planner(models.physics(PLANT.nominal), num_samples=4)

    def start(key):
        return controller.act(
            {}, controller.init(key), *map(jnp.asarray, (OFFSET, ENV, REFERENCE))
        )

    with jax.debug_key_reuse(True):
        jax.jit(start)(jax.random.key(0))
