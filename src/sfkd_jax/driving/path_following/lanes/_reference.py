"""A reference beside the centre line, on samples of the road.

The samples are a fixed distance apart, whatever the spacing of the path. As the car
drives on, the arrays move by whole samples, so no rounding accumulates.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.driving.lanes import Lane
from sfkd_jax.driving.paths import SPACING, Lap, Path, point_at
from sfkd_jax.types import Reference, Scalar

BEHIND = 2
"""Samples behind the car: the projection of a measured position also goes back."""
SPLICE = BEHIND + 2
"""The first sample at which a new plan may differ: it lies ahead of the car."""
ROUNDED = 1e-3
"""Share of a gap by which a sample may be beside the point of the path that it is."""
STANDS = 1e-3
"""Speed below which nothing moves [m/s]."""


class Committed(NamedTuple):
    """The reference that the car follows.

    Attributes:
        index: of the first sample of the road; negative before the start of the road.
        move: offset d [m] and its derivatives d' [-], d'' [1/m] at each sample.
        square: v² at each sample [m²/s²]. Between two samples it is linear in s, which
            is a constant acceleration.
    """

    index: Int[Array, ""]
    move: Float[Array, "3 sample"]
    square: Float[Array, " sample"]

    def at(self, index: Int[Array, ""], largest: Float[Array, " sample"]) -> Committed:
        """Return the same reference from another sample on.

        Beyond its last sample, the last offset is held, and the last speed as far as
        the largest one allows.

        Args:
            index: of the first sample.
            largest: largest v² at each of the new samples [m²/s²].
        """
        count = self.square.shape[0]
        rows = jnp.arange(count) + index - self.index
        known = rows < count
        held_rows = jnp.clip(rows, 0, count - 1)
        move = self.move[:, held_rows]
        move = move.at[1:].set(jnp.where(known, move[1:], 0.0))
        square = self.square[held_rows]
        square = jnp.where(known, square, jnp.minimum(square, largest))
        return Committed(index, move, square)


class RoadAhead(NamedTuple):
    """Samples of the road ahead.

    Attributes:
        position: x and y [m].
        direction: cosine and sine of the yaw.
        curvature: κ [1/m].
        slope: dκ/ds [1/m²].
        left: distance to the left edge [m].
        right: distance to the right edge [m].
        wanted: v² that is wanted and that the accelerations can reach [m²/s²].
        spacing: of the samples [m].
    """

    position: Float[Array, "2 sample"]
    direction: Float[Array, "2 sample"]
    curvature: Float[Array, " sample"]
    slope: Float[Array, " sample"]
    left: Float[Array, " sample"]
    right: Float[Array, " sample"]
    wanted: Float[Array, " sample"]
    spacing: Scalar


class Curve(NamedTuple):
    """A reference in the world and in time, at the samples of the road.

    Attributes:
        position: x and y [m].
        direction: cosine and sine of the yaw of the curve.
        curvature: of the curve itself [1/m].
        stretch: length of the curve per length of the road.
        lengths: of the curve, from each sample to the next [m].
        times: at which each sample is reached, counted from the first sample [s].
        reached: whether each sample is reached at all.
    """

    position: Float[Array, "2 sample"]
    direction: Float[Array, "2 sample"]
    curvature: Float[Array, " sample"]
    stretch: Float[Array, " sample"]
    lengths: Float[Array, " gap"]
    times: Float[Array, " sample"]
    reached: Bool[Array, " sample"]


def sampling(path: Path, spacing: float = SPACING) -> tuple[Scalar, Int[Array, ""]]:
    """Return the distance of samples [m] and the number of gaps between them.

    Points of the path are left out, or samples added between them. An open path is cut
    to whole gaps. A lap is divided evenly, so that its last sample is its first one.

    Args:
        path: with any spacing of its own.
        spacing: smallest distance of two samples [m].
    """
    ratio = path.spacing / spacing
    added = jnp.maximum(jnp.floor(ratio + ROUNDED), 1.0)
    points = jnp.maximum(jnp.ceil(1.0 / ratio - ROUNDED), 1.0)
    gaps = jnp.floor((path.points.shape[0] - 1) * added / points)
    gaps = jnp.maximum(gaps, 1.0)
    distance = path.spacing * points / added
    if isinstance(path, Lap):
        # A lap of whole gaps keeps the spacing of its points to the last bit.
        whole = gaps * points == (path.points.shape[0] - 1) * added
        distance = jnp.where(whole, distance, path.length / gaps)
    return distance, gaps.astype(int)


def road_ahead(
    lane: Lane,
    index: Int[Array, ""],
    count: int,
    accelerations: tuple[float, float],
    spacing: float = SPACING,
) -> RoadAhead:
    """Return the samples of a lane ahead; an open path ends at speed 0.

    Edges and speed of a sample are the smallest of the lane from the sample before to
    the one after it.

    Args:
        lane: on a path.
        index: of the first sample.
        count: number of samples.
        accelerations: largest acceleration and largest deceleration [m/s²].
        spacing: smallest distance of two samples [m], see `sampling`.
    """
    path = lane.path
    distance, gaps = sampling(path, spacing)
    numbers = index + jnp.arange(count)
    points = jax.vmap(point_at, in_axes=(None, 0))(path, distance * numbers)
    left, right, speed = (
        _smallest(path, values, numbers, distance, gaps)
        for values in (lane.left, lane.right, lane.speed)
    )
    squares = speed**2
    if not isinstance(path, Lap):
        squares = jnp.where(numbers >= gaps, 0.0, squares)
    ahead = 2.0 * distance * jnp.arange(count)
    gained = accelerations[0] * ahead
    lost = accelerations[1] * ahead
    # Backwards: at each sample the car can still slow down to all that follow.
    wanted = jax.lax.cummin(squares + lost, reverse=True) - lost
    # Forwards: at each sample the car has been able to speed up from all before.
    wanted = jax.lax.cummin(wanted - gained) + gained
    x, y, yaw, curvature = points.T
    return RoadAhead(
        position=jnp.stack([x, y]),
        direction=jnp.stack([jnp.cos(yaw), jnp.sin(yaw)]),
        curvature=curvature,
        slope=jnp.asarray(jnp.gradient(curvature)) / distance,
        left=left,
        right=right,
        wanted=wanted,
        spacing=distance,
    )


def _smallest(
    path: Path,
    values: Float[Array, " point"],
    numbers: Int[Array, " sample"],
    distance: Scalar,
    gaps: Int[Array, ""],
) -> Float[Array, " sample"]:
    """Return the smallest of values along a path within one gap of each sample.

    Args:
        path: with a value at each of its points.
        values: linear between the points.
        numbers: of the samples, rising by 1.
        distance: of the samples [m].
        gaps: number of gaps between the samples of the whole path.
    """
    last = values.shape[0] - 1
    closed = isinstance(path, Lap)
    first = numbers[0]
    numbers = numbers % gaps if closed else jnp.clip(numbers, 0, gaps)
    places = numbers * (distance / path.spacing)
    rows = jnp.clip(jnp.floor(places + ROUNDED).astype(int), 0, last - 1)
    # A sample at a point has its value to the last bit.
    share = places - rows
    share = jnp.where(jnp.abs(share) < ROUNDED, 0.0, jnp.clip(share, 0.0, 1.0))
    between = (1.0 - share) * values[rows] + share * values[rows + 1]
    # Points that lie between samples count for the samples on both sides.
    points = jnp.arange(last + 1) * (path.spacing / distance)
    before = jnp.floor(points + ROUNDED).astype(int) - first
    after = jnp.ceil(points - ROUNDED).astype(int) - first
    if closed:
        before = before % gaps
        after = after % gaps
    # A negative index would count from the end.
    beyond = numbers.shape[0]
    for near in (before, after):
        near = jnp.where(near < 0, beyond, near)
        between = between.at[near].min(values, mode="drop")
    return between


def curve(road: RoadAhead, plan: Committed) -> Curve:
    """Return a reference in the world. Its curvature is exact beside the road.

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
    sum_of_speeds = speed[1:] + speed[:-1]
    # Where the car stands, a gap takes hours, not for ever: sums of infinities make
    # NaN.
    durations = 2.0 * lengths / jnp.maximum(sum_of_speeds, STANDS)
    # The samples behind the car have been reached, whatever the speed there is.
    ahead = jnp.arange(sum_of_speeds.shape[0]) >= BEHIND
    stands = (sum_of_speeds <= STANDS) & ahead
    return Curve(
        position=road.position + d * jnp.stack([-sin, cos]),
        direction=jnp.stack([forward * cos - aside * sin, forward * sin + aside * cos]),
        curvature=turn / stretch,
        stretch=stretch,
        lengths=lengths,
        times=jnp.concatenate([jnp.zeros(1), jnp.cumsum(durations)]),
        reached=jnp.concatenate([jnp.asarray([True]), jnp.cumsum(stands) == 0]),
    )


def speed_profile(
    wanted: Float[Array, " sample"],
    start: Scalar,
    spacing: Scalar,
    acceleration: Scalar | float,
    deceleration: Scalar | float,
) -> Float[Array, " sample"]:
    """Return v² at each sample, as near to the wanted v² as the car can come [m²/s²].

    Args:
        wanted: v² at each sample [m²/s²].
        start: v² at the car [m²/s²].
        spacing: of the samples [m].
        acceleration: largest acceleration [m/s²].
        deceleration: largest deceleration [m/s²].
    """
    ahead = spacing * (jnp.arange(wanted.shape[0]) - BEHIND)
    fastest = start + 2.0 * acceleration * jnp.maximum(ahead, 0.0)
    slowest = start - 2.0 * deceleration * jnp.maximum(ahead, 0.0)
    return jnp.maximum(jnp.clip(wanted, slowest, fastest), 0.0)


def window(
    path: Path,
    spacing: Scalar,
    committed: Committed,
    along: Curve,
    place: Scalar,
    times: Float[Array, " horizon"],
) -> Reference:
    """Return where a reference is at times from now on: x, y, yaw, speed.

    Args:
        path: of the lane.
        spacing: of the samples [m].
        committed: the reference.
        along: the same reference in the world.
        place: of the car, in samples.
        times: from now on [s].
    """
    squares = committed.square
    speed = jnp.sqrt(squares)
    accelerations = 0.5 * jnp.diff(squares) / along.lengths
    last = squares.shape[0] - 2
    # The time at which the reference is where the car is, counted as in `along`.
    here = jnp.clip(jnp.floor(place).astype(int), 0, last)
    passed = (place - here) * along.lengths[here]
    square_here = squares[here] + 2.0 * accelerations[here] * passed
    speed_here = jnp.sqrt(jnp.maximum(square_here, 0.0))
    since = 2.0 * passed / jnp.maximum(speed[here] + speed_here, STANDS)
    times = along.times[here] + since + times

    def point(time: Scalar) -> Float[Array, " 4"]:
        at = jnp.clip(jnp.searchsorted(along.times, time, side="right") - 1, 0, last)
        later = time - along.times[at]
        gone = speed[at] * later + 0.5 * accelerations[at] * later**2
        gone = jnp.clip(gone, 0.0, along.lengths[at])
        share = gone / along.lengths[at]
        # The offset is a Taylor polynomial from the sample, with d'' linear to the next
        # one.
        d, first, second = committed.move[:, at]
        third = (committed.move[2, at + 1] - second) / spacing
        h = share * spacing
        offset = d + h * (first + h * (second / 2.0 + h * third / 6.0))
        slope = first + h * (second + h * third / 2.0)
        x, y, yaw, bend = point_at(path, (committed.index + at + share) * spacing)
        square = jnp.maximum(squares[at] + 2.0 * accelerations[at] * gone, 0.0)
        return jnp.stack(
            [
                x - offset * jnp.sin(yaw),
                y + offset * jnp.cos(yaw),
                yaw + jnp.arctan2(slope, 1.0 - bend * offset),
                jnp.sqrt(square),
            ]
        )

    return jax.vmap(point)(times)
