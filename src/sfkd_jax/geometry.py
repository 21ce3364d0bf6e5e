"""Poses, positions and boxes in the plane, and operations on entries of vectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.types import Scalar, State


def wrap_angle(angle: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the same angle in [-π, π], with gradient 1."""
    # round has derivative 0 everywhere: differences of angles stay differentiable.
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def rotate(angle: Float[Array, ""], vector: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Return R(angle) vector."""
    c = jnp.cos(angle)
    s = jnp.sin(angle)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def entrywise(function: Callable[..., Scalar], *vectors: Any) -> Array:
    """Return a function of the entries of vectors, applied entry by entry.

    A planner keeps its samples on the last axis. If XLA saw one operation on whole
    vectors, some of one sample and some shared by all samples, it would transpose the
    arrays in memory. Working on single entries, behind a barrier, keeps the layout.
    """
    entries = [function(*entries) for entries in zip(*vectors, strict=True)]
    return jnp.stack(jax.lax.optimization_barrier(entries))


def put(vector: Array, index: int, value: Array) -> Array:
    """Return the vector with the entry at `index` replaced by `value`.

    It is a selection, because XLA fuses a selection and does not fuse a scatter.
    """
    return jnp.where(np.arange(vector.shape[0]) == index, value, vector)


def compose(
    pose: Float[Array, " 3"], increment: Float[Array, " 3"]
) -> Float[Array, " 3"]:
    """Return g ∘ Δ, the pose after a motion Δ in the frame of g; yaw is not wrapped."""
    position = pose[:2] + rotate(pose[2], increment[:2])
    # Unwrapped, so that the yaw of a run is continuous.
    return jnp.concatenate([position, pose[2:] + increment[2:]])


def between(
    pose: Float[Array, " 3"], pose_next: Float[Array, " 3"]
) -> Float[Array, " 3"]:
    """Return g⁻¹ ∘ g', the motion from g to g' in the frame of g, yaw wrapped."""
    # Differences before the rotation: far from the origin float32 loses less.
    position = rotate(-pose[2], pose_next[:2] - pose[:2])
    return jnp.concatenate([position, wrap_angle(pose_next[2:] - pose[2:])])


def along_arc(
    pose: Float[Array, " 3"], pose_next: Float[Array, " 3"], share: float
) -> Float[Array, " 3"]:
    """Return the pose after a share of the way from g to g', on a circular arc.

    The chord of a share f of an arc that turns by θ has the direction of the whole
    chord, turned back by (1 − f) θ/2; its length is f times that of the whole chord, up
    to θ²/24 of it.
    """
    motion = between(pose, pose_next)
    turned_back = -0.5 * (1.0 - share) * motion[2]
    chord = share * rotate(turned_back, motion[:2])
    return compose(pose, jnp.concatenate([chord, share * motion[2:]]))


def without_pose(body: Float[Array, " body"]) -> State:
    """Return a state with this body, whose pose is (0, 0, 0)."""
    return jnp.concatenate([jnp.zeros(3), body])


def outside_box(
    along: Float[Array, "*shape"],
    left: Float[Array, "*shape"],
    half: tuple[Float[Array, "*shape"], Float[Array, "*shape"]],
) -> Float[Array, ...]:
    """Return the distance of a point from a box [m], negative inside.

    Args:
        along: from the centre of the box to the point, along the box [m].
        left: from the centre of the box to the point, across the box [m].
        half: half of length and width of the box [m].
    """
    along = jnp.abs(along) - half[0]
    left = jnp.abs(left) - half[1]
    # Outside, the distance is to the nearest corner or side. Inside, it is to the
    # nearest side alone, and the first summand vanishes.
    squared = jnp.maximum(along, 0.0) ** 2 + jnp.maximum(left, 0.0) ** 2
    # 1e-12 keeps the derivative of the root finite at 0.
    return jnp.sqrt(squared + 1e-12) + jnp.minimum(jnp.maximum(along, left), 0.0)


FAR = 5e4
"""Distance from the origin [m] up to which float32 resolves positions to 4 mm."""
CELL = 2048.0
"""Spacing of the grid of origins that `relative` chooses from [m]."""


Places: TypeAlias = Float[Array | np.ndarray, "..."]
"""States or points of a reference; their first two entries are p_x and p_y [m]."""


def relative(observation: Places, reference: Places) -> tuple[Places, Places, Places]:
    """Move observation and reference to an origin near the reference.

    This is for positions on Earth in double precision. It must be called outside
    `jax.jit`, which rounds its arguments to float32. Positions within 1 km of the
    origin and float32 positions are returned unchanged.

    Returns:
        The observation, the reference and the origin that was subtracted [m].
    """
    arrays = (observation, reference)
    if any(array.dtype.itemsize < 8 for array in arrays):
        return observation, reference, np.zeros(2)
    xp: Any = jnp if any(isinstance(array, jax.Array) for array in arrays) else np
    first_point = reference[..., 0, :2]
    # The origin jumps on a coarse grid. If it followed the reference continuously, a
    # frozen position sensor would seem to move against the reference.
    finite_point = xp.where(xp.isfinite(first_point), first_point, 0.0)
    origin = CELL * xp.round(finite_point / CELL)
    return (
        shifted(observation, -origin),
        shifted(reference, -origin[..., None, :]),
        origin,
    )


def shifted(states: Any, by: Places) -> Any:
    """Return states whose positions are moved `by`.

    The result is a numpy array of the precision of `by`, if `by` is a numpy array and
    the states are not traced.
    """
    traced = isinstance(states, jax.core.Tracer)  # pyright: ignore
    if isinstance(by, np.ndarray) and not traced:
        xp: Any = np
        states = np.asarray(states, by.dtype)
    else:
        xp = jnp
    return xp.concatenate([states[..., :2] + by, states[..., 2:]], axis=-1)


def is_precise(observation: Places, reference: Places) -> Bool[Array, ""]:
    """Whether positions are so near to the origin that their type resolves them."""
    resolution = jnp.asarray(0.0)
    for places in (observation, reference):
        largest = jnp.max(jnp.abs(places[..., :2]))
        # The resolution depends on the type: float64 reaches the same one at a
        # distance that is 5e8 times larger.
        spacing = largest * jnp.finfo(largest.dtype).eps
        resolution = jnp.maximum(resolution, spacing)
    # `not >` instead of `<=`: a position that is NaN is reported by other checks, not
    # as a lack of precision.
    return ~(resolution > FAR * jnp.finfo(jnp.float32).eps)
