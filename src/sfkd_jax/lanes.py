"""A lane and what stands or moves in it."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.paths import Path


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

    position: Float[Array, "*obstacle step 2"]
    yaw: Float[Array, "*obstacle"]
    half: Float[Array, "*obstacle 2"]
    radius: Float[Array, "*obstacle"]
    present: Bool[Array, "*obstacle"]


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
    """Return circles that stand still, from their centres and radii [m]."""
    position = jnp.asarray(position, dtype=float)
    none = jnp.zeros(position.shape[0])
    size = jnp.zeros_like(position)
    return Obstacles(position[:, None], none, size, none + radius, none == 0.0)


def outside_box(
    along: Float[Array, "*shape"],
    left: Float[Array, "*shape"],
    half: tuple[Float[Array, "*shape"], Float[Array, "*shape"]],
) -> Float[Array, ...]:
    """Return the distance of a point from a box [m], negative inside.

    Args:
        along: from the centre to the point, along the box [m].
        left: across it [m].
        half: half of length and width [m].
    """
    along = jnp.abs(along) - half[0]
    left = jnp.abs(left) - half[1]
    # Outside: distance to the nearest corner or side; inside: to the nearest side.
    corner = jnp.maximum(along, 0.0) ** 2 + jnp.maximum(left, 0.0) ** 2
    # Finite derivatives in the corner too.
    return jnp.sqrt(corner + 1e-12) + jnp.minimum(jnp.maximum(along, left), 0.0)


def clearance(
    obstacles: Obstacles,
    position: Float[Array, "2 ..."],
    step: Float[Array, ...] | float = 0.0,
    *,
    direction: Float[Array, "2 ..."] | tuple[float, float] = (1.0, 0.0),
    half: tuple[float, float] = (0.0, 0.0),
) -> Float[Array, "obstacle ..."]:
    """Return how far a box is at least from each obstacle [m], negative inside.

    Exact for circles; of two boxes it is the distance of one from the smallest parallel
    one around the other, the larger of both. Infinite where no obstacle is present.

    Args:
        obstacles: (obstacle,).
        position: of the centre of the box [m].
        step: number of steps from now, which may be a fraction.
        direction: cosine and sine of the yaw of the box.
        half: half of its length and width [m]; 0 for a point.
    """
    return jax.vmap(
        lambda one: distance(one, place_at(one, step), position, direction, half)
    )(obstacles)


def place_at(
    obstacle: Obstacles, step: Float[Array, ...] | float
) -> tuple[Float[Array, ...], Float[Array, ...]]:
    """Return where one obstacle, a row of `Obstacles`, is after some steps [m]."""
    places = obstacle.position
    last = obstacle.position.shape[0] - 1
    if not last:
        # What stands still is not looked up for every sample.
        return places[0, 0], places[0, 1]
    step = jnp.clip(step, 0.0, last)
    index = jnp.floor(step).astype(int)
    gone = jnp.diff(places, axis=0, append=places[-1:])
    columns = *places.T, *gone.T
    x, y, dx, dy = (column.at[index].get(mode="clip") for column in columns)
    share = step - index
    return x + share * dx, y + share * dy


def beside(
    obstacles: Obstacles,
    line: Float[Array, "2 point"],
    direction: Float[Array, "2 point"],
    step: Float[Array, " point"],
) -> tuple[Int[Array, " obstacle"], Float[Array, " obstacle"]]:
    """Return the points of a line that are nearest to obstacles, and how far left [m].

    Args:
        obstacles: (obstacle,).
        line: positions [m].
        direction: cosine and sine of its yaw.
        step: number of steps from now until each point is reached.
    """
    x, y = jax.vmap(lambda one: place_at(one, step))(obstacles)
    x, y = (place.reshape(len(place), -1) for place in (x, y))
    x = x - line[0]
    y = y - line[1]
    nearest = jnp.argmin(jnp.hypot(x, y), axis=1)
    left = direction[0] * y - direction[1] * x
    return nearest, left[jnp.arange(len(left)), nearest]


def distance(
    obstacle: Obstacles,
    place: tuple[Float[Array, ...], Float[Array, ...]],
    position: Float[Array, "2 ..."],
    direction: Float[Array, "2 ..."] | tuple[float, float],
    half: tuple[float, float],
) -> Float[Array, ...]:
    """Return the `clearance` from one obstacle, a row of `Obstacles`, at its place."""
    x, y = (a - b for a, b in zip(place, position, strict=True))
    (cos, sin) = direction
    (length, width) = obstacle.half
    their_cos = jnp.cos(obstacle.yaw)
    their_sin = jnp.sin(obstacle.yaw)
    parallel = jnp.abs(their_cos * cos + their_sin * sin)
    across = jnp.abs(their_sin * cos - their_cos * sin)
    # Half of each box, and of the smallest one around the other that is parallel to it.
    ours, theirs = (
        (a + parallel * c + across * d, b + parallel * d + across * c)
        for (a, b), (c, d) in ((half, (length, width)), ((length, width), half))
    )
    turned = their_cos * x + their_sin * y, their_cos * y - their_sin * x
    nearest = jnp.maximum(
        outside_box(cos * x + sin * y, cos * y - sin * x, ours),
        outside_box(*turned, theirs),
    )
    return jnp.where(obstacle.present, nearest - obstacle.radius, jnp.inf)


def finite(
    lane: Lane, obstacles: Obstacles
) -> tuple[tuple[Lane, Obstacles], Bool[Array, ""]]:
    """Return a finite scene, and whether it was one; padding may hold anything."""
    points = lane.path.points.shape[0]
    count = obstacles.position.shape[0]
    sizes = {leaf.shape for leaf in (lane.left, lane.right, lane.speed)}
    rows = {leaf.shape[0] for leaf in obstacles}
    if sizes != {(points,)} or rows != {count} or obstacles.position.ndim != 3:
        raise ValueError(
            f"left, right and speed of a lane have the shape ({points},) of its path, "
            f"got {sizes}; obstacles (obstacle, …), their position (obstacle, step, "
            f"2), got {[leaf.shape for leaf in obstacles]}"
        )

    def shown(leaf: Array) -> Array:
        present = obstacles.present.reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(present, leaf, jnp.zeros_like(leaf))

    scene = lane, Obstacles(*map(shown, obstacles))
    leaves = jax.tree.leaves(scene)
    clean = jnp.all(jnp.asarray([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))
    whole = partial(jnp.nan_to_num, posinf=0.0, neginf=0.0)
    return jax.tree.map(whole, scene), clean
