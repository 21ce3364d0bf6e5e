"""The kinematic plant: quasi-steady slip, and no hidden state."""

import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.driving.plants import kinematic, kinematic_stiff

MASS, FRONT, REAR, LEVER = 1500.0, 1.2, 1.5, 0.4
LENGTH = FRONT + REAR

pytestmark = pytest.mark.usefixtures("x64")


@pytest.mark.parametrize(
    ("friction", "wind", "speed"),
    [(0.9, 0.0, 5.0), (0.5, 4.0, 12.0), (0.3, -8.0, 20.0)],
)
@pytest.mark.parametrize("car", [kinematic, kinematic_stiff])
def test_slip_balances_force_and_moment_at_both_axles(car, friction, wind, speed):
    """For any curvature in the friction circle, the rear tyres carry their share of the
    force.
    """
    env = jnp.array([friction, wind])
    rate = car().derivative(
        jnp.array([0.0, 0.0, 0.0, speed]), jnp.array([0.05, 0.0]), env
    )
    slip, curvature = np.arctan2(rate[1], rate[0]), rate[2] / speed
    force, lateral = 10.0 * wind * abs(wind), MASS * speed**2 * curvature
    grip = friction if car is kinematic else 1.0
    rear = -7.0e4 * grip * (slip - REAR * curvature)
    front = lateral - force - rear
    assert float(FRONT * front - REAR * rear + LEVER * force) == pytest.approx(
        0.0, abs=1e-6
    )


def test_the_demand_is_scaled_onto_the_circle_and_keeps_its_direction():
    vehicle, state = kinematic(drag=0.0, rolling=0.0), jnp.array([0.0, 0.0, 0.0, 20.0])
    env = jnp.array([0.4, 0.0])
    rates = [
        vehicle.derivative(state, jnp.array(u), env) for u in ((1e-6, 0.0), (0.3, -5.0))
    ]
    lateral = float(rates[0][2]) / 1e-6 * np.tan(0.3) * 20.0
    wanted = np.array([-5.0, lateral])
    given = np.array([rates[1][3], 20.0 * rates[1][2]])
    np.testing.assert_allclose(
        given / np.linalg.norm(given), wanted / np.linalg.norm(wanted), rtol=1e-6
    )
    size = np.linalg.norm(wanted) / (0.4 * 9.81)
    assert np.linalg.norm(given) == pytest.approx(0.4 * 9.81 * np.tanh(size), rel=1e-6)


def test_the_nominal_bicycle_drives_its_circle_whatever_road_and_weather(hold):
    vehicle = kinematic()
    nominal = vehicle._replace(step=vehicle.nominal)
    ends = [
        hold(nominal, 10.0, (0.2, 0.0), env, 2.0)[-1]
        for env in ((0.9, 0.0), (0.3, 8.0))
    ]
    np.testing.assert_array_equal(*ends)
    curvature = np.tan(0.2) / LENGTH
    assert float(ends[0][2]) == pytest.approx(20.0 * curvature, rel=1e-10)
    chord = 2.0 / curvature * np.sin(10.0 * curvature)
    assert float(jnp.linalg.norm(ends[0][:2])) == pytest.approx(abs(chord), rel=1e-3)
