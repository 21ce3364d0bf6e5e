"""ControlSynth: its flow contracts at the given rate for all weights and inputs."""

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


def test_two_solutions_under_the_same_inputs_approach_at_least_at_the_rate():
    """Small Runge-Kutta steps approximate the flow; inputs and environments jump; |·|_P
    in scaled units.
    """
    body, dt, steps = 4, 0.01, 200
    model, _ = parts(body, RATE, dt)
    params, weights = drawn(body, 1.0), exported(body, drawn(body, 1.0))
    random = np.random.default_rng(1)
    controls = random.normal([0.0, 0.0], [0.2, 2.0], (steps, 2)).astype(np.float32)
    envs = random.normal([0.6, 0.0], [0.3, 8.0], (steps, 2)).astype(np.float32)
    starts = space(body).body_mean + 3.0 * space(body).body_scale * random.normal(
        size=(2, 16, body)
    )
    states = jnp.concatenate([jnp.zeros((2, 16, 3)), starts], axis=-1)

    @jit
    def distances(params, states):
        def along(states, inputs):
            control, env = inputs
            fiber = model.fiber(params, env)
            move = jax.vmap(lambda state: model.step(fiber, state, control))
            after = jax.vmap(move)(states)
            body = jax.vmap(jax.vmap(model.vector))(after)
            return after, body[0] - body[1]

        first = jax.vmap(jax.vmap(model.vector))(states)
        return first[0] - first[1], jax.lax.scan(along, states, (controls, envs))[1]

    first, later = (np.asarray(part, np.float64) for part in distances(params, states))
    metric = weights.metric
    length = lambda gap: np.sqrt(np.einsum("...i,ij,...j->...", gap, metric, gap))
    shrunk = length(later) / length(first)
    allowed = np.exp(-RATE * dt * np.arange(1, steps + 1))
    assert np.all(shrunk <= allowed[:, None] * (1 + 1e-5) + 1e-5)
    assert shrunk[0].min() > 0.3  # steps are small against the fastest decay


def test_the_effect_of_the_input_does_not_depend_on_the_state():
    """The limit of the structure: rates are f(s) + g(u, e)."""
    body = 4
    model, _ = parts(body, RATE, 1e-3)
    params = drawn(body, 0.5)
    first, second = jnp.asarray([0.1, 1.0]), jnp.asarray([-0.2, -1.0])

    @jit
    def effect(params, side):
        state = space(body).body_mean + side * space(body).body_scale
        state = jnp.concatenate([jnp.zeros(3), state])
        fiber = model.fiber(params, jnp.asarray([0.5, 4.0]))
        ends = [model.step(fiber, state, control) for control in (first, second)]
        return (ends[0] - ends[1])[2:]  # positions turn with yaw

    there, here = effect(params, 1.0), effect(params, -1.0)
    assert np.max(np.abs(here)) > 1e-3
    np.testing.assert_allclose(there, here, rtol=0.02, atol=2e-5)
