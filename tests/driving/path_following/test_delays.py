"""The delay of the commands that fits what a vehicle does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.driving.path_following import delay_estimator
from sfkd_jax.latency import CommandDelay

NOISE = 0.02
DELAY = CommandDelay((0.0, 0.0), tolerance=2.0)
ESTIMATOR = delay_estimator([0.0], [[NOISE] * 4], DELAY.hypotheses)


@jit
def told(later, commands, noise, used):
    """Delays that are believed of x⁺ = x + command, whose commands act later."""

    def step(carry, now):
        state, x, sent = carry
        command, (disturbance, error), seen = now
        state = ESTIMATOR.update(state, x + error, seen)

        def moved(x, later):
            return x + jnp.append(DELAY.acting(sent, command, later=later), 0.0)

        expected = jax.vmap(moved)(state.estimate, jnp.asarray(ESTIMATOR.later))
        state = state._replace(expected=expected)
        after = moved(x, later) + disturbance
        sent = jnp.concatenate([sent[1:], command[None]])
        return (state, after, sent), ESTIMATOR.delay(state)

    start = ESTIMATOR.init(), jnp.zeros(3), jnp.zeros((DELAY.steps, 2))
    return jax.lax.scan(step, start, (commands, noise, used))[1]


def driven(later, excitation=0.05, steps=300, used=None):
    random = np.random.default_rng(5)
    commands = excitation * random.normal(size=(steps, 2))
    noise = NOISE / 2 * random.normal(size=(steps, 2, 3))
    used = np.ones(steps, bool) if used is None else used
    return np.asarray(told(later, commands, noise, used))


@pytest.mark.parametrize("later", DELAY.hypotheses)
def test_the_delay_of_the_commands_is_found(later):
    assert (driven(later)[50:] == later).all()


def test_a_delay_that_no_command_shows_is_not_found():
    assert (driven(2.0, excitation=0.0) == 0.0).all()


def test_it_is_found_although_most_measurements_are_lost():
    used = np.random.default_rng(1).uniform(size=300) < 0.4
    assert (driven(1.0, used=used)[150:] == 1.0).all()


@pytest.mark.parametrize("hostile", [np.nan, np.inf, -np.inf, 1e30])
def test_a_hostile_measurement_decides_nothing(hostile):
    state = ESTIMATOR.init()
    state = state._replace(expected=jnp.zeros_like(state.expected))
    after = ESTIMATOR.update(state, jnp.full(3, hostile), jnp.asarray(True))
    assert after.best == state.best
    assert np.ptp(np.asarray(after.fit)) == 0.0
