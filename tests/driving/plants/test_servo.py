"""A steering servo: its exact step response, and the vehicle that it steers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax import assembly
from sfkd_jax.driving import plants

ENV = jnp.asarray([0.8, 2.0])
STATE = jnp.asarray([0.0, 0.0, 0.1, 9.0])


def shown():
    """A vehicle whose second position is the steering that acted."""

    def step(state, control, env):
        return state.at[1].set(control[0])

    return plants.own(step=step, control_low=(-0.5, -6.0), control_high=(0.5, 3.0))


def responses(lag, rate, periods=6, command=0.2):
    """Angles after every period, and mean angles over it."""
    vehicle = plants.with_servo(shown(), lag=lag, rate=rate)
    state = jnp.append(STATE, 0.0)
    angles, means = [], []
    for _ in range(periods):
        state = vehicle.step(state, jnp.asarray([command, 0.0]), ENV)
        angles.append(float(state[4]))
        means.append(float(state[1]))
    return np.asarray(angles), np.asarray(means)


def test_without_a_limit_it_approaches_exponentially():
    lag = 0.15
    angles, means = responses(lag, np.inf)
    ends = 0.1 * np.arange(1, 7)
    np.testing.assert_allclose(angles, 0.2 * (1.0 - np.exp(-ends / lag)), rtol=1e-4)
    # ∫ of that over a period.
    decay = lag / 0.1 * (np.exp(-(ends - 0.1) / lag) - np.exp(-ends / lag))
    np.testing.assert_allclose(means, 0.2 * (1.0 - decay), rtol=2e-3)


def test_a_limited_servo_turns_at_its_rate():
    angles, means = responses(0.02, 0.4)
    np.testing.assert_allclose(angles[:4], [0.04, 0.08, 0.12, 0.16], rtol=1e-3)
    np.testing.assert_allclose(means[:4], [0.02, 0.06, 0.1, 0.14], rtol=1e-3)


def test_a_quick_servo_is_none():
    plain = plants.kinematic()
    servo = plants.with_servo(plain, lag=1e-4)
    control = jnp.asarray([0.15, 0.5])
    after = servo.step(jnp.append(STATE, 0.15), control, ENV)
    np.testing.assert_allclose(after[:4], plain.step(STATE, control, ENV), atol=1e-5)
    assert servo.state_names == (*plain.state_names, "steering")
    assert servo.sensor_noise[-1] > 0.0


def test_the_nominal_model_has_the_servo_too():
    servo = plants.with_servo(plants.kinematic(), lag=0.1, rate=0.4)
    state = jnp.append(STATE, 0.05)
    rates = servo.nominal_derivative(state, jnp.asarray([0.3, 0.0]), ENV)
    assert float(rates[4]) == pytest.approx(0.4)
    plain = plants.kinematic().nominal_derivative(STATE, jnp.asarray([0.05, 0.0]), ENV)
    np.testing.assert_allclose(rates[:4], plain, rtol=1e-6)


def test_it_is_a_setting_of_a_vehicle_that_has_none():
    settings = {"servo_lag": 0.1, "servo_rate": 0.4}
    vehicle = assembly.build_vehicle({"name": "kinematic"} | settings)
    assert vehicle.state_names[-1] == "steering"
    after = jax.jit(vehicle.step)(jnp.append(STATE, 0.0), jnp.asarray([0.5, 0.0]), ENV)
    assert float(after[4]) == pytest.approx(0.04, rel=1e-3)
    with pytest.raises(ValueError, match="has a state steering already"):
        assembly.build_vehicle({"name": "dynamic"} | settings)
