"""A lane and what stands or moves in it."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.paths import Path
from sfkd_jax.types import Scalar


class Lane(NamedTuple):
    """A road with its edges and the speed that is wanted on it.

    Attributes:
        path: centre line.
        left: distance from it to the left edge [m], positive, (point,).
        right: to the right edge [m], positive, (point,).
        speed: wanted [m/s], (point,).
    """

    path: Path
    left: Float[Array, " point"]
    right: Float[Array, " point"]
    speed: Float[Array, " point"]


class Obstacles(NamedTuple):
    """Boxes with round corners; a circle is a point with a radius.

    Attributes:
        position: of the centres [m], (obstacle, step, 2): one step for what stands
            still; else predicted at 0, dt, 2 dt, …, and it stays at the last one.
        yaw: of the boxes [rad], (obstacle,).
        half: half of length and width [m], (obstacle, 2).
        radius: added all around [m], (obstacle,).
        present: whether the row is an obstacle, (obstacle,); the others are padding.
    """

    position: Float[Array, "obstacle step 2"]
    yaw: Float[Array, " obstacle"]
    half: Float[Array, "obstacle 2"]
    radius: Float[Array, " obstacle"]
    present: Bool[Array, " obstacle"]

    def at(self, step: Scalar | float) -> Float[Array, "obstacle 2"]:
        """Return where they are after a number of steps, which may be a fraction."""
        last = self.position.shape[1] - 1
        if last == 0:
            return self.position[:, 0]
        step = jnp.clip(step, 0.0, last)
        index = jnp.minimum(jnp.floor(step).astype(int), last - 1)
        before, after = self.position[:, index], self.position[:, index + 1]
        return before + (step - index) * (after - before)


def lane_along(path: Path, *, width: float = 7.0, speed: float = 10.0) -> Lane:
    """Return a lane of constant width and speed around a path.

    Args:
        path: centre line.
        width: from edge to edge [m].
        speed: wanted [m/s].
    """
    every = jnp.ones(path.points.shape[0])
    return Lane(path, 0.5 * width * every, 0.5 * width * every, speed * every)


def circles(
    position: Float[Array, "obstacle 2"], radius: Float[Array, " obstacle"] | float
) -> Obstacles:
    """Return circles that stand still.

    Args:
        position: of the centres [m].
        radius: of all, or of each [m].
    """
    position = jnp.asarray(position, dtype=float)
    each = jnp.zeros(position.shape[0])
    present = jnp.ones(position.shape[0], bool)
    size = jnp.zeros_like(position)
    return Obstacles(position[:, None], each, size, each + radius, present)


def outside_box(
    away: Float[Array, "*shape 2"],
    yaw: Float[Array, "*shape"],
    half: Float[Array, "*shape 2"],
) -> Float[Array, "*shape"]:
    """Return the distance from a box [m], negative inside.

    Args:
        away: from its centre to the point [m].
        yaw: of the box [rad].
        half: half of length and width [m].
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    along = cos * away[..., 0] + sin * away[..., 1]
    left = cos * away[..., 1] - sin * away[..., 0]
    beyond = jnp.abs(jnp.stack([along, left], axis=-1)) - half
    # Outside: distance to the nearest corner or side; inside: to the nearest side.
    # Finite derivatives in the corner too.
    corner = jnp.sqrt(jnp.sum(jnp.maximum(beyond, 0.0) ** 2, axis=-1) + 1e-12)
    return corner + jnp.minimum(jnp.max(beyond, axis=-1), 0.0)


def clearance(
    obstacles: Obstacles, position: Float[Array, " 2"], step: Scalar | float = 0.0
) -> Float[Array, " obstacle"]:
    """Return the distance of a point from each obstacle [m], negative inside.

    Infinite where none is present.

    Args:
        obstacles: (obstacle,).
        position: of the point [m].
        step: number of steps from now, which may be a fraction.
    """
    away = position - obstacles.at(step)
    distance = outside_box(away, obstacles.yaw, obstacles.half) - obstacles.radius
    return jnp.where(obstacles.present, distance, jnp.inf)


def body_clearance(
    obstacles: Obstacles,
    position: Float[Array, " 2"],
    direction: Float[Array, " 2"],
    half: tuple[float, float],
    step: Scalar | float = 0.0,
) -> Float[Array, " obstacle"]:
    """Return how far a box is from each obstacle at least [m], negative inside.

    Exact for circles. Of two boxes it is the larger distance of one from the smallest
    box that holds the other and is parallel to the first.

    Args:
        obstacles: (obstacle,).
        position: of the centre of the box [m].
        direction: cosine and sine of its yaw.
        half: half of its length and width [m].
        step: number of steps from now, which may be a fraction.
    """
    x, y = (obstacles.at(step) - position).T
    theirs = jnp.cos(obstacles.yaw), jnp.sin(obstacles.yaw)
    cos, sin = direction[0], direction[1]
    parallel = jnp.abs(theirs[0] * cos + theirs[1] * sin)
    across = jnp.abs(theirs[1] * cos - theirs[0] * sin)
    length, width = obstacles.half[:, 0], obstacles.half[:, 1]

    def apart(axis: tuple[Array, Array], along: Array, left: Array) -> Array:
        """The distance of a point from a box in the frame of an axis."""
        beyond_along = jnp.abs(axis[0] * x + axis[1] * y) - along
        beyond_left = jnp.abs(axis[0] * y - axis[1] * x) - left
        outside = (
            jnp.maximum(beyond_along, 0.0) ** 2 + jnp.maximum(beyond_left, 0.0) ** 2
        )
        inside = jnp.minimum(jnp.maximum(beyond_along, beyond_left), 0.0)
        return jnp.sqrt(outside) + inside

    ours = apart(
        (cos, sin),
        half[0] + length * parallel + width * across,
        half[1] + length * across + width * parallel,
    )
    other = apart(
        theirs,
        length + half[0] * parallel + half[1] * across,
        width + half[0] * across + half[1] * parallel,
    )
    distance = jnp.maximum(ours, other) - obstacles.radius
    return jnp.where(obstacles.present, distance, jnp.inf)
