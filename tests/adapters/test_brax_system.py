"""A brax system as a plant: brax's own motion, and known motions where it is changed."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from helpers import jit

from sfkd_jax import adapters
from sfkd_jax.types import BODY

PARAMETERS = ("gravity", "damping", "motor")
AS_IT_IS = jnp.ones(3)


@cache
def pendulum():
    return envs.get_environment("inverted_pendulum", backend="generalized")


@cache
def plant():
    return adapters.brax_plant(pendulum(), parameters=PARAMETERS)


@cache
def stepper():
    return jit(plant().step)


def step(body, control, env):
    """(cart [m], pole [rad], their rates) one sampling period later."""
    state = jnp.concatenate([jnp.zeros(3), jnp.asarray(body, dtype=float)])
    return stepper()(
        state, jnp.asarray([control], dtype=float), jnp.asarray(env, dtype=float)
    )[BODY]


def test_unmodified_it_moves_as_the_environment_itself():
    low, high = plant().control_low[0], plant().control_high[0]
    assert (low, high) == (-3.0, 3.0)
    actions = 0.2 * jax.random.uniform(jax.random.key(1), (15, 1), minval=-1.0)
    state, advance = jit(pendulum().reset)(jax.random.key(0)), jit(pendulum().step)
    ours = jnp.concatenate([jnp.zeros(3), state.obs])
    for action in actions:
        state = advance(state, action)
        ours = stepper()(ours, low + (high - low) * (action + 1.0) / 2.0, AS_IT_IS)
        np.testing.assert_allclose(ours[BODY], state.obs, atol=1e-4)
    assert np.abs(ours[BODY]).max() > 0.1


def test_without_gravity_a_pole_at_rest_rests_and_with_more_it_falls_faster():
    leaning = (0.0, 0.1, 0.0, 0.0)
    np.testing.assert_allclose(step(leaning, 0.0, (0.0, 1.0, 1.0)), leaning, atol=1e-6)
    rates = [float(step(leaning, 0.0, (factor, 0.0, 1.0))[3]) for factor in (1.0, 2.0)]
    assert rates[0] > 0.05
    assert rates[1] == pytest.approx(2.0 * rates[0], rel=0.05)


def test_a_motor_of_twice_the_force_is_twice_the_control():
    body = (0.1, -0.05, 0.2, 0.3)
    doubled = step(body, 0.4, (1.0, 1.0, 2.0))
    unchanged = step(body, 0.8, (1.0, 1.0, 1.0))
    np.testing.assert_allclose(doubled, unchanged, atol=1e-5)
    assert np.abs(doubled - step(body, 0.4, (1.0, 1.0, 1.0))).max() > 1e-2


@pytest.mark.parametrize(
    ("environment", "parameters", "message"),
    [
        (pendulum, ("colour",), "must be different ones of gravity, damping, motor"),
        (pendulum, ("gravity", "gravity"), "parameters must be different ones of"),
        (
            lambda: envs.get_environment("inverted_pendulum", backend="spring"),
            ("gravity",),
            'backend must be "generalized"',
        ),
        (adapters.BraxVehicle, ("gravity",), "BraxVehicle has no brax system to step"),
    ],
)
def test_what_is_no_such_system_is_refused_in_one_line(
    environment, parameters, message
):
    given = environment()
    with pytest.raises(ValueError, match=message) as refusal:
        adapters.brax_plant(given, parameters=parameters)
    assert "\n" not in str(refusal.value)
