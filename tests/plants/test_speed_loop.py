import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.plants import with_speed_loop

pytestmark = pytest.mark.usefixtures("x64")
ENV = (0.9, 0.0)


def state_at(vehicle, speed):
    return jnp.zeros(len(vehicle.state_names)).at[3].set(speed)


@pytest.mark.parametrize("start", [2.0, 20.0])
def test_the_car_settles_at_the_commanded_speed_without_resistance(
    coasting, start, hold
):
    states = hold(with_speed_loop(coasting), start, (0.0, 11.0), ENV, 25.0)
    assert float(states[-1, 3]) == pytest.approx(11.0, abs=1e-4)
    away = jnp.abs(states[:, 3] - 11.0)
    assert (jnp.diff(away) <= 1e-12).all()


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_resistance_holds_the_speed_back_by_itself_over_the_gain(vehicle, gain, hold):
    speed = float(
        hold(with_speed_loop(vehicle, gain=gain), 10.0, (0.0, 12.0), ENV, 30.0)[-1, 3]
    )
    resistance = 0.4 * speed**2 / 1500.0 + 0.012 * 9.81
    assert 12.0 - speed == pytest.approx(resistance / gain, rel=1e-2)


@pytest.mark.parametrize("which", ["step", "nominal", "nominal_derivative"])
@pytest.mark.parametrize(
    ("command", "acceleration"), [(1e3, 3.0), (-1e3, -6.0), (10.4, 0.8), (9.5, -1.0)]
)
def test_the_loop_asks_for_what_the_actuator_can_give(
    vehicle, which, command, acceleration
):
    state, env, steering = state_at(vehicle, 10.0), jnp.array(ENV), 0.1
    closed = getattr(with_speed_loop(vehicle, gain=2.0), which)(
        state, jnp.array([steering, command]), env
    )
    opened = getattr(vehicle, which)(state, jnp.array([steering, acceleration]), env)
    np.testing.assert_allclose(closed, opened, rtol=0, atol=1e-12)
