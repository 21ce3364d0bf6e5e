"""Poses in the plane: the group laws, wrapped angles, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.geometry import between, compose, wrap_angle

RANDOM = np.random.default_rng(0)
POSES = RANDOM.uniform(-5.0, 5.0, (50, 3)).astype(np.float32)
STEPS = RANDOM.uniform(-2.0, 2.0, (50, 3)).astype(np.float32)
COMPOSE, BETWEEN = (jit(jax.vmap(law)) for law in (compose, between))


def matrix(pose):
    """The homogeneous matrix of a pose, written down independently."""
    x, y, yaw = np.asarray(pose, dtype=np.float64)
    return np.array(
        [[np.cos(yaw), -np.sin(yaw), x], [np.sin(yaw), np.cos(yaw), y], [0.0, 0.0, 1.0]]
    )


def test_composition_is_the_product_of_homogeneous_matrices():
    for pose, step, moved in zip(POSES, STEPS, COMPOSE(POSES, STEPS), strict=True):
        np.testing.assert_allclose(
            matrix(moved), matrix(pose) @ matrix(step), atol=2e-5
        )


def test_between_is_the_product_with_the_inverse_matrix():
    for pose, other, step in zip(POSES, STEPS, BETWEEN(POSES, STEPS), strict=True):
        np.testing.assert_allclose(
            matrix(step), np.linalg.inv(matrix(pose)) @ matrix(other), atol=2e-5
        )


def test_between_does_not_depend_on_the_frame_of_the_world():
    world = np.broadcast_to(np.float32([3.0, -7.0, 2.5]), POSES.shape)
    moved = [COMPOSE(world, poses) for poses in (POSES, STEPS)]
    np.testing.assert_allclose(BETWEEN(*moved), BETWEEN(POSES, STEPS), atol=3e-5)


def test_composition_keeps_counting_turns_and_between_does_not():
    start, step, end = (
        np.float32([[0.0, 0.0, yaw]]) for yaw in (3.0, 1.0, 3.0 + 4 * np.pi + 0.25)
    )
    np.testing.assert_array_equal(COMPOSE(start, step), [[0.0, 0.0, 4.0]])
    np.testing.assert_allclose(BETWEEN(start, end), [[0.0, 0.0, 0.25]], atol=2e-6)


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 3])
def test_wrapping_removes_whole_turns_and_nothing_else(turns):
    angles = jnp.linspace(-3.1, 3.1, 63)
    np.testing.assert_allclose(
        wrap_angle(angles + 2 * jnp.pi * turns), angles, atol=3e-6
    )


def test_wrapped_angles_lie_within_half_a_turn():
    wrapped = wrap_angle(jnp.linspace(-50.0, 50.0, 1001))
    assert float(jnp.max(jnp.abs(wrapped))) <= np.pi + 1e-5


def test_the_gradient_of_wrapping_is_one():
    angles = jnp.asarray([-9.0, -np.pi + 0.01, 0.0, 2.0, 8.0])
    np.testing.assert_array_equal(jax.vmap(jax.grad(wrap_angle))(angles), jnp.ones(5))
