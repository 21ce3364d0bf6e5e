"""Poses in the plane: the group laws, wrapped angles, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.se2 import between, compose, rotate, wrap_angle

POSES = jax.random.uniform(jax.random.key(0), (50, 3), minval=-5.0, maxval=5.0)
STEPS = jax.random.uniform(jax.random.key(1), (50, 3), minval=-2.0, maxval=2.0)


def matrix(pose):
    """The homogeneous matrix of a pose, written down independently."""
    x, y, yaw = np.asarray(pose, dtype=np.float64)
    return np.array([[np.cos(yaw), -np.sin(yaw), x], [np.sin(yaw), np.cos(yaw), y], [0.0, 0.0, 1.0]])


def test_composition_is_the_product_of_homogeneous_matrices():
    for pose, step in zip(POSES, STEPS, strict=True):
        expected = matrix(pose) @ matrix(step)
        np.testing.assert_allclose(matrix(compose(pose, step)), expected, atol=2e-5)


def test_between_is_the_product_with_the_inverse_matrix():
    for pose, other in zip(POSES, STEPS, strict=True):
        expected = np.linalg.inv(matrix(pose)) @ matrix(other)
        np.testing.assert_allclose(matrix(between(pose, other)), expected, atol=2e-5)


def test_between_undoes_composition():
    moved = jax.vmap(compose)(POSES, STEPS)
    np.testing.assert_allclose(jax.vmap(between)(POSES, moved), STEPS, atol=1e-5)


def test_composition_is_associative():
    left = jax.vmap(compose)(jax.vmap(compose)(POSES, STEPS), STEPS[::-1])
    right = jax.vmap(compose)(POSES, jax.vmap(compose)(STEPS, STEPS[::-1]))
    np.testing.assert_allclose(left, right, atol=2e-5)


def test_between_does_not_depend_on_the_frame_of_the_world():
    world = jnp.asarray([3.0, -7.0, 2.5])
    moved = [jax.vmap(compose, in_axes=(None, 0))(world, poses) for poses in (POSES, STEPS)]
    np.testing.assert_allclose(jax.vmap(between)(*moved), jax.vmap(between)(POSES, STEPS), atol=3e-5)


def test_composition_keeps_counting_turns_and_between_does_not():
    assert compose(jnp.asarray([0.0, 0.0, 3.0]), jnp.asarray([0.0, 0.0, 1.0]))[2] == 4.0
    turned = between(jnp.asarray([0.0, 0.0, 3.0]), jnp.asarray([0.0, 0.0, 3.0 + 4 * np.pi + 0.25]))
    np.testing.assert_allclose(turned, [0.0, 0.0, 0.25], atol=2e-6)


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 3])
def test_wrapping_removes_whole_turns_and_nothing_else(turns):
    angles = jnp.linspace(-3.1, 3.1, 63)
    np.testing.assert_allclose(wrap_angle(angles + 2 * jnp.pi * turns), angles, atol=3e-6)


def test_wrapped_angles_lie_within_half_a_turn():
    wrapped = wrap_angle(jnp.linspace(-50.0, 50.0, 1001))
    assert float(jnp.max(jnp.abs(wrapped))) <= np.pi + 1e-5


def test_the_gradient_of_wrapping_is_one():
    angles = jnp.asarray([-9.0, -np.pi + 0.01, 0.0, 2.0, 8.0])
    np.testing.assert_array_equal(jax.vmap(jax.grad(wrap_angle))(angles), jnp.ones(5))


def test_rotation_keeps_length_and_turns_by_the_angle():
    np.testing.assert_allclose(rotate(jnp.asarray(jnp.pi / 2), jnp.asarray([1.0, 0.0])), [0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(jnp.linalg.norm(rotate(jnp.asarray(0.7), jnp.asarray([3.0, 4.0]))), 5.0, rtol=1e-6)
