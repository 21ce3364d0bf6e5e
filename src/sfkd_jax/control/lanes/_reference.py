"""A reference beside the centre line, on the samples of the road.

As the car drives on, the arrays move by whole samples, and nothing is rounded.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.lanes import Lane
from sfkd_jax.paths import Lap, Path, point_at
from sfkd_jax.types import Reference, Scalar

BEHIND = 2
"""Samples behind the car: the projection of a measured position also goes back."""
SPLICE = BEHIND + 2
"""The first sample at which a new plan may differ: it lies ahead of the car."""
STANDS = 1e-3
"""Speed below which nothing moves [m/s]."""


class Committed(NamedTuple):
    """The reference that the car follows."""

    # Of the first sample of the road; negative ones are before its start.
    index: Int[Array, ""]
    # d [m], d' [-], d'' [1/m] at each sample, (3, sample).
    move: Float[Array, "3 sample"]
    # v² at each sample [m²/s²], between two of them linear in s: an acceleration that
    # is constant.
    square: Float[Array, " sample"]

    def at(self, index: Int[Array, ""], most: Float[Array, " sample"]) -> Committed:
        """Return the same reference from another sample on, its last values held.

        `most` is v² there, which what is held keeps [m²/s²].
        """
        count = self.square.shape[0]
        rows = jnp.arange(count) + index - self.index
        held = jnp.clip(rows, 0, count - 1)
        move = self.move[:, held]
        move = move.at[1:].set(jnp.where(rows < count, move[1:], 0.0))
        square = self.square[held]
        square = jnp.where(rows < count, square, jnp.minimum(square, most))
        return Committed(index, move, square)


class RoadAhead(NamedTuple):
    """Samples of the road, (…, sample)."""

    position: Float[Array, "2 sample"]  # [m], (2, sample)
    direction: Float[Array, "2 sample"]  # cosine and sine of the yaw, (2, sample)
    curvature: Float[Array, " sample"]  # κ [1/m]
    slope: Float[Array, " sample"]  # dκ/ds [1/m²]
    left: Float[Array, " sample"]  # to the left edge [m]
    right: Float[Array, " sample"]  # to the right edge [m]
    wanted: Float[Array, " sample"]  # v² [m²/s²], within the accelerations
    spacing: Scalar  # of the samples [m]


class Curve(NamedTuple):
    """A reference in the world and in time, at the samples of the road."""

    position: Float[Array, "2 sample"]  # [m], (2, sample)
    direction: Float[Array, "2 sample"]  # cosine and sine of its yaw, (2, sample)
    curvature: Float[Array, " sample"]  # of the curve itself [1/m]
    stretch: Float[Array, " sample"]  # its length per length of the road
    lengths: Float[Array, " gap"]  # from each sample to the next [m]
    times: Float[Array, " sample"]  # when it is there, from the first sample on [s]
    reached: Bool[Array, " sample"]  # whether it ever is


def road_ahead(
    lane: Lane, index: Int[Array, ""], count: int, accelerations: tuple[float, float]
) -> RoadAhead:
    """Return the samples of a lane from one on; an open path ends at speed 0.

    `accelerations` are the largest, and the largest deceleration [m/s²].
    """
    path = lane.path
    last = lane.path.points.shape[0] - 1
    numbers = index + jnp.arange(count)
    rows = jnp.clip(numbers, 0, last)
    ended = numbers >= last
    if isinstance(path, Lap):
        rows = numbers % last
        ended = False
    squares = jnp.where(ended, 0.0, lane.speed[rows] ** 2)
    # From behind: at each sample what can still slow down to all that follow.
    ahead = 2.0 * path.spacing * jnp.arange(count)
    gained, lost = (most * ahead for most in accelerations)
    wanted = jax.lax.cummin(squares + lost, reverse=True) - lost
    wanted = jax.lax.cummin(wanted - gained) + gained
    x, y, yaw, curvature = path.points[rows].T
    return RoadAhead(
        position=jnp.stack([x, y]),
        direction=jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]),
        curvature=curvature,
        slope=jnp.asarray(jnp.gradient(curvature)) / path.spacing,
        left=lane.left[rows],
        right=lane.right[rows],
        wanted=wanted,
        spacing=path.spacing,
    )


def curve(road: RoadAhead, plan: Committed) -> Curve:
    """Return a reference in the world, exact beside its road.

    p = p_r + d n,   dp/ds = (1 − κ_r d) t + d' n,   κ = dψ/ds / |dp/ds|
    dψ/ds = κ_r + (d'' (1 − κ_r d) + d' (κ_r' d + κ_r d')) / |dp/ds|²
    """
    d, first, second = plan.move
    bend = road.curvature
    cos, sin = road.direction
    scale = 1.0 - bend * d
    square = scale**2 + first**2
    stretch = jnp.sqrt(square)
    turn = bend + (second * scale + first * (road.slope * d + bend * first)) / square
    forward = scale / stretch
    aside = first / stretch
    lengths = 0.5 * road.spacing * (stretch[1:] + stretch[:-1])
    speed = jnp.sqrt(plan.square)
    both = speed[1:] + speed[:-1]
    # Where it stands it stays: hours, and not infinity, of which sums make NaN.
    gaps = 2.0 * lengths / jnp.maximum(both, STANDS)
    # Behind the car it has been.
    stood = (both <= STANDS) & (jnp.arange(both.shape[0]) >= BEHIND)
    return Curve(
        position=road.position + d * jnp.stack([-sin, cos]),
        direction=jnp.stack([forward * cos - aside * sin, forward * sin + aside * cos]),
        curvature=turn / stretch,
        stretch=stretch,
        lengths=lengths,
        times=jnp.concatenate([jnp.zeros(1), jnp.cumsum(gaps)]),
        reached=jnp.concatenate([jnp.asarray([True]), jnp.cumsum(stood) == 0]),
    )


def speed_profile(
    most: Float[Array, " sample"],
    start: Scalar,
    spacing: Scalar,
    acceleration: Scalar | float,
    deceleration: Scalar | float,
) -> Float[Array, " sample"]:
    """Return v² [m²/s²] from that at the car on, as near to `most` as it comes."""
    ahead = spacing * (jnp.arange(most.shape[0]) - BEHIND)
    fastest = start + 2.0 * acceleration * jnp.maximum(ahead, 0.0)
    slowest = start - 2.0 * deceleration * jnp.maximum(ahead, 0.0)
    return jnp.maximum(jnp.clip(most, slowest, fastest), 0.0)


def window(
    path: Path,
    committed: Committed,
    along: Curve,
    place: Scalar,
    times: Float[Array, " horizon"],
) -> Reference:
    """Return where a reference is at times from now on: x, y, yaw, speed.

    `along` is the same reference in the world, `place` that of the car, in samples.
    """
    squares = committed.square
    spacing = path.spacing
    speed = jnp.sqrt(squares)
    slopes = 0.5 * jnp.diff(squares) / along.lengths
    last = squares.shape[0] - 2
    # When the reference was where the car is, from the start of its cell on.
    here = jnp.clip(jnp.floor(place).astype(int), 0, last)
    passed = (place - here) * along.lengths[here]
    now = jnp.sqrt(jnp.maximum(squares[here] + 2.0 * slopes[here] * passed, 0.0))
    since = 2.0 * passed / jnp.maximum(speed[here] + now, STANDS)
    times = along.times[here] + since + times

    def point(time: Scalar) -> Float[Array, " 4"]:
        at = jnp.clip(jnp.searchsorted(along.times, time, side="right") - 1, 0, last)
        later = time - along.times[at]
        gone = speed[at] * later + 0.5 * slopes[at] * later**2
        gone = jnp.clip(gone, 0.0, along.lengths[at])
        share = gone / along.lengths[at]
        d, first, second = committed.move[:, at]
        third = (committed.move[2, at + 1] - second) / spacing
        h = share * spacing
        offset = d + h * (first + h * (second / 2.0 + h * third / 6.0))
        slope = first + h * (second + h * third / 2.0)
        x, y, yaw, bend = point_at(path, (committed.index + at + share) * spacing)
        square = jnp.maximum(squares[at] + 2.0 * slopes[at] * gone, 0.0)
        return jnp.stack(
            [
                x - offset * jnp.sin(yaw),
                y + offset * jnp.cos(yaw),
                yaw + jnp.arctan2(slope, 1.0 - bend * offset),
                jnp.sqrt(square),
            ]
        )

    return jax.vmap(point)(times)
