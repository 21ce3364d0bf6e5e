"""Models in continuous time: solver order, symmetry, affine inputs, use of e."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.special
from helpers import jit, space

from sfkd_jax import models, plants
from sfkd_jax.geometry import compose
from sfkd_jax.models._continuous import Rates, continuous
from sfkd_jax.models._icode import softplus
from sfkd_jax.types import BODY, POSE

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
def test_the_step_is_the_exact_flow_of_a_linear_model_to_the_fourth_order():
    """Each halving of dt divides the error over one second by 16; pose included, since
    it turns at a constant rate.
    """
    random = np.random.default_rng(0)
    linear, turning = random.standard_normal((3, 3)), np.array([1.3, -0.4, 0.8])
    scales = space(3)._replace(increment_mean=jnp.zeros(3), increment_scale=jnp.ones(3))
    start, control = (
        jnp.asarray([3.0, -1.0, 0.4, 12.0, 0.2, -0.3]),
        jnp.asarray([0.3, 1.2]),
    )
    offset = np.array([0.5, 0.5, 0.0])

    def errors(steps):
        dt = 1.0 / steps
        rates = lambda fiber, s, u: jnp.concatenate(
            [turning * dt, linear @ s + fiber * u[0] * offset]
        )
        given = Rates(lambda key: {}, rates, fiber=lambda params, env: env[1])
        model = continuous(scales, given, dt=dt)
        state = start
        for _ in range(steps):
            state = stepped(model, {}, state, control)
        scaled = (np.asarray(start[BODY]) - scales.body_mean) / scales.body_scale
        constant = float((ENV[1] / 8.0) * (control[0] / 0.2)) * offset
        system = np.block([[linear, constant[:, None]], [np.zeros((1, 4))]])
        body = (scipy.linalg.expm(system) @ np.append(scaled, 1.0))[:3]
        back_and_forth = np.array(
            [
                [0.0, -turning[2], turning[0]],
                [turning[2], 0.0, turning[1]],
                [0.0, 0.0, 0.0],
            ]
        )
        motion = scipy.linalg.expm(back_and_forth)[:2, 2]
        pose = compose(start[POSE], jnp.asarray([*motion, turning[2]]))
        scaled = (state[BODY] - scales.body_mean) / scales.body_scale
        return (
            np.linalg.norm(scaled - body),
            np.linalg.norm(state[:2] - pose[:2]),
            abs(state[2] - pose[2]),
        )

    coarse, fine = np.array(errors(10)), np.array(errors(20))
    assert np.all(coarse[:2] > 1e-8)
    np.testing.assert_allclose(coarse[:2] / fine[:2], 16.0, rtol=0.15)
    np.testing.assert_allclose([coarse[2], fine[2]], 0.0, atol=1e-12)


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


def test_the_quick_softplus_is_as_exact_as_float32_and_rises_by_the_sigmoid():
    x = np.concatenate([np.linspace(-80.0, 80.0, 20_001), [0.0, -1e-30, 1e4]]).astype(
        np.float32
    )
    exact = np.logaddexp(0.0, x.astype(np.float64))
    np.testing.assert_allclose(softplus(jnp.asarray(x)), exact, rtol=4e-7)
    np.testing.assert_allclose(
        jax.vmap(jax.grad(softplus))(jnp.asarray(x)), scipy.special.expit(x), rtol=4e-7
    )
    assert np.isnan(softplus(jnp.asarray(jnp.nan)))


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
