"""Delay compensation."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit, straight

from sfkd_jax import control, models, plants

PLANT = plants.kinematic()
HORIZON, DELAY = 8, 3
ENV = jnp.asarray([0.7, 3.0])
START = jnp.asarray([0.0, 0.4, 0.1, 10.0])
MODEL = models.physics(PLANT.step)


def planner():
    limits = {"control_low": PLANT.control_low, "control_high": PLANT.control_high}
    law = control.path_feedback(wheelbase=PLANT.wheelbase)
    task = control.path_tracking(
        MODEL, control.tracking_cost(dt=0.1), law, dt=0.1, **limits
    )
    return control.mppi(task, num_samples=64, horizon=HORIZON)


@cache
def drive():
    """A plant that applies the control sent DELAY steps before; zero until then."""
    controller = control.delay_compensated(planner(), MODEL, delay=DELAY)

    @jit
    def run(key):
        def step(carry, _):
            state, pipe, inner = carry
            reference = straight(HORIZON).at[:, 0].add(state[0])
            action, inner, info = controller.act({}, inner, state, ENV, reference)
            pipe = jnp.concatenate([pipe, action[None]])
            state = PLANT.step(state, pipe[0], ENV)
            return (state, pipe[1:], inner), (state, action, info)

        carry = (START, jnp.zeros((DELAY, 2)), controller.init(key))
        return jax.lax.scan(step, carry, None, length=12)[1]

    return run(jax.random.key(0))


def test_the_state_it_plans_from_is_the_one_that_comes():
    states, _, info = drive()
    # At step k it foresees the state in which the control of step k begins to act.
    foreseen = info["arrival_state"][:-DELAY]
    np.testing.assert_allclose(foreseen, states[DELAY - 1 : -1], atol=1e-4)


def test_it_acts_as_the_planner_alone_would_from_that_state():
    _, actions, info = drive()
    alone = planner()
    reference = straight(HORIZON).at[:, 0].add(START[0])
    memory, arrival = alone.init(jax.random.key(0)), info["arrival_state"][0]
    expected, _, _ = jit(alone.act)({}, memory, arrival, ENV, reference)
    np.testing.assert_allclose(actions[0], expected, atol=1e-6)


def test_a_delay_below_one_period_is_refused():
    with pytest.raises(ValueError, match="delay must be in"):
        control.delay_compensated(planner(), MODEL, delay=0)
