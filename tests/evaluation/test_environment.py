"""The observed environment: delayed, biased, noisy; the truth stays what it is."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.evaluation import observed_environment

ENVS = jnp.stack([jnp.linspace(0.9, 0.3, 300), jnp.linspace(-8.0, 8.0, 300)], axis=1)
OBSERVE = partial(observed_environment, ENVS, dt=0.1)


def test_a_perfect_sensor_observes_the_truth_to_the_last_bit(key):
    np.testing.assert_array_equal(OBSERVE(key), ENVS)


@pytest.mark.parametrize("steps", [1, 5, 40])
def test_a_delay_shifts_the_truth_and_repeats_its_first_value(key, steps):
    observed = OBSERVE(key, delay_s=0.1 * steps)
    np.testing.assert_array_equal(observed[steps:], ENVS[:-steps])
    np.testing.assert_array_equal(observed[:steps], jnp.tile(ENVS[:1], (steps, 1)))


def test_a_bias_is_added_and_friction_stays_positive(key):
    np.testing.assert_allclose(
        OBSERVE(key, bias=(0.1, -2.0)), ENVS + jnp.asarray([0.1, -2.0]), rtol=1e-6
    )
    assert float(OBSERVE(key, bias=(-0.9, 0.0))[:, 0].min()) == pytest.approx(0.05)


def test_noise_has_the_configured_spread_and_differs_between_episodes(key):
    observe = jax.vmap(lambda episode: OBSERVE(episode, noise=(0.02, 1.0)))
    errors = observe(jax.random.split(key, 200)) - ENVS
    np.testing.assert_allclose(errors.std(axis=(0, 1)), [0.02, 1.0], rtol=0.02)
    np.testing.assert_allclose(errors.mean(axis=(0, 1)), [0.0, 0.0], atol=0.015)
    assert not np.allclose(errors[0], errors[1])
