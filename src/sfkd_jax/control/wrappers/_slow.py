"""The same reference at a lower speed."""

from __future__ import annotations

import jax.numpy as jnp

from sfkd_jax.geometry import between, compose, wrap_angle
from sfkd_jax.types import POSE, Reference, Scalar


def slow_down(reference: Reference, factor: float | Scalar) -> Reference:
    """Follow the same path at a lower speed, linear between its points.

        g'(t) = g(c t),   v'(t) = c v(c t)

    Args:
        reference: x, y, yaw, speed of each step.
        factor: c in (0, 1].
    """
    horizon = reference.shape[0]
    # reference[0] is the target one step from now. The target now is one step back
    # along the circle through the first two poses. The pose of the vehicle would draw
    # its error into the path.
    now = compose(reference[0, POSE], between(reference[1, POSE], reference[0, POSE]))
    points = jnp.concatenate([jnp.append(now, reference[0, 3])[None], reference])
    times = factor * jnp.arange(1, horizon + 1)
    index = jnp.minimum(jnp.floor(times).astype(int), horizon - 1)
    start, step = points[index], points[index + 1] - points[index]
    step = step.at[:, 2].set(wrap_angle(step[:, 2]))
    return (start + (times - index)[:, None] * step).at[:, 3].multiply(factor)
