import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.plants import rk4

pytestmark = pytest.mark.usefixtures("x64")


def test_one_step_of_a_linear_system_is_the_taylor_polynomial_of_degree_four():
    step = rk4(lambda x, u, e: e[0] * x + u, dt=0.5)
    after = step(jnp.array([2.0]), jnp.array([0.0]), jnp.array([-1.6]))
    z = -0.8
    np.testing.assert_allclose(
        after, [2.0 * (1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)], rtol=1e-14
    )


def test_substeps_are_shorter_steps_under_the_same_control(vehicle):
    whole = rk4(vehicle.derivative, dt=0.1, substeps=2)
    half = rk4(vehicle.derivative, dt=0.05)
    state = jnp.linspace(0.0, 0.3, len(vehicle.state_names)).at[3].set(12.0)
    control, env = jnp.array([0.05, 1.0]), jnp.array([0.7, 3.0])
    twice = half(half(state, control, env), control, env)
    np.testing.assert_allclose(whole(state, control, env), twice, rtol=0, atol=1e-13)


def test_the_error_falls_with_the_fourth_power_of_the_step(vehicle):
    state = jnp.zeros(len(vehicle.state_names)).at[3].set(12.0)
    state = state.at[4:].set(jnp.array([-0.2, 0.25, 0.06])[: state.size - 4])
    control, env = jnp.array([0.08, -1.5]), jnp.array([0.6, 4.0])

    @jax.jit
    def end(steps):
        step = rk4(lambda x, u, e: vehicle.derivative(x, u, e) / steps, dt=1.0)
        return jax.lax.fori_loop(0, steps, lambda _, x: step(x, control, env), state)

    steps = np.array([4, 6, 9, 14, 20]) * (
        10 if vehicle.name == "dynamic" else 1
    )  # tyres are stiffer than a path
    exact = end(3000)
    errors = [float(jnp.linalg.norm(end(n) - exact)) for n in steps]
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.15)
