"""The reference as a plan: lateral moves, obstacles, and what may be committed."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import jit

from sfkd_jax.lanes import Obstacles, circles, clearance
from sfkd_jax.paths import quintic

MOVE = jit(jax.vmap(quintic, in_axes=(None, None, None, 0)))


def test_a_lateral_move_joins_its_ends_and_its_derivatives_are_those_of_its_offset():
    start, target, length = jnp.asarray([0.4, -0.05, 0.008]), 2.0, 31.0
    s = np.linspace(0.0, 40.0, 4001, dtype=np.float32)
    move = np.asarray(MOVE(start, target, length, s), np.float64)
    np.testing.assert_allclose(move[0, :3], start, atol=1e-6)
    np.testing.assert_allclose(move[s >= 31.0], [[2.0, 0, 0, 0]] * 901, atol=2e-6)
    before = move[s < 31.0]
    np.testing.assert_allclose(before[-1, :3], [2.0, 0.0, 0.0], atol=1e-4)
    for order in range(3):
        slope = np.gradient(before[:, order], 0.01)[1:-1]
        np.testing.assert_allclose(slope, before[1:-1, order + 1], atol=2e-3)


def test_distances_from_boxes_circles_and_things_that_move():
    still = circles(jnp.asarray([[3.0, 4.0], [0.0, -2.0]]), 1.0)
    np.testing.assert_allclose(clearance(still, jnp.zeros(2)), [4.0, 1.0], atol=1e-5)
    turned = Obstacles(
        position=jnp.asarray([[[4.0, 0.0], [4.0, 2.0], [4.0, 4.0]]] * 2),
        yaw=jnp.asarray([np.pi / 2, 0.0]),
        half=jnp.asarray([[2.0, 1.0]] * 2),
        radius=jnp.asarray([0.5, 0.0]),
        present=jnp.asarray([True, False]),
    )
    for step, distance in ((0.0, 2.5), (0.5, 2.5), (7.0, np.hypot(3.0, 2.0) - 0.5)):
        found = clearance(turned, jnp.zeros(2), step)
        np.testing.assert_allclose(found, [distance, np.inf], atol=1e-5)
    assert clearance(turned, jnp.asarray([4.0, 0.2]))[0] < -1.0
