"""A simulator on the host is a system like any other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loops import DT, frame, mass, pushed

from sfkd_jax.systems import Tracked, simulated, steady_states


def on_host(x, u, e):
    """The mass, in numpy."""
    a = (u[..., 0] + e[..., 1]) / e[..., 0]
    v = x[..., 1]
    return np.stack([x[..., 0] + v * DT + 0.5 * a * DT**2, v + a * DT], axis=-1)


@pytest.mark.parametrize("vectorized", [False, True])
def test_values_and_derivatives_are_those_of_the_traced_step(vectorized, key):
    step = simulated(on_host, states=2, vectorized=vectorized)
    keys = jax.random.split(key, 3)
    x = jax.random.normal(keys[0], (3, 4, 2))
    u = jax.random.normal(keys[1], (3, 4, 1))
    e = jax.random.uniform(keys[2], (3, 4, 2), minval=0.5, maxval=1.5)
    for function in (lambda f: f, lambda f: jax.jacfwd(f, (0, 1, 2))):
        expected, found = (
            jax.jit(jax.vmap(jax.vmap(function(of))))(x, u, e) for of in (pushed, step)
        )
        for one, other in zip(*map(jax.tree.leaves, (expected, found)), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


def test_rows_of_a_vectorized_simulator_are_simulated_at_once():
    calls = []

    def counted(x, u, e):
        calls.append(len(x))
        return on_host(x, u, e)

    step = jax.vmap(simulated(counted, states=2, vectorized=True), in_axes=(0, 0, None))
    step(jnp.zeros((50, 2)), jnp.zeros((50, 1)), jnp.ones(2)).block_until_ready()
    assert calls == [50]


def test_its_steady_states_are_those_of_the_traced_step():
    of_host = steady_states(Tracked(mass(simulated(on_host, states=2)), frame()))
    traced = steady_states(Tracked(mass(), frame()))
    for name in ("states", "controls", "slopes"):
        one, other = getattr(of_host, name), getattr(traced, name)
        np.testing.assert_allclose(one, other, atol=1e-7)


@pytest.mark.parametrize("vectorized", [False, True])
def test_another_shape_is_refused_in_words(vectorized):
    step = simulated(lambda x, u, e: x[..., :1], states=2, vectorized=vectorized)
    with pytest.raises(Exception, match="simulator must return an array of shape"):
        step(jnp.zeros(2), jnp.zeros(1), jnp.ones(2)).block_until_ready()


def test_what_a_simulator_does_to_its_arguments_stays_with_it():
    def careless(x, u, e):
        x[0] += 1.0
        return x

    x = jnp.zeros(2)
    step = simulated(careless, states=2)
    for _ in range(2):
        np.testing.assert_array_equal(step(x, jnp.zeros(1), jnp.ones(2)), [1.0, 0.0])
