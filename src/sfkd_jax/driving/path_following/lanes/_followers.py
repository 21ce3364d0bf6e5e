"""Who follows the car in its own track, and from when on he does not."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.lanes import Obstacles, place_at
from sfkd_jax.driving.path_following.lanes._judging import Class
from sfkd_jax.driving.path_following.lanes._reference import sampling
from sfkd_jax.driving.paths import Lap, Path, point_at
from sfkd_jax.types import Scalar

NEVER = 1e9
"""Step that is not reached. Planners refuse a situation that is not finite."""


def counts_from(
    path: Path,
    obstacles: Obstacles,
    progress: Scalar,
    offset: Scalar,
    limits: Class,
    *,
    samples: int,
    spacing: float,
) -> Float[Array, " obstacle"]:
    """Return the step from which on each obstacle counts as one.

    Who is behind the car and in its track keeps his distance himself, as the rules of
    the road ask of him: his prediction would drive through the car. He counts from the
    predicted step on in which he has left the track, to overtake. All others count from
    now on.

    Args:
        path: of the lane.
        obstacles: with their predicted positions.
        progress: of the car along the path [m].
        offset: of the reference from the path where the car is [m].
        limits: with the size of the car and its corridor.
        samples: of the path ahead of the car, and as many behind it.
        spacing: smallest distance of two samples [m].
    """
    distance, _ = sampling(path, spacing)
    along = progress + distance * (jnp.arange(2 * samples) - samples)
    if not isinstance(path, Lap):
        along = jnp.clip(along, 0.0, path.length)
    points = jax.vmap(partial(point_at, path))(along)
    steps = jnp.arange(obstacles.position.shape[1])

    def of(obstacle: Obstacles) -> Scalar:
        place = jax.vmap(partial(place_at, obstacle))(steps)
        away = [at[:, None] - points[:, axis] for axis, at in enumerate(place)]
        nearest = jnp.argmin(jnp.hypot(*away), axis=1)
        x, y = (axis[steps, nearest] for axis in away)
        yaw = points[nearest, 2]
        ahead = along[nearest] + jnp.cos(yaw) * x + jnp.sin(yaw) * y - progress
        aside = jnp.cos(yaw) * y - jnp.sin(yaw) * x - offset
        turned = obstacle.yaw - yaw
        length, width = obstacle.half
        half = jnp.abs(jnp.sin(turned)) * length + jnp.abs(jnp.cos(turned)) * width
        room = half + obstacle.radius + limits.half[1] + limits.margin
        in_track = jnp.abs(aside) < room
        follows = (ahead[0] < -limits.half[0]) & in_track[0]
        leaves = jnp.where(jnp.all(in_track), NEVER, jnp.argmin(in_track))
        return jnp.where(follows, leaves, 0.0)

    return jax.vmap(of)(obstacles)
