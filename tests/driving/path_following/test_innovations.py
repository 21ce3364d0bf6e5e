"""The delay that fits the innovations of a vehicle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.driving.path_following import WINDOWS, innovation_test
from sfkd_jax.latency import CommandDelay

NOISE = 0.02
DELAY = CommandDelay((0.0, 0.0), tolerance=2.0)
TEST = innovation_test(
    levels=[0.0],
    deviation=[[NOISE] * 4],
    threshold=[[6.0 * np.sqrt(w)] * 4 for w in WINDOWS],
    later=DELAY.hypotheses,
)


def told(later, excitation=0.1, steps=300):
    """State of the test of x⁺ = x + mean command, whose commands act later."""
    random = np.random.default_rng(5)
    commands = excitation * random.normal(size=(steps, 2))
    noise = NOISE * random.normal(size=(steps, 3))

    def step(carry, now):
        state, x, sent = carry
        command, disturbance = now
        state, statistic = TEST.update(state, x, jnp.ones(3, bool))

        def after(later):
            acting = DELAY.acting(sent, command, later=later)
            return x + jnp.append(acting, 0.0)

        ahead = jax.vmap(after)(jnp.asarray(TEST.later))
        expected = jnp.concatenate([ahead, ahead[:, 1:2]], axis=1)
        state = state._replace(expected=expected, inside=jnp.ones(len(ahead), bool))
        x = after(later) + disturbance
        sent = jnp.concatenate([sent[1:], command[None]])
        believed = jnp.asarray(TEST.later)[state.delay]
        return (state, x, sent), (believed, state.alarm, statistic)

    start = TEST.init(), jnp.zeros(3), jnp.zeros((DELAY.steps, 2))
    inputs = jnp.asarray(commands), jnp.asarray(noise)
    return jax.tree.map(np.asarray, jax.lax.scan(step, start, inputs)[1])


@pytest.mark.parametrize("later", DELAY.hypotheses)
def test_the_delay_of_the_commands_is_found_and_raises_no_alarm_then(later):
    believed, alarm, _ = told(later)
    assert (believed[30:] == later).all()
    assert not alarm[60:].any()


def test_a_delay_that_no_command_shows_is_not_found():
    believed, alarm, _ = told(2.0, excitation=0.0)
    assert (believed == 0.0).all()
    assert not alarm.any()


def test_what_is_not_measured_says_nothing_about_the_delay():
    state = TEST.init()
    state = state._replace(expected=jnp.ones_like(state.expected))
    for hostile in (jnp.nan, jnp.inf, 1e30):
        after, _ = TEST.update(state, jnp.full(3, hostile), jnp.ones(3, bool))
        assert after.delay == state.delay
        np.testing.assert_array_equal(after.fit, state.fit)
