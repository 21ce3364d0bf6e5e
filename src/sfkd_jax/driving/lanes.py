"""Lanes, obstacles that stand or move in them, and the clearance from obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.driving.paths import Path
from sfkd_jax.geometry import outside_box


class Lane(NamedTuple):
    """A road with its edges and the speed that is wanted on it.

    Attributes:
        path: centre line.
        left: distance from the centre line to the left edge, positive [m], (point,).
        right: distance from the centre line to the right edge, positive [m], (point,).
        speed: wanted speed [m/s], (point,).
    """

    path: Path
    left: Float[Array, " point"]
    right: Float[Array, " point"]
    speed: Float[Array, " point"]


class Obstacles(NamedTuple):
    """Boxes with round corners. A circle is a box of size 0 with a radius.

    Attributes:
        position: of the centres [m], (obstacle, step, 2). An obstacle that stands still
            has one step. Others have predicted positions at 0, dt, 2 dt, … and go on
            from the last one with their last velocity.
        yaw: of the boxes [rad], (obstacle,).
        half: half of length and width [m], (obstacle, 2).
        radius: added all around a box [m], (obstacle,).
        present: whether a row is an obstacle, (obstacle,); other rows are padding.
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
    ones = jnp.ones(path.points.shape[0])
    return Lane(
        path=path,
        left=0.5 * width * ones,
        right=0.5 * width * ones,
        speed=speed * ones,
    )


def circles(
    position: Float[Array, "obstacle 2"], radius: Float[Array, " obstacle"] | float
) -> Obstacles:
    """Return circles that stand still, from their centres and radii [m]."""
    position = jnp.asarray(position, dtype=float)
    zeros = jnp.zeros(position.shape[0])
    return Obstacles(
        position=position[:, None],
        yaw=zeros,
        half=jnp.zeros_like(position),
        radius=zeros + radius,
        present=zeros == 0.0,
    )


def padded(obstacles: Obstacles, count: int, steps: int | None = None) -> Obstacles:
    """Return obstacles in a fixed number of rows, of which the last are not present.

    A compiled program is made for one number of rows and of predicted positions, and
    compiled anew for another. Concrete arrays are padded on the host, where nothing is
    compiled.

    Args:
        obstacles: any number of them, also none.
        count: number of rows.
        steps: number of predicted positions of each; None for as many as there are. An
            obstacle goes on with its last velocity, as it would without the padding.

    Raises:
        ValueError: there are more obstacles than rows, or more positions than steps.
    """
    rows, known = obstacles.position.shape[:2]
    steps = known if steps is None else steps
    if rows > count:
        raise ValueError(f"{rows} obstacles do not fit in {count} rows: pass more rows")
    if known > steps:
        raise ValueError(
            f"{known} predicted positions do not fit in {steps} steps: pass more steps"
        )
    tracer: Any = jax.core.Tracer  # pyright: ignore
    traced = any(isinstance(leaf, tracer) for leaf in obstacles)
    # Of either package; pyright knows none that is both.
    xp: Any = jnp if traced else np

    def with_zeros(leaf: Any) -> Any:
        leaf = xp.asarray(leaf)
        zeros = xp.zeros((count - rows, *leaf.shape[1:]), leaf.dtype)
        return xp.concatenate([leaf, zeros])

    # Of `present`, 0 is False.
    wide = Obstacles(*map(with_zeros, obstacles))
    last = wide.position[:, -1:]
    velocity = last - wide.position[:, -2:-1] if known > 1 else xp.zeros_like(last)
    later = xp.arange(1, steps - known + 1, dtype=last.dtype)[:, None]
    position = xp.concatenate([wide.position, last + later * velocity], axis=1)
    return Obstacles(*map(jnp.asarray, wide._replace(position=position)))


def clearance(
    obstacles: Obstacles,
    position: Float[Array, "2 ..."],
    step: Float[Array, ...] | float = 0.0,
    *,
    direction: Float[Array, "2 ..."] | tuple[float, float] = (1.0, 0.0),
    half: tuple[float, float] = (0.0, 0.0),
) -> Float[Array, "obstacle ..."]:
    """Return a lower bound of the distance of a box from each obstacle [m].

    It is negative inside, exact for circles, and infinite where no obstacle is present.
    For two boxes, each is compared with the smallest box around the other that is
    parallel to it, and the larger of both distances is returned.

    Args:
        obstacles: (obstacle,).
        position: of the centre of the box [m].
        step: number of steps from now, which may be a fraction.
        direction: cosine and sine of the yaw of the box.
        half: half of its length and width [m]; 0 for a point.
    """

    def to_obstacle(obstacle: Obstacles) -> Float[Array, ...]:
        place = place_at(obstacle, step)
        return distance(obstacle, place, position, direction, half)

    return jax.vmap(to_obstacle)(obstacles)


def place_at(
    obstacle: Obstacles, step: Float[Array, ...] | float
) -> tuple[Float[Array, ...], Float[Array, ...]]:
    """Return where an obstacle, a row of `Obstacles`, is after some steps [m]."""
    places = obstacle.position
    last = places.shape[0] - 1
    if last == 0:
        # An obstacle that stands still is not looked up for every sample.
        return places[0, 0], places[0, 1]
    step = jnp.maximum(step, 0.0)
    # Beyond the last position the share is above 1: the last move goes on.
    index = jnp.clip(jnp.floor(step), 0, last - 1).astype(int)
    moves = jnp.diff(places, axis=0)
    columns = (*places.T, *moves.T)
    x, y, dx, dy = (column.at[index].get(mode="clip") for column in columns)
    share = step - index
    return x + share * dx, y + share * dy


def beside(
    obstacles: Obstacles,
    line: Float[Array, "2 point"],
    direction: Float[Array, "2 point"],
    step: Float[Array, " point"],
) -> tuple[Int[Array, " obstacle"], Float[Array, " obstacle"]]:
    """Return which point of a line is nearest to each obstacle, and how far left it is.

    Args:
        obstacles: (obstacle,).
        line: positions [m].
        direction: cosine and sine of the yaw of the line at each point.
        step: number of steps from now until each point is reached.

    Returns:
        The index of the nearest point, and the distance of the obstacle to the left of
        the line there [m].
    """
    x, y = jax.vmap(partial(place_at, step=step))(obstacles)
    x = x.reshape(len(x), -1) - line[0]
    y = y.reshape(len(y), -1) - line[1]
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
    """Return the `clearance` of a box from an obstacle, a row of `Obstacles`.

    Args:
        obstacle: one.
        place: x and y of its centre [m].
        position: of the centre of the box [m].
        direction: cosine and sine of the yaw of the box.
        half: half of length and width of the box [m].
    """
    box_x, box_y = position
    x = place[0] - box_x
    y = place[1] - box_y
    cos, sin = direction
    length, width = obstacle.half
    their_cos = jnp.cos(obstacle.yaw)
    their_sin = jnp.sin(obstacle.yaw)
    cos_between = jnp.abs(their_cos * cos + their_sin * sin)
    sin_between = jnp.abs(their_sin * cos - their_cos * sin)

    def half_of_sum(
        box: Sequence[Any], other: Sequence[Any]
    ) -> tuple[Float[Array, ...], Float[Array, ...]]:
        """Half of the size of `box`, grown by a parallel box around `other`."""
        return (
            box[0] + cos_between * other[0] + sin_between * other[1],
            box[1] + cos_between * other[1] + sin_between * other[0],
        )

    # The vector between the centres, along and across each of the two boxes.
    from_box = outside_box(
        cos * x + sin * y, cos * y - sin * x, half_of_sum(half, (length, width))
    )
    from_obstacle = outside_box(
        their_cos * x + their_sin * y,
        their_cos * y - their_sin * x,
        half_of_sum((length, width), half),
    )
    nearest = jnp.maximum(from_box, from_obstacle)
    return jnp.where(obstacle.present, nearest - obstacle.radius, jnp.inf)


def finite(
    lane: Lane, obstacles: Obstacles
) -> tuple[tuple[Lane, Obstacles], Bool[Array, ""]]:
    """Return a scene in which every number is finite, and whether it was so before.

    Numbers that are not finite become 0. Rows of padding may hold anything. Without any
    obstacle there is one row of padding.

    Raises:
        ValueError: the shapes of lane and obstacles do not fit together.
    """
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

    # Comparisons with each of no obstacles would have no result.
    obstacles = padded(obstacles, max(count, 1))

    def without_padding(leaf: Array) -> Array:
        present = obstacles.present.reshape(-1, *[1] * (leaf.ndim - 1))
        return jnp.where(present, leaf, jnp.zeros_like(leaf))

    scene = (lane, Obstacles(*map(without_padding, obstacles)))
    leaves = jax.tree.leaves(scene)
    clean = jnp.all(jnp.asarray([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))
    zero_for_infinite = partial(jnp.nan_to_num, posinf=0.0, neginf=0.0)
    return jax.tree.map(zero_for_infinite, scene), clean
