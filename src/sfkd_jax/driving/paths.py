"""Paths by arc length: interpolation, projection, and lateral moves."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.driving.smoothing import smooth
from sfkd_jax.types import Reference, Scalar

SPACING = 0.5
"""Distance between samples of a path, unless another one is asked for [m]."""


class Path(NamedTuple):
    """A path sampled at equal arc length.

    Attributes:
        points: x [m], y [m], yaw [rad], curvature [1/m] at s = 0, h, 2h, …, shape
            (point, 4).
        spacing: h [m].
    """

    points: Float[Array, "point 4"]
    spacing: Scalar

    @property
    def length(self) -> Scalar:
        """Arc length [m]."""
        return (self.points.shape[0] - 1) * self.spacing


class Lap(Path):
    """A closed path: its last point is its first one, with the yaw of a full lap added.

    It is a type of its own and not a field of `Path`. Whether a path is closed is
    therefore known when a program is traced, and open paths cost nothing more.
    """


def path_from_curvature(curvature: Float[Array, " point"], *, spacing: float) -> Path:
    """Integrate κ(s) to a path that starts at the origin along x."""
    yaw_steps = 0.5 * (curvature[1:] + curvature[:-1]) * spacing
    yaw = jnp.concatenate([jnp.zeros(1), jnp.cumsum(yaw_steps)])
    # The chord of an arc points along the yaw at its middle. For a curvature that is
    # linear between samples the error of this is O(h³) per sample.
    chord_yaw = yaw[:-1] + 0.5 * yaw_steps
    x = jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.cos(chord_yaw))]) * spacing
    y = jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.sin(chord_yaw))]) * spacing
    return Path(jnp.stack([x, y, yaw, curvature], axis=1), jnp.asarray(spacing))


def path_through(
    points: Float[Array, "point 2"],
    *,
    spacing: float = SPACING,
    closed: bool = False,
    tolerance: float = 0.0,
    curvature: float | None = None,
) -> Path:
    """Return a path through positions, resampled at equal distances.

    Without a tolerance the path is straight between positions, and yaw and curvature
    are central differences. The positions should then be exact and dense: several per
    `spacing` on a sharp turn. With a tolerance it is the smoothest path beside them, in
    the sense of the smallest ∫ |d³p/ds³|² ds (Reinsch, Numerische Mathematik 10, 1967).

    An open path is cut to a multiple of `spacing`. A closed path keeps its length and
    changes its spacing.

    Args:
        points: positions [m].
        spacing: between samples [m].
        closed: whether the last position leads back to the first, which need not be
            repeated. The path is then a `Lap`.
        tolerance: root mean square distance of the positions from the path [m]: the
            noise of recorded positions, or how far beside way-points the path may be.
        curvature: largest one that is accepted [1/m], such as that of the class of a
            policy; None for any.

    Raises:
        ValueError: a position is not finite, two consecutive ones are the same, the
            path is shorter than two spacings, or it asks for a larger curvature.
    """
    if not 0.0 <= tolerance < math.inf:
        raise ValueError(f"tolerance must be 0 or more, in metres, got {tolerance}")
    if closed and bool(jnp.any(points[0] != points[-1])):
        points = jnp.concatenate([points, points[:1]])
    steps = jnp.linalg.norm(jnp.diff(points, axis=0), axis=1)
    # `bool` needs concrete arrays. That is no limitation: a path is made before a
    # program is traced.
    if not bool(jnp.all(jnp.isfinite(points)) & jnp.all(steps > 0)):
        raise ValueError("a path needs finite positions, no two in a row the same")
    along = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
    count = int(along[-1] / spacing) + 1
    # Central differences of the yaw need three samples.
    if count < 3:
        raise ValueError(
            f"a path of {float(along[-1]):.3g} m has too few samples "
            f"at a spacing of {spacing} m"
        )
    if tolerance > 0.0:
        positions = np.asarray(points, np.float64)
        samples, spacing = smooth(positions, spacing, closed, tolerance)
        kind = Lap if closed else Path
        distance = jnp.asarray(spacing, dtype=float)
        path = kind(jnp.asarray(samples, dtype=float), distance)
    else:
        path = _straight(points, along, spacing, closed)
    if curvature is not None:
        _check_curvature(path, curvature, tolerance)
    return path


def _straight(
    points: Float[Array, "point 2"],
    along: Float[Array, " point"],
    spacing: float,
    closed: bool,
) -> Path:
    """Return a path that is straight between positions.

    Args:
        points: positions [m].
        along: way to each position [m].
        spacing: between samples [m].
        closed: whether the last position is the first one.
    """
    count = int(along[-1] / spacing) + 1
    if closed:
        spacing = float(along[-1]) / (count - 1)
    s = jnp.arange(count) * spacing
    x = jnp.interp(s, along, points[:, 0])
    y = jnp.interp(s, along, points[:, 1])
    # The differences at both ends of a lap need the two samples that follow around it.
    if closed:
        x = jnp.concatenate([x[-3:-1], x, x[1:3]])
        y = jnp.concatenate([y[-3:-1], y, y[1:3]])
    along_x = jnp.asarray(jnp.gradient(x))
    along_y = jnp.asarray(jnp.gradient(y))
    # The curvature is the slope of the yaw, which must therefore not jump by 2π.
    yaw = jnp.unwrap(jnp.arctan2(along_y, along_x))
    curvature = jnp.asarray(jnp.gradient(yaw)) / spacing
    samples = jnp.stack([x, y, yaw, curvature], axis=1)
    if closed:
        return Lap(samples[2:-2], jnp.asarray(spacing))
    return Path(samples, jnp.asarray(spacing))


def _check_curvature(path: Path, largest: float, tolerance: float) -> None:
    """Raise a ValueError if a path has a larger curvature somewhere."""
    bends = np.abs(np.asarray(path.points[:, 3]))
    worst = int(np.argmax(bends))
    if bends[worst] <= largest:
        return
    noisy = "" if tolerance else "; noisy or sparse positions need a tolerance [m]"
    raise ValueError(
        f"the path asks for a curvature of {bends[worst]:.3g} 1/m at "
        f"{worst * float(path.spacing):.4g} m, {largest:.3g} is the largest{noisy}"
    )


def point_at(path: Path, s: Scalar) -> Float[Array, " 4"]:
    """Return x, y, yaw, curvature at arc length s [m].

    Between two samples the path is a clothoid. On an open path s is clamped to its
    length. Around a `Lap` s may have any value, and the yaw grows by a turn per lap.
    """
    if isinstance(path, Lap):
        laps = jnp.floor(s / path.length)
        point = point_at(Path(*path), s - laps * path.length)
        return point.at[2].add(laps * (path.points[-1, 2] - path.points[0, 2]))
    last = path.points.shape[0] - 2
    index = jnp.clip(jnp.floor(s / path.spacing).astype(int), 0, last)
    start = path.points[index]
    end = path.points[index + 1]
    # The clip makes a path stay at its last point beyond its ends.
    ahead = jnp.clip(s - index * path.spacing, 0.0, path.spacing)
    slope = (end[3] - start[3]) / path.spacing
    yaw = start[2] + start[3] * ahead + 0.5 * slope * ahead**2
    # The chord points along the yaw at half the way, as in `path_from_curvature`.
    chord_yaw = start[2] + 0.5 * start[3] * ahead + 0.125 * slope * ahead**2
    x = start[0] + ahead * jnp.cos(chord_yaw)
    y = start[1] + ahead * jnp.sin(chord_yaw)
    return jnp.stack([x, y, yaw, start[3] + slope * ahead])


def project(
    path: Path, position: Float[Array, " 2"], s_guess: Scalar
) -> tuple[Scalar, Scalar]:
    """Return the arc length of the closest point and the signed distance to it [m].

    The distance is positive left of the path. The closest point is found by Newton
    steps from `s_guess`. Beyond an end of an open path it is that end. Around a `Lap`
    the arc length starts anew at 0.
    """
    closed = isinstance(path, Lap)
    s = s_guess
    # Three steps suffice, since callers pass the last foot point, moved ahead by the
    # distance of one step.
    for _ in range(3):
        point = point_at(path, s)
        along, left = _offsets(point, position)
        # At the centre of a curve the Newton step would divide by 0.
        s = s + along / jnp.maximum(1.0 - point[3] * left, 0.2)
        # After every step: the next one must start at a point of the path.
        s = s % path.length if closed else jnp.clip(s, 0.0, path.length)
    _, left = _offsets(point_at(path, s), position)
    return s, left


def reference_window(
    path: Path,
    s: Scalar,
    speed: Scalar,
    *,
    dt: float,
    horizon: int,
    deceleration: float = 2.5,
) -> Reference:
    """Return the next points at a constant speed: x, y, yaw, speed, (horizon, 4).

    Before the end of an open path the speed falls so that the points stop there.

    Args:
        path: open, or a `Lap`, which has no end.
        s: arc length of the vehicle [m].
        speed: v [m/s].
        dt: sampling period [s].
        horizon: number of points.
        deceleration: towards the end [m/s²].
    """
    # The first point is one step ahead: the present state cannot be changed any more.
    times = dt * jnp.arange(1, horizon + 1)
    ahead = s + speed * dt * jnp.arange(1, horizon + 1)
    speeds = jnp.broadcast_to(speed, ahead.shape)
    if not isinstance(path, Lap):
        remaining = jnp.maximum(path.length - s, 0.0)
        braking_distance = speed**2 / 2 / deceleration
        # The vehicle cruises and then brakes. Where the end is nearer than the braking
        # distance, it brakes from the speed at which it can still stop there.
        standstill_time = jnp.where(
            remaining > braking_distance,
            (remaining - braking_distance) / jnp.maximum(speed, 1e-3)
            + speed / deceleration,
            jnp.sqrt(2.0 * remaining / deceleration),
        )
        falling = deceleration * jnp.maximum(standstill_time - times, 0.0)
        brakes = (path.length - ahead < braking_distance) & (speed > 0.0)
        ahead = jnp.where(brakes, path.length - falling**2 / 2 / deceleration, ahead)
        speeds = jnp.where(brakes, falling, speeds)
    points = jax.vmap(point_at, in_axes=(None, 0))(path, ahead)
    # The fourth column of a reference is the speed; that of a path is its curvature.
    return points.at[:, 3].set(speeds)


def quintic(
    start: Float[Array, " 3"], target: Scalar, length: Scalar, s: Float[Array, ...]
) -> Float[Array, "4 ..."]:
    """Return the offset d of a lateral move and its derivatives d', d'', d''' at s.

    The derivatives are by arc length. d is the polynomial of degree five that leads
    from (d, d', d'') at s = 0 to (target, 0, 0) at s = length. Beyond its end it stays
    at the target.

    Args:
        start: d [m], d' [-], d'' [1/m] at s = 0.
        target: d at the end [m].
        length: of the move, positive [m].
        s: distance from its start, not negative [m].
    """
    # A polynomial of t = s / length in [0, 1]: the powers of s would span many decades.
    linear = start[1] * length
    quadratic = 0.5 * start[2] * length**2
    gap = target - start[0]
    cubic = 10.0 * gap - 6.0 * linear - 3.0 * quadratic
    quartic = -15.0 * gap + 8.0 * linear + 3.0 * quadratic
    fifth = 6.0 * gap - 3.0 * linear - quadratic
    # Highest degree first, as Horner's scheme reads them.
    coefficients = (fifth, quartic, cubic, quadratic, linear, start[0])
    t = jnp.clip(s / length, 0.0, 1.0)
    values = []
    # From the end on the vehicle stays at the target: all derivatives are 0 there.
    scale = jnp.where(s < length, 1.0, 0.0)
    for order in range(4):
        value = jnp.zeros_like(t)
        for coefficient in coefficients:
            value = value * t + coefficient
        values.append(value if order == 0 else value * scale)
        # The next derivative by s: that by t, divided by the length once more.
        scale = scale / length
        degree = len(coefficients) - 1
        coefficients = tuple(
            (degree - index) * coefficient
            for index, coefficient in enumerate(coefficients[:-1])
        )
    return jnp.stack(values)


def _offsets(
    point: Float[Array, " 4"], position: Float[Array, " 2"]
) -> tuple[Scalar, Scalar]:
    """Return how far a position is ahead of and left of a point on the path [m]."""
    dx = position[0] - point[0]
    dy = position[1] - point[1]
    cos = jnp.cos(point[2])
    sin = jnp.sin(point[2])
    return cos * dx + sin * dy, -sin * dx + cos * dy
