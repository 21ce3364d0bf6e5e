"""Rest, launch and stop, in the single precision in which the plants are used."""

import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.types import POSE


@pytest.mark.parametrize("which", ["step", "nominal"])
def test_a_standing_car_with_its_brakes_on_stands(vehicle, which, hold):
    start = (
        jnp.zeros(len(vehicle.state_names)).at[POSE].set(jnp.array([3.0, -2.0, 0.7]))
    )
    states = hold(
        vehicle._replace(step=getattr(vehicle, which)),
        start,
        (0.3, -6.0),
        (0.5, 8.0),
        3.0,
    )
    np.testing.assert_array_equal(
        states[:, :4], jnp.broadcast_to(start[:4], states[:, :4].shape)
    )
    assert (states[:, 4:6] == 0).all()


@pytest.mark.parametrize("friction", [0.3, 0.9])
@pytest.mark.parametrize("steering", [0.0, 0.1])
def test_braking_stops_a_car_and_does_not_reverse_it(vehicle, friction, steering, hold):
    states = hold(vehicle, 8.0, (steering, -6.0), (friction, 0.0), 6.0)
    heading = jnp.stack([jnp.cos(states[:-1, 2]), jnp.sin(states[:-1, 2])], axis=1)
    advance = (jnp.diff(states[:, :2], axis=0) * heading).sum(axis=1)
    assert (states[:, 3] >= 0).all()
    assert (advance >= -1e-6).all()
    np.testing.assert_allclose(states[-10:, 3], 0.0, atol=1e-5)
    np.testing.assert_allclose(states[-10:, :2] - states[-1, :2], 0.0, atol=1e-5)
    assert advance.sum() > 0.9 * 8.0**2 / (2 * friction * 9.81)


def test_a_car_launches_from_rest_along_the_kinematic_curve(vehicle, hold):
    steering = 0.1
    states = hold(vehicle, 0.0, (steering, 1.0), (0.9, 0.0), 3.0)
    assert jnp.isfinite(states).all()
    assert (jnp.diff(states[:, 3]) > 0).all()
    late = states[10:]
    turned, gone = (
        jnp.diff(late[:, 2]),
        jnp.linalg.norm(jnp.diff(late[:, :2], axis=0), axis=1),
    )
    np.testing.assert_allclose(
        turned / gone, np.tan(steering) / vehicle.wheelbase, rtol=0.06
    )
