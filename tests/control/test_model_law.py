"""The law of a model: its turns are steady, and its gains solve the Riccati equation."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import jit, straight

from sfkd_jax import control, models, plants
from sfkd_jax.geometry import path_step

LAW = control.ModelLaw()
PLANTS = {"kinematic": plants.kinematic(), "dynamic": plants.dynamic()}
ENV = jnp.asarray([0.6, 5.0])
CURVATURE = jnp.asarray([0.0, 0.01, -0.02])


@cache
def turns(name, bend=1.0):
    """Steady turns of a plant for three curvatures, and the step in path coordinates."""
    plant = PLANTS[name]
    model, size = models.physics(plant.step), len(plant.state_names)

    @jit
    def prepared(env, curvature):
        fiber = model.fiber({}, env)
        return LAW.prepare(model, fiber, jnp.zeros(size), straight(3), curvature)

    along = path_step(plant.step)
    step = jit(lambda xi, control, kappa: along(xi, control, kappa, ENV))
    return prepared(ENV, bend * CURVATURE), step


@pytest.mark.parametrize("name", PLANTS)
def test_a_steady_turn_stays_what_it_is_on_the_path_at_the_reference_speed(name):
    turn, step = turns(name)
    for k, kappa in enumerate(CURVATURE):
        after = step(turn.state[k], turn.control[k], kappa)
        np.testing.assert_allclose(after, turn.state[k], atol=2e-3)
        np.testing.assert_allclose(
            np.asarray(turn.state[k])[[0, 2]], [0.0, 10.0], atol=1e-6
        )
    assert (
        abs(float(turn.control[0, 0])) > 1e-3
    )  # side wind: even straight on, it steers against it


def test_the_textbook_bicycle_turns_as_its_geometry_requires():
    plant = PLANTS["kinematic"]
    model = models.physics(plant.nominal)
    prepare = lambda curvature: LAW.prepare(
        model, model.fiber({}, ENV), jnp.zeros(4), straight(3), curvature
    )
    turn = jit(prepare)(CURVATURE)
    np.testing.assert_allclose(turn.grip[:, 0], plant.wheelbase, rtol=1e-2)
    _, _, speed = turn.state[1]
    np.testing.assert_allclose(speed, 10.0)
    np.testing.assert_allclose(turn.control[:, 1], 0.0, atol=1e-5)
    np.testing.assert_allclose(
        np.tan(turn.control[:, 0]), plant.wheelbase * CURVATURE, rtol=2e-2, atol=1e-5
    )


@pytest.mark.parametrize("name", PLANTS)
def test_the_gain_is_that_of_the_riccati_equation_and_stabilises(name):
    turn, step = turns(name)
    at = (turn.state[0], turn.control[0], CURVATURE[0])
    A, B = (np.asarray(part, float) for part in jax.jacfwd(step, argnums=(0, 1))(*at))
    Q = np.zeros((len(A), len(A)))
    Q[:3, :3] = np.diag([LAW.lateral, LAW.heading, LAW.speed])
    R = np.diag([LAW.steering, LAW.drive])
    value = scipy.linalg.solve_discrete_are(A, B, Q + 1e-9 * np.eye(len(A)), R)
    gain = np.linalg.solve(R + B.T @ value @ B, B.T @ value @ A)
    np.testing.assert_allclose(turn.gain[0], gain, rtol=2e-2, atol=2e-3)
    assert np.max(np.abs(np.linalg.eigvals(A - B @ np.asarray(turn.gain[0])))) < 1.0
