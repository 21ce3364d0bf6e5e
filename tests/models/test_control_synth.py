"""ControlSynth: its flow contracts at the given rate for all weights and inputs; inputs
are only added.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit, space

from sfkd_jax import models
from sfkd_jax.models._control_synth import contracting

RATE = 0.05


@cache
def parts(body, rate=RATE, dt=0.1):
    """A model and its state equation, compiled once."""
    model = models.control_synth(
        space(body), rate=rate, dt=dt, width=24, input_hidden=(16,)
    )
    return model, jit(lambda params: contracting(params["free"], rate))


def drawn(body, scale, seed=0):
    """Normal weights of the given scale, none of them 0."""
    random = np.random.default_rng(seed)
    shapes = jax.eval_shape(parts(body)[0].init, jax.random.key(0))
    return jax.tree.map(
        lambda leaf: (scale * random.standard_normal(leaf.shape)).astype(np.float32),
        shapes,
    )


def exported(body, params, rate=RATE):
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, dtype=np.float64), parts(body, rate)[1](params)
    )


def slack_of(weights, rate):
    """Least eigenvalue of the matrix inequality of `control_synth`, over its size."""
    P, multipliers = weights.metric, weights.multipliers
    top = P @ weights.linear + weights.linear.T @ P + 2 * rate * P
    side = P @ weights.outer + weights.inner.T * multipliers
    matrix = -np.block([[top, side], [side.T, -2 * np.diag(multipliers)]])
    return np.linalg.eigvalsh(matrix)[0] / np.linalg.norm(matrix)


@pytest.mark.parametrize("body", [1, 4])
@pytest.mark.parametrize("scale", [0.0, 0.03, 0.3, 1.0, 3.0])
def test_the_given_rate_is_proved_for_all_weights(body, scale):
    for seed in range(5):
        assert slack_of(exported(body, drawn(body, scale, seed)), RATE) > 0


@pytest.mark.parametrize("body", [1, 4])
@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_two_solutions_under_the_same_inputs_approach_at_least_at_the_rate(body, scale):
    """Small Runge-Kutta steps approximate the flow; inputs and environments jump; |·|_P
    in scaled units.
    """
    dt, steps = 0.01, 200
    model, _ = parts(body, RATE, dt)
    params, weights = drawn(body, scale), exported(body, drawn(body, scale))
    rate = RATE
    keys = jax.random.split(jax.random.key(1), 3)
    controls = jnp.asarray([0.2, 2.0]) * jax.random.normal(keys[0], (steps, 2))
    envs = jnp.asarray([0.6, 0.0]) + jnp.asarray([0.3, 8.0]) * jax.random.normal(
        keys[1], (steps, 2)
    )
    starts = space(body).body_mean + 3.0 * space(body).body_scale * jax.random.normal(
        keys[2], (2, 16, body)
    )
    states = jnp.concatenate([jnp.zeros((2, 16, 3)), starts], axis=-1)

    @jit
    def distances(params, states):
        step = jax.vmap(
            jax.vmap(model.step, in_axes=(None, 0, None)), in_axes=(None, 0, None)
        )

        def along(states, inputs):
            control, env = inputs
            after = step(model.fiber(params, env), states, control)
            body = jax.vmap(jax.vmap(model.vector))(after)
            return after, body[0] - body[1]

        first = jax.vmap(jax.vmap(model.vector))(states)
        return first[0] - first[1], jax.lax.scan(along, states, (controls, envs))[1]

    first, later = (
        np.asarray(part, dtype=np.float64) for part in distances(params, states)
    )
    length = lambda gap: np.sqrt(
        np.einsum("...i,ij,...j->...", gap, weights.metric, gap)
    )
    shrunk = length(later) / length(first)
    allowed = np.exp(-rate * dt * np.arange(1, steps + 1))
    assert np.all(shrunk <= allowed[:, None] * (1 + 1e-5) + 1e-5)
    assert shrunk[0].min() > 0.3  # steps are small against the fastest decay


@pytest.mark.parametrize("body", [1, 4])
def test_the_effect_of_the_input_does_not_depend_on_the_state(body):
    """The limit of the structure: rates are f(s) + g(u, e)."""
    dt = 1e-3
    model, _ = parts(body, RATE, dt)
    params = drawn(body, 0.5)
    first, second = jnp.asarray([0.1, 1.0]), jnp.asarray([-0.2, -1.0])
    env = jnp.asarray([0.5, 4.0])

    @jit
    def effect(params, state):
        fiber = model.fiber(params, env)
        return (model.step(fiber, state, first) - model.step(fiber, state, second))[
            2:
        ]  # positions turn with yaw

    slow = jnp.concatenate(
        [jnp.zeros(3), space(body).body_mean - space(body).body_scale]
    )
    fast = jnp.concatenate(
        [jnp.zeros(3), space(body).body_mean + space(body).body_scale]
    )
    there, here = effect(params, fast), effect(params, slow)
    assert np.max(np.abs(here)) > 1e-3
    np.testing.assert_allclose(there, here, rtol=0.02, atol=2e-5)
