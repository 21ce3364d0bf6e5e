"""The friction circle and steady cornering: closed formulas for both plants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.geometry import between

GRAVITY = 9.81
MASS, FRONT, REAR, LEVER = 1500.0, 1.2, 1.5, 0.4
LENGTH = FRONT + REAR

pytestmark = pytest.mark.usefixtures("x64")


def axle_stiffness(vehicle, friction):
    """The stiffness of both axles [N/rad], proportional to μ in the kinematic plant
    only.
    """
    if vehicle.name == "kinematic":
        return 6.0e4 * friction, 7.0e4 * friction
    return 9.0e4, 1.05e5


def understeer(front, rear):
    return MASS * (REAR / front - FRONT / rear) / LENGTH


def tyre_acceleration(vehicle, state, control, env):
    """(a_x, a_y) by the tyres [m/s²]: of the body, without resistance and wind."""
    rate = vehicle.derivative(state, control, env)
    side = -10.0 * env[1] * jnp.abs(env[1]) / MASS
    if vehicle.name == "kinematic":
        return jnp.stack([rate[3], state[3] * rate[2] + side])
    return jnp.stack(
        [rate[3] - state[4] * state[5], rate[4] + state[3] * state[5] + side]
    )


def final_curvature(states):
    """Curvature of the path of the centre of mass from the last two states [1/m]."""
    x, y, turned = between(states[-2, :3], states[-1, :3])
    return turned / jnp.hypot(x, y)


@pytest.mark.parametrize("friction", [0.3, 0.9])
def test_steady_cornering_has_the_radius_and_the_understeer_gradient_of_the_linear_single_track(
    coasting, friction, hold
):
    steering, speeds = 1e-5, np.array([5.0, 10.0, 15.0, 20.0, 25.0])
    runs = [hold(coasting, v, (steering, 0.0), (friction, 0.0), 6.0) for v in speeds]
    curvature = np.array([final_curvature(states) for states in runs])
    gradient = understeer(*axle_stiffness(coasting, friction))
    np.testing.assert_allclose(
        curvature, steering / (LENGTH + gradient * speeds**2), rtol=2e-4
    )
    slope, intercept = np.polyfit(speeds**2, steering / curvature, 1)
    assert slope == pytest.approx(gradient, rel=1e-3)
    assert intercept == pytest.approx(LENGTH, rel=1e-3)


def test_no_command_takes_more_from_the_tyres_than_friction_times_load(coasting, sweep):
    drawn = sweep(coasting, 20_000, overdrive=3.0)
    states = drawn.states.at[:, 3].max(3.0)
    acceleration = jax.vmap(tyre_acceleration, in_axes=(None, 0, 0, 0))(
        coasting, states, drawn.controls, drawn.envs
    )
    used = jnp.linalg.norm(acceleration, axis=1) / (drawn.envs[:, 0] * GRAVITY)
    assert used.max() <= 1.0 + 1e-12
    assert used.max() > 0.98


def test_coasting_down_follows_the_closed_solution_of_drag_and_rolling(vehicle, hold):
    """With v̇ = −b v² − c: v(t) = √(c/b) tan(atan(v_0 √(b/c)) − √(b c) t)."""
    states = hold(vehicle, 20.0, (0.0, 0.0), (0.9, 0.0), 10.0)
    b, c = 0.4 / MASS, 0.012 * GRAVITY
    expected = np.sqrt(c / b) * np.tan(
        np.arctan(20.0 * np.sqrt(b / c)) - np.sqrt(b * c) * 10.0
    )
    assert float(states[-1, 3]) == pytest.approx(expected, rel=1e-8)
