"""MPPI: its convergence, its limits, and its compiled program."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from helpers import ENV_HIGH, ENV_LOW, jit, model_and_params, straight

from sfkd_jax import control, models
from sfkd_jax.driving import path_following, plants

PLANT = plants.kinematic()
LIMITS = {"control_low": PLANT.control_low, "control_high": PLANT.control_high}
BOX = {"env_low": ENV_LOW, "env_high": ENV_HIGH}
COST = path_following.tracking_cost(dt=0.1)
FEEDBACK = path_following.path_feedback(wheelbase=PLANT.wheelbase)
HORIZON = 8
OFFSET = np.float32([0.0, 0.3, 0.0, 10.0])
ENV = np.float32([0.7, 3.0])
REFERENCE = np.asarray(straight(HORIZON))


def planner(model, law=FEEDBACK, **settings):
    task = path_following.path_tracking(model, COST, law, dt=0.1, **LIMITS)
    return control.mppi(
        task, **{"num_samples": 64, "horizon": HORIZON, **BOX, **settings}
    )


@cache
def compiled(**settings):
    """A planner over the true plant: controller, params, compiled act."""
    model, params = model_and_params("oracle")
    controller = planner(model, **settings)
    return controller, params, jit(controller.act)


def act_once(env=ENV):
    controller, params, act = compiled()
    return act(params, controller.init(jax.random.key(0)), OFFSET, env, REFERENCE)


def test_a_reading_far_off_leaves_no_more_in_the_plan_than_the_actuators_can_do():
    """The law requests thousands of radians; a perturbation that compensates for them
    would persist.
    """
    controller, params, act = compiled(
        law=path_following.LinearFeedback(wheelbase=PLANT.wheelbase)
    )
    span = np.subtract(PLANT.control_high, PLANT.control_low)
    for entry, value in ((0, 4e4), (1, -4e4), (3, 1e6)):
        state, seen = controller.init(jax.random.key(0)), OFFSET.copy()
        seen[entry] = value
        _, state, info = act(params, state, seen, ENV, REFERENCE)
        assert bool(info.healthy)
        assert np.all(np.abs(state.plan) <= span * (1 + 1e-6))


def test_an_environment_outside_the_box_is_clamped_and_flagged():
    outside, edge = np.float32([1.5, -20.0]), np.float32([0.9, -8.0])
    strayed, clamped = act_once(env=outside), act_once(env=edge)
    assert not bool(strayed[2].env_inside)
    assert bool(clamped[2].env_inside)
    assert bool(strayed[2].healthy)
    np.testing.assert_array_equal(strayed[0], clamped[0])
    assert not np.array_equal(act_once()[1].controls, clamped[1].controls)


def test_no_key_is_used_twice():
    controller = planner(models.physics(PLANT.nominal), num_samples=4)

    def start(key):
        return controller.act(
            {}, controller.init(key), *map(jnp.asarray, (OFFSET, ENV, REFERENCE))
        )

    with jax.debug_key_reuse(True):
        jax.jit(start)(jax.random.key(0))
