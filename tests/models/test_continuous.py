"""Models in continuous time: known dynamics, affine inputs, exact activations."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit, space

from sfkd_jax import models
from sfkd_jax.driving import plants
from sfkd_jax.types import POSE

LEARNED = ("neural_ode", "icode", "icode_mppi")
SIZES = {
    "neural_ode": {"hidden": (8, 8)},
    "icode": {"width": 8},
    "icode_mppi": {"hidden": (8, 8)},
}
PLANTS = {1: plants.kinematic, 4: plants.dynamic}
STATES = {
    1: jnp.asarray([5.0, -2.0, 0.7, 11.0]),
    4: jnp.asarray([5.0, -2.0, 0.7, 11.0, -0.3, 0.2, 0.1]),
}
CONTROL, ENV = jnp.asarray([0.12, -1.0]), jnp.asarray([0.5, 6.0])


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def small(name, body=1, scales=None, **changes):
    """A small model with a body state of the given size."""
    known = (
        {"nominal": PLANTS[body]().nominal_derivative} if name == "icode_mppi" else {}
    )
    return getattr(models, name)(scales or space(body), **SIZES[name] | known | changes)


@cache
def drawn(name, body=1):
    """Random parameters of unit gain, none of them 0."""
    random = np.random.default_rng(3)
    leaves = jax.eval_shape(small(name, body).init, jax.random.key(0))
    return jax.tree.map(
        lambda leaf: leaf.shape[0] ** -0.5 * random.standard_normal(leaf.shape), leaves
    )


@partial(jit, static_argnums=0)
def stepped(model, params, state, control=CONTROL, env=ENV):
    return model.step(model.fiber(params, env), state, control)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", LEARNED)
def test_only_the_input_affine_models_are_affine_in_control_and_environment_together(
    name,
):
    """By the limit dt -> 0 of their steps: second differences of the rates along a line
    in [u; e].
    """
    dt, scales = 1e-6, space()
    motion = {
        "increment_mean": dt * scales.increment_mean,
        "increment_scale": dt * scales.increment_scale,
    }
    model, params = small(name, dt=dt, scales=scales._replace(**motion)), drawn(name)
    control_way, env_way = jnp.asarray([0.0, 0.9]), jnp.asarray([0.2, -3.0])

    def rates(t):
        """Of the pose and the body; the nominal bicycle is affine in the acceleration,
        which is what varies.
        """
        state = STATES[1].astype(jnp.float64).at[POSE].set(0.0)
        return (
            stepped(model, params, state, CONTROL + t * control_way, ENV + t * env_way)
            - state
        ) / dt

    second = np.abs(rates(1.0) - 2.0 * rates(0.0) + rates(-1.0)).max()
    assert np.abs(rates(1.0) - rates(0.0)).max() > 0.1
    assert (second > 1e-2) if name == "neural_ode" else (second < 1e-4)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("body", PLANTS)
def test_without_a_residual_the_known_dynamics_are_all_that_moves(body):
    plant = plants.with_speed_loop(PLANTS[body]())
    model = small("icode_mppi", body, nominal=plant.nominal_derivative)
    nothing = jax.tree.map(jnp.zeros_like, drawn("icode_mppi", body))
    state, control = STATES[body].astype(jnp.float64), CONTROL.astype(jnp.float64)
    moved = stepped(model, nothing, state, control)
    expected = plants.rk4(plant.nominal_derivative, dt=0.1)(state, control, ENV)
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-13)
