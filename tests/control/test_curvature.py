"""Noise shaped by the Hessian: against its closed form, and for a badly scaled cost."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax import control
from sfkd_jax.control.planners._shaped_noise import (
    MIN_CURVATURE,
    curvature_factor,
    shape_noise,
)

HORIZON = 8
A, B = np.float32([[1.0, 0.1], [0.0, 0.9]]), np.float32([[0.0, 0.02], [0.1, 0.0]])
Q, R = np.diag([1.0, 0.1]), np.diag([0.05, 0.5])
STD = jnp.asarray([0.5, 2.0])


def dynamics(params, state, action, env):
    return A @ state + B @ action


def stage(weights, state, action, before, goal):
    return (
        state @ jnp.asarray(Q, dtype=float) @ state
        + action @ jnp.asarray(R, dtype=float) @ action
    )


TASK = control.free_task(
    dynamics, stage, control_low=(-50.0, -50.0), control_high=(50.0, 50.0)
)


def cost(plan):
    """The cost of one plan from one state."""

    def step(state, action):
        after = dynamics({}, state, action, None)
        return after, stage((), after, action, None, None)

    return jnp.sum(jax.lax.scan(step, jnp.asarray([1.0, -0.5]), plan)[1])


def closed_form():
    """∇²J = 2 (G'QG + R), G the response of the states to the controls, in double
    precision.
    """
    a, b = A.astype(float), B.astype(float)
    response = np.zeros((2 * HORIZON, 2 * HORIZON))
    for after in range(HORIZON):
        for before in range(after + 1):
            power = np.linalg.matrix_power(a, after - before)
            response[2 * after : 2 * after + 2, 2 * before : 2 * before + 2] = power @ b
    wide = np.kron(np.eye(HORIZON), Q)
    return 2 * (response.T @ wide @ response + np.kron(np.eye(HORIZON), R))


def test_the_covariance_of_a_linear_model_is_its_closed_form():
    factor = np.asarray(
        curvature_factor(cost, jnp.ones((HORIZON, 2)), STD), dtype=float
    ).reshape(16, 16)
    scale = np.diag(np.tile(np.asarray(STD, dtype=float), HORIZON))
    values, vectors = np.linalg.eigh(scale @ closed_form() @ scale)
    assert values[0] / values[-1] > MIN_CURVATURE, "the floor must not hide the formula"
    widths = (values / np.exp(np.log(values).mean())) ** -0.5
    expected = scale @ vectors @ np.diag(widths) @ vectors.T @ scale
    np.testing.assert_allclose(
        factor @ factor.T, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max()
    )


def test_the_volume_of_the_noise_is_that_of_independent_noise():
    factor = np.asarray(
        curvature_factor(cost, jnp.zeros((HORIZON, 2)), STD), dtype=float
    ).reshape(16, 16)
    expected = HORIZON * np.log(np.asarray(STD, dtype=float)).sum()
    assert np.linalg.slogdet(factor)[1] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    "bad", [lambda plan: jnp.sum(plan) * jnp.nan, lambda plan: jnp.zeros(())]
)
def test_without_a_curvature_noise_is_independent(bad):
    factor = curvature_factor(bad, jnp.zeros((3, 2)), STD)
    np.testing.assert_allclose(
        factor.reshape(6, 6), np.diag(np.tile(STD, 3)), rtol=1e-6
    )
    noise = jax.random.normal(jax.random.key(0), (3, 5, 2))
    np.testing.assert_allclose(shape_noise(factor, noise), noise * STD, rtol=1e-6)


def test_where_the_cost_bends_down_noise_is_as_wide_as_where_it_is_flat():
    def saddle(plan):
        return plan[0, 0] ** 2 - plan[0, 1] ** 2

    factor = np.asarray(
        curvature_factor(saddle, jnp.zeros((1, 2)), jnp.ones(2))
    ).reshape(2, 2)
    ratio = factor[1, 1] / factor[0, 0]
    assert ratio == pytest.approx(MIN_CURVATURE**-0.25, rel=1e-4)
    assert factor[0, 1] == pytest.approx(0.0, abs=1e-6)


def regret(**settings):
    """Relative excess cost of the mean plan over the optimum, after some steps from one
    state.
    """
    planner = control.mppi(
        TASK, horizon=HORIZON, noise="white", noise_std=(0.5, 2.0), **settings
    )
    start = jnp.asarray([1.0, -0.5])

    @jit
    def run(key):
        def again(memory, _):
            held = memory._replace(tuning=memory.tuning._replace(elapsed=jnp.zeros(())))
            _, memory, info = planner.act({}, held, start, jnp.zeros(0), ())
            return memory, info["mean_cost"]

        return jax.lax.scan(again, planner.init(key), None, length=40)[1][-20:].mean()

    reached = np.mean([run(jax.random.key(seed)) for seed in range(3)])
    gradient = np.asarray(jax.grad(cost)(jnp.zeros((HORIZON, 2))), dtype=float).ravel()
    least = float(cost(jnp.zeros((HORIZON, 2)))) - 0.5 * gradient @ np.linalg.solve(
        closed_form(), gradient
    )
    return reached / least - 1


def test_with_few_samples_shaped_noise_comes_closer_to_the_optimum():
    few = {"num_samples": 100, "effective_samples": 10.0}
    plain, bent = regret(**few), regret(**few, curvature=True)
    assert -1e-3 < bent < 0.7 * plain


def test_a_control_cost_wants_independent_noise():
    with pytest.raises(ValueError, match="curvature and control_cost"):
        control.mppi(TASK, curvature=True, control_cost=1.0)
