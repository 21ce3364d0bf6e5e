"""Properties of every plant: frames, mirror symmetry, batches, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.geometry import compose
from sfkd_jax.plants import with_speed_loop
from sfkd_jax.types import POSE


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("which", ["step", "nominal", "nominal_derivative"])
def test_the_mirrored_drive_is_the_mirror_of_the_drive(vehicle, which, many, sweep):
    step = many(getattr(vehicle, which))
    drawn = sweep(vehicle, 64)
    flip = jnp.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0, -1.0])[: drawn.states.shape[1]]
    after = step(drawn.states, drawn.controls, drawn.envs)
    other = jnp.array([-1.0, 1.0])
    mirrored = step(
        flip * drawn.states, other * drawn.controls, other[::-1] * drawn.envs
    )
    np.testing.assert_allclose(mirrored, flip * after, rtol=0, atol=1e-12)
    assert jnp.abs(after - drawn.states)[:, 1:3].max() > 0.1


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("which", ["step", "nominal"])
def test_the_drive_does_not_depend_on_the_frame_it_is_expressed_in(
    vehicle, which, many, sweep
):
    step = many(getattr(vehicle, which))
    drawn = sweep(vehicle, 64)
    frame = jnp.array([30.0, -20.0, 2.3])

    def move(states):
        return states.at[:, POSE].set(
            jax.vmap(compose, in_axes=(None, 0))(frame, states[:, POSE])
        )

    there = step(move(drawn.states), drawn.controls, drawn.envs)
    np.testing.assert_allclose(
        there, move(step(drawn.states, drawn.controls, drawn.envs)), rtol=0, atol=1e-11
    )


@pytest.mark.parametrize(
    "loop", [lambda vehicle: vehicle, with_speed_loop], ids=["acceleration", "speed"]
)
def test_gradients_are_finite_at_rest_at_zero_and_at_the_extremes(factory, loop, sweep):
    """Single precision and one substep (the others repeat it), by state, control and
    environment.
    """
    vehicle = loop(factory(dt=0.02, substeps=1))
    weights = jnp.asarray(
        np.random.default_rng(1).normal(size=len(vehicle.state_names))
    )
    gradient = jax.jit(
        jax.vmap(jax.grad(lambda *row: weights @ vehicle.step(*row), argnums=(0, 1, 2)))
    )
    drawn = sweep(vehicle, 2000, overdrive=1.5)
    zeros = [
        jnp.zeros_like(drawn.states),
        jnp.zeros_like(drawn.controls),
        drawn.envs * jnp.array([1.0, 0.0]),
    ]
    for rows in ((drawn.states, drawn.controls, drawn.envs), zeros):
        gradients = gradient(*rows)
        assert all(bool(jnp.isfinite(g).all()) for g in gradients)
        assert max(float(jnp.abs(g).max()) for g in gradients) < 100.0


@pytest.mark.usefixtures("x64")
def test_the_nominal_derivative_is_the_limit_of_the_nominal_step_and_knows_nothing_of_hidden_states(
    factory, many, sweep
):
    vehicle, drawn = factory(dt=1e-6), sweep(factory(), 64)
    states = drawn.states.at[:, 3].add(1.0)
    rates = many(vehicle.nominal_derivative)(states, drawn.controls, drawn.envs)
    quotient = (
        many(vehicle.nominal)(states, drawn.controls, drawn.envs) - states
    ) / 1e-6
    np.testing.assert_allclose(rates[:, :4], quotient[:, :4], rtol=0, atol=1e-3)
    assert bool(jnp.all(rates[:, 4:] == 0.0))
