"""What a controller is told: late, biased, noisy; the truth stays what it is."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.evaluation import told

ENVS = jnp.stack([jnp.linspace(0.9, 0.3, 300), jnp.linspace(-8.0, 8.0, 300)], axis=1)
HEAR = partial(told, ENVS, dt=0.1)


def test_without_a_fault_the_truth_is_told_to_the_last_bit(key):
    np.testing.assert_array_equal(HEAR(key), ENVS)


@pytest.mark.parametrize("steps", [1, 5, 40])
def test_late_is_the_truth_shifted_and_the_first_value_before_it(key, steps):
    heard = HEAR(key, delay_s=0.1 * steps)
    np.testing.assert_array_equal(heard[steps:], ENVS[:-steps])
    np.testing.assert_array_equal(heard[:steps], jnp.tile(ENVS[:1], (steps, 1)))


def test_a_bias_is_added_and_friction_stays_positive(key):
    np.testing.assert_allclose(
        HEAR(key, bias=(0.1, -2.0)), ENVS + jnp.asarray([0.1, -2.0]), rtol=1e-6
    )
    assert float(HEAR(key, bias=(-0.9, 0.0))[:, 0].min()) == pytest.approx(0.05)


def test_noise_has_the_spread_that_was_asked_for_and_another_one_per_episode(key):
    hear = jax.vmap(lambda episode: HEAR(episode, noise=(0.02, 1.0)))
    errors = hear(jax.random.split(key, 200)) - ENVS
    np.testing.assert_allclose(errors.std(axis=(0, 1)), [0.02, 1.0], rtol=0.02)
    np.testing.assert_allclose(errors.mean(axis=(0, 1)), [0.0, 0.0], atol=0.015)
    assert not np.allclose(errors[0], errors[1])
