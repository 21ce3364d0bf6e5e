"""MPPI: its convergence, its limits, and its compiled program."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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


def finite(tree):
    return all(
        np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree._replace(key=()))
    )


def with_entry(values, entry, value):
    changed = np.array(values)
    changed[entry] = value
    return changed


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


@pytest.mark.parametrize(
    ("std", "law"), [(1e3, FEEDBACK), (1e30, control.no_feedback())]
)
def test_controls_stay_inside_their_bounds_however_large_the_noise(std, law):
    """The stored perturbations are those after clipping: at most as large as the
    actuator box.
    """
    low, high = np.float32(PLANT.control_low), np.float32(PLANT.control_high)
    state = None
    for _ in range(3):
        action, state, info = act_once(
            noise_std=(std, std), law=law, temperature=1e9, state=state
        )
        assert np.all((low <= action) & (action <= high))
        assert np.all((low <= state.controls) & (state.controls <= high))
        assert np.all(np.abs(state.plan) <= 2 * (high - low))
        assert finite(state)
        assert bool(info["healthy"])


@pytest.mark.parametrize(("entry", "value"), [(0, np.nan), (3, np.inf)])
def test_a_broken_observation_continues_the_last_clean_plan_and_the_next_clean_step_recovers(
    entry, value
):
    _, clean, _ = act_once()
    action, held, info = act_once(
        state=clean, observation=with_entry(OFFSET, entry, value)
    )
    assert not bool(info["healthy"])
    np.testing.assert_array_equal(action, clean.controls[0])
    np.testing.assert_array_equal(held.plan[:-1], clean.plan[1:])
    np.testing.assert_array_equal(held.controls[:-1], clean.controls[1:])
    assert finite(held)
    action, recovered, info = act_once(state=held)
    assert bool(info["healthy"])
    assert finite(recovered)
    assert np.all(np.isfinite(action))


@pytest.mark.parametrize("broken", ["observation", "env", "reference"])
def test_what_is_not_finite_is_noticed_even_where_the_model_does_not_look(broken):
    """The nominal bicycle does not read e, and only the cost reads the last entry of
    the reference.
    """
    inputs = {"observation": OFFSET, "env": ENV, "reference": REFERENCE}
    inputs[broken] = with_entry(inputs[broken], -1, np.nan)
    controller, params, act = compiled("nominal")
    action, state, info = act(
        params, controller.init(jax.random.key(0)), *inputs.values()
    )
    assert not bool(info["healthy"])
    assert np.all(np.isfinite(action))
    assert finite(state)


@pytest.mark.parametrize("law", [control.ModelLaw()])
def test_a_reading_far_off_leaves_no_more_in_the_plan_than_the_actuators_can_do(law):
    """The law requests thousands of radians; a perturbation that compensates for them
    would persist.
    """
    controller, params, act = compiled(law=law)
    span = np.subtract(PLANT.control_high, PLANT.control_low)
    for entry, value in ((0, 1e5), (1, -1e5), (3, 1e6)):
        state = controller.init(jax.random.key(0))
        _, state, info = act(
            params, state, with_entry(OFFSET, entry, value), ENV, REFERENCE
        )
        assert bool(info["healthy"])
        assert np.all(np.abs(state.plan) <= span * (1 + 1e-6))


def breaks_where(condition):
    """The plant, returning NaN wherever a condition on the control holds."""

    def step(state, action, env):
        return jnp.where(condition(action), jnp.nan, PLANT.step(state, action, env))

    return models.physics(step)


@pytest.mark.parametrize("law", [FEEDBACK, control.no_feedback()])
def test_a_model_that_breaks_for_half_of_the_samples_still_gives_a_finite_plan(law):
    """Noise with correlation 1 keeps its sign: half of the samples steer left and
    become NaN.
    """
    on_path = jnp.asarray([0.0, 0.0, 0.0, 10.0])
    model = breaks_where(lambda action: action[0] > 0)
    settings = {"law": law, "noise_correlation": 1.0, "temperature": 1e9}
    controller = planner(model, **settings)
    action, state, info = jit(controller.act)(
        {}, controller.init(jax.random.key(0)), on_path, ENV, REFERENCE
    )
    assert bool(info["healthy"])
    assert (
        20 < float(info["effective_samples"]) < 44
    )  # of 64: equal weights on the rest
    assert finite(state)
    assert float(action[0]) < 0
    assert np.all(np.isfinite(info["predicted_states"]))


def test_an_environment_outside_the_box_is_clamped_and_flagged():
    outside, edge = np.float32([1.5, -20.0]), np.float32([0.9, -8.0])
    strayed, clamped = act_once(env=outside), act_once(env=edge)
    assert not bool(strayed[2]["env_inside"])
    assert bool(clamped[2]["env_inside"])
    assert bool(strayed[2]["healthy"])
    np.testing.assert_array_equal(strayed[0], clamped[0])
    assert not np.array_equal(act_once()[1].controls, clamped[1].controls)


@pytest.mark.parametrize("law", ["feedback", "plain"])
def test_a_nominal_model_of_a_nominal_plant_converges_to_the_path(law):
    model = models.physics(PLANT.nominal)
    plain = {"law": control.no_feedback(), "noise_std": (0.06, 0.6)}
    controller = planner(model, num_samples=128, **({} if law == "feedback" else plain))
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
    assert np.all(lateral[-20:] < (0.03 if law == "feedback" else 0.05))
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
