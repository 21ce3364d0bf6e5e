"""The dynamic plant: hidden slip, a steering actuator, load transfer."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from sfkd_jax.driving.plants import kinematic

MASS, INERTIA, FRONT, REAR, C_FRONT, C_REAR = 1500.0, 2500.0, 1.2, 1.5, 9.0e4, 1.05e5
HEIGHT, GRAVITY, LAG = 0.55, 9.81, 0.1
DRIVING = slice(4, 7)
SPEEDS = np.linspace(0.0, 25.0, 101)

pytestmark = pytest.mark.usefixtures("x64")


def single_track(speed):
    """The textbook matrix of (v_y, yaw rate, steering) in straight driving."""
    side = [
        -(C_FRONT + C_REAR) / (MASS * speed),
        (C_REAR * REAR - C_FRONT * FRONT) / (MASS * speed) - speed,
    ]
    turn = [(C_REAR * REAR - C_FRONT * FRONT), -(C_FRONT * FRONT**2 + C_REAR * REAR**2)]
    turn = [t / (INERTIA * speed) for t in turn]
    return np.array(
        [
            [*side, C_FRONT / MASS],
            [*turn, C_FRONT * FRONT / INERTIA],
            [0.0, 0.0, -1.0 / LAG],
        ]
    )


def straight(speed):
    return jnp.zeros(7).at[3].set(speed)


@pytest.fixture(params=[0.3, 0.9])
def linearised(dynamic_plant, request):
    """The Jacobian of (v_y, yaw rate, steering) in straight driving at each of SPEEDS."""

    def of(which):
        at = jax.vmap(straight)(jnp.asarray(SPEEDS)), jnp.zeros(2)
        env = jnp.array([request.param, 0.0])
        rates = _jacobian(getattr(dynamic_plant(), which))(*at, env)
        return rates[:, DRIVING, DRIVING]

    return of


@cache
def _jacobian(function):
    return jax.jit(jax.vmap(jax.jacfwd(function), in_axes=(0, None, None)))


def test_the_linearisation_in_straight_driving_is_the_linear_single_track(linearised):
    rolling = SPEEDS >= 5.0
    theory = np.stack([single_track(speed) for speed in SPEEDS[rolling]])
    np.testing.assert_allclose(
        linearised("derivative")[rolling], theory, rtol=1e-12, atol=1e-12
    )
    sampled = np.linalg.eigvals(linearised("step")[rolling])
    expected = np.linalg.eigvals(expm(0.1 * theory))
    gap = np.abs(expected[:, :, None] - sampled[:, None, :])
    assert max(gap.min(axis=1).max(), gap.min(axis=2).max()) < 5e-3


@pytest.mark.parametrize("speed", [0.5, 2.0, 5.0, 20.0])
def test_the_default_substeps_are_fine_enough(dynamic_plant, speed, hold):
    control, env = (0.1, 1.0), (0.6, 5.0)
    ends = [
        hold(vehicle, speed, control, env, 2.0)[-1]
        for vehicle in (dynamic_plant(), dynamic_plant(dt=0.01))
    ]
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-3)


@pytest.mark.parametrize("acceleration", [-4.0, 0.0, 2.0])
def test_a_sliding_car_is_turned_by_the_load_that_braking_moves_forward(
    dynamic_plant, acceleration
):
    """Both axles slide: I ω̇ = l_f Y_f − l_r Y_r = −m a_x h √(μ² − (a_x/g)²)."""
    friction, limit = 0.6, 0.95 * 0.6 * GRAVITY
    state = jnp.zeros(7).at[3:5].set(jnp.array([10.0, -20.0]))
    turned = dynamic_plant().derivative(
        state, jnp.array([0.0, acceleration]), jnp.array([friction, 0.0])
    )[5]
    along = limit * np.tanh(acceleration / limit)
    moment = -MASS * along * HEIGHT * np.sqrt(friction**2 - (along / GRAVITY) ** 2)
    assert float(turned) == pytest.approx(moment / INERTIA, abs=1e-12)


def test_a_gust_first_pushes_with_its_force_and_its_moment(dynamic_plant):
    rate = dynamic_plant().derivative(
        straight(15.0), jnp.zeros(2), jnp.array([0.9, -4.0])
    )
    np.testing.assert_allclose(
        rate[4:6], [-160.0 / MASS, -160.0 * 0.4 / INERTIA], rtol=1e-12
    )


def test_the_nominal_bicycle_is_that_of_the_kinematic_plant_with_quasi_steady_slip(
    dynamic_plant, sweep
):
    drawn = sweep(dynamic_plant(), 64)
    full = jax.vmap(dynamic_plant().nominal)(drawn.states, drawn.controls, drawn.envs)
    small = jax.vmap(kinematic().nominal)(
        drawn.states[:, :4], drawn.controls, drawn.envs
    )
    np.testing.assert_allclose(full[:, :4], small, rtol=0, atol=1e-12)
    yaw_rate = small[:, 3] * np.tan(drawn.controls[:, 0]) / (FRONT + REAR)
    expected = np.stack([REAR * yaw_rate, yaw_rate, drawn.controls[:, 0]], axis=1)
    np.testing.assert_allclose(full[:, 4:], expected, rtol=0, atol=1e-12)
