"""Poses in the plane: the group laws, wrapped angles, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
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


def test_composition_is_the_product_of_homogeneous_matrices_and_between_its_inverse():
    moved = COMPOSE(POSES, STEPS)
    for pose, step, after in zip(POSES, STEPS, moved, strict=True):
        product = matrix(pose) @ matrix(step)
        np.testing.assert_allclose(matrix(after), product, atol=2e-5)
    for pose, other, step in zip(POSES, STEPS, BETWEEN(POSES, STEPS), strict=True):
        product = np.linalg.inv(matrix(pose)) @ matrix(other)
        np.testing.assert_allclose(matrix(step), product, atol=2e-5)


def test_composition_keeps_counting_turns_and_between_does_not():
    start, step, end = (
        np.float32([[0.0, 0.0, yaw]]) for yaw in (3.0, 1.0, 3.0 + 4 * np.pi + 0.25)
    )
    np.testing.assert_array_equal(COMPOSE(start, step), [[0.0, 0.0, 4.0]])
    np.testing.assert_allclose(BETWEEN(start, end), [[0.0, 0.0, 0.25]], atol=2e-6)


def test_wrapping_removes_whole_turns_and_nothing_else_and_its_gradient_is_one():
    angles = jnp.linspace(-3.1, 3.1, 63)
    for turns in (-3, -1, 0, 1, 3):
        wrapped = wrap_angle(angles + 2 * jnp.pi * turns)
        np.testing.assert_allclose(wrapped, angles, atol=3e-6)
    many = jnp.linspace(-50.0, 50.0, 1001)
    assert float(jnp.max(jnp.abs(wrap_angle(many)))) <= np.pi + 1e-5
    np.testing.assert_array_equal(jax.vmap(jax.grad(wrap_angle))(many), jnp.ones(1001))
