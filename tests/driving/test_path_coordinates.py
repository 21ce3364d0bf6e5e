"""Path coordinates against their geometry, and a closed loop against the same drive in
the world.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.driving import plants
from sfkd_jax.driving.path_coordinates import (
    circle_errors,
    curvature_ahead,
    is_valid,
    projected,
)
from sfkd_jax.driving.paths import path_from_curvature, project
from sfkd_jax.driving.plants._along_path import step_with_law
from sfkd_jax.geometry import compose, without_pose
from sfkd_jax.types import BODY

CIRCLE_ERRORS = jit(circle_errors)
SLOPES = jit(lambda *at: jax.tree.leaves(jax.jacfwd(circle_errors, (0, 1))(*at)))
CURVATURES = (-0.08, -1e-6, 0.0, 1e-6, 0.02, 0.1)


def foot(curvature, progress) -> jax.Array:
    """The pose on a circle through the origin, after some arc length; by its chord."""
    half = 0.5 * curvature * progress
    chord = progress * jnp.sinc(half / np.pi)
    return jnp.stack([chord * jnp.cos(half), chord * jnp.sin(half), 2 * half])


@pytest.mark.parametrize("curvature", CURVATURES)
def test_a_pose_beside_a_circle_has_its_own_coordinates_and_finite_derivatives(
    curvature,
):
    """Also without curvature, and far beyond the centre."""
    bend, beside = jnp.asarray(curvature), [(0.0, 0.0), (0.7, -0.2), (-1.5, 0.4)]
    for progress, errors in itertools.product((-2.0, 0.0, 1.3), beside):
        pose = compose(foot(curvature, progress), jnp.asarray([0.0, *errors]))
        np.testing.assert_allclose(CIRCLE_ERRORS(pose, bend), errors, atol=2e-5)
    for y in (0.0, 0.3, 1e3, -1e3):
        rates = SLOPES(jnp.asarray([1.0, y, 0.1]), bend)
        assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in rates)


def test_a_car_near_the_centre_of_curvature_is_invalid_but_finite():
    assert bool(is_valid(jnp.asarray(7.9), jnp.asarray(0.1)))
    assert not bool(is_valid(jnp.asarray(8.1), jnp.asarray(0.1)))
    assert not bool(is_valid(jnp.asarray(jnp.nan), jnp.asarray(0.1)))
    lateral, heading = circle_errors(jnp.asarray([0.5, 9.9, 0.0]), jnp.asarray(0.1))
    assert np.all(np.isfinite([lateral, heading]))
    assert not bool(is_valid(lateral, jnp.asarray(0.1)))


@pytest.mark.parametrize(
    "plant", [plants.kinematic(), plants.dynamic()], ids=lambda plant: plant.name
)
@pytest.mark.parametrize("curvature", [-0.02, 0.0, 0.015])
def test_the_loop_in_path_coordinates_agrees_with_the_drive_in_the_world(
    plant, curvature
):
    """The same feedback, once on ξ and once on the projection onto a path of constant
    curvature.
    """

    def law(xi, kappa, speed, env):
        del env
        return jnp.stack([2.7 * kappa - 0.05 * xi[0] - 0.4 * xi[1], speed - xi[2]])

    size = len(plant.state_names)
    env = jnp.asarray([0.7, 3.0])
    inputs = jnp.asarray([0.004, 0.1, curvature, 9.0])
    step = jax.jit(
        step_with_law(plant.step, law, plant.control_low, plant.control_high)
    )
    path = path_from_curvature(jnp.full(400, curvature), spacing=0.5)
    world = jnp.zeros(size).at[1].set(0.3).at[3].set(9.5)
    along = without_pose(world[1:])
    progress = jnp.zeros(())

    @jax.jit
    def in_the_world(world, progress):
        heading = world[2] - curvature * progress
        xi = jnp.concatenate(
            [jnp.stack([project(path, world[:2], progress)[1], heading]), world[3:]]
        )
        world = plant.step(world, law(xi, curvature, 9.0, env) + inputs[:2], env)
        return world, *project(path, world[:2], progress + 0.9)

    for _ in range(40):
        world, progress, lateral = in_the_world(world, progress)
        along = step(along, inputs, env)
        np.testing.assert_allclose(along[BODY][0], lateral, atol=2e-4)
    np.testing.assert_allclose(along[BODY][2:], world[3:], atol=2e-4)
    assert not np.any(np.asarray(along[:3]))


@pytest.mark.parametrize("passed", [-0.9, -0.2, 0.4, 3.3, 14.0])
@pytest.mark.parametrize("curvature", [-0.05, 0.0, 0.05])
def test_a_vehicle_is_projected_wherever_a_reference_begins(curvature, passed):
    """On a circle everything is known: a vehicle before the first point, or beyond some."""
    places = 0.9 * jnp.arange(15.0)
    poses = jax.vmap(lambda place: foot(curvature, place))(places)
    points = jnp.concatenate([poses, jnp.full((15, 1), 9.0)], axis=1)
    here = foot(curvature, jnp.asarray(passed))
    beside = compose(here, jnp.asarray([0.0, 0.3, 0.05]))
    state = jnp.append(beside, 9.0)
    xi, along = projected(state, points, curvature_ahead(points))
    np.testing.assert_allclose(xi, [0.3, 0.05, 9.0], atol=2e-3)
    # 0.9 m before the first point the way is that of a tangent.
    np.testing.assert_allclose(along, passed, atol=2e-2)
