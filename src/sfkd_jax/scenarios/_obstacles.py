"""Roads with obstacles that are seen late: random courses, and what is seen of them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.lanes import Lane, Obstacles, circles, clearance, lane_along
from sfkd_jax.paths import SPACING, Path, point_at
from sfkd_jax.scenarios._conditions import within
from sfkd_jax.types import Key, Scalar, State

FIRST = 70.0
"""Arc length of the first obstacle at the earliest [m]: out of sight at the start."""
GAP = (40.0, 60.0)
"""Range of the distance from one obstacle to the next [m]."""
PASSED = 15.0
"""Distance behind the car at which an obstacle is out of its way [m]."""
CAR = (2.25, 1.0)
"""Half of length and width of the car [m]."""
IN_VIEW = 4
"""Most obstacles that a controller is shown, the ones that are passed next."""


class Course(NamedTuple):
    """A lane with obstacles, each of which is seen from a distance on.

    Attributes:
        lane: with its path.
        obstacles: all of them, in the order in which they are passed.
        along: arc length of the path beside each [m], rising, (obstacle,).
        view: distance along the path from which each is seen [m], (obstacle,).
    """

    lane: Lane
    obstacles: Obstacles
    along: Float[Array, " obstacle"]
    view: Float[Array, " obstacle"]


def random_course(key: Key, path: Path, *, speed: float = 10.0) -> Course:
    """Draw obstacles up to 1.5 m beside a path, of radius 0.8 m, seen from 60 m on.

    The lane is as wide as three, so that the car may pass each of them on either side.

    Args:
        key: consumed.
        path: open; its last 50 m stay free.
        speed: wanted [m/s].
    """
    gap_key, offset_key = jax.random.split(key)
    length = (path.points.shape[0] - 1) * SPACING
    # As many as the shortest gaps need, and no less than are shown at once.
    count = max(int((length - FIRST) / GAP[0]), IN_VIEW)
    gaps = within(GAP, gap_key, count)
    along = FIRST - GAP[0] + jnp.cumsum(gaps)
    aside = within((-1.5, 1.5), offset_key, count)
    obstacles = circles(beside(path, along, aside), 0.8)
    obstacles = obstacles._replace(present=along <= path.length - 50.0)
    lane = lane_along(path, width=10.5, speed=speed)
    return Course(lane, obstacles, along, jnp.full(count, 60.0))


def beside(
    path: Path, along: Float[Array, " place"], aside: Float[Array, " place"]
) -> Float[Array, "place 2"]:
    """Return positions at arc lengths and distances to the left of a path [m]."""
    point = jax.vmap(point_at, in_axes=(None, 0))(path, along)
    normal = jnp.stack([-jnp.sin(point[:, 2]), jnp.cos(point[:, 2])], axis=1)
    return point[:, :2] + aside[:, None] * normal


def in_view(course: Course, progress: Scalar) -> Obstacles:
    """Return what a car sees: of the obstacles to pass, the next `IN_VIEW`.

    Args:
        course: with at least as many obstacles, present or not.
        progress: arc length of the car [m].
    """
    ahead = course.along - progress
    last = course.along.shape[0] - IN_VIEW
    first = jnp.clip(jnp.sum(ahead < -PASSED), 0, last)
    present = course.obstacles.present & (ahead <= course.view)
    seen = course.obstacles._replace(present=present)
    # A window of constant size: a controller is compiled once for all courses.
    return jax.tree.map(
        lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, IN_VIEW), seen
    )


def car_clearance(obstacles: Obstacles, state: State) -> Scalar:
    """Return how far a car, a box of `CAR`, is from the nearest obstacle now [m]."""
    direction = jnp.stack([jnp.cos(state[2]), jnp.sin(state[2])])
    return jnp.min(clearance(obstacles, state[:2], direction=direction, half=CAR))
