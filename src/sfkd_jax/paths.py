"""Paths by arc length: interpolation, projection, and lateral moves."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Reference, Scalar

SPACING = 0.5
"""Between samples of a path [m]."""


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
    """A closed path: its last point is its first one, the yaw turned on by a lap.

    A type of its own, not a field: whether a path is closed is known when a program is
    traced, and open paths cost nothing more.
    """


def path_from_curvature(curvature: Float[Array, " point"], *, spacing: float) -> Path:
    """Integrate κ(s) to a path that starts at the origin along x."""
    yaw_steps = 0.5 * (curvature[1:] + curvature[:-1]) * spacing
    yaw = jnp.concatenate([jnp.zeros(1), jnp.cumsum(yaw_steps)])
    # The chord of an arc points along the yaw of its middle: errors of O(h³) a sample.
    middle = yaw[:-1] + 0.5 * yaw_steps
    x = jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.cos(middle))]) * spacing
    y = jnp.concatenate([jnp.zeros(1), jnp.cumsum(jnp.sin(middle))]) * spacing
    return Path(jnp.stack([x, y, yaw, curvature], axis=1), jnp.asarray(spacing))


def path_through(
    points: Float[Array, "point 2"], *, spacing: float = SPACING, closed: bool = False
) -> Path:
    """Return a path through positions, resampled at equal distances.

    Yaw and curvature are central differences. The path is straight between positions,
    so these should be dense: several per `spacing` on a sharp turn. The length of an
    open path is a multiple of `spacing`; a closed one changes its spacing instead.

    Args:
        points: positions [m].
        spacing: between samples [m].
        closed: whether the last position leads back to the first, which need not be
            repeated. The path is then a `Lap`.
    """
    if closed and bool(jnp.any(points[0] != points[-1])):
        points = jnp.concatenate([points, points[:1]])
    steps = jnp.linalg.norm(jnp.diff(points, axis=0), axis=1)
    # `bool` needs concrete arrays: a path is made before a program is traced.
    if not bool(jnp.all(jnp.isfinite(points)) & jnp.all(steps > 0)):
        raise ValueError("a path needs finite positions, no two in a row the same")
    along = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
    count = int(along[-1] / spacing) + 1
    # Central differences of a curvature take three samples.
    if count < 3:
        raise ValueError(
            f"a path of {float(along[-1]):.3g} m has too few samples "
            f"at a spacing of {spacing} m"
        )
    if closed:
        spacing = float(along[-1]) / (count - 1)
    s = jnp.arange(count) * spacing
    x, y = (jnp.interp(s, along, axis) for axis in points.T)
    if closed:  # goes on by two samples at both ends, for the differences
        x, y = (jnp.concatenate([one[-3:-1], one, one[1:3]]) for one in (x, y))
    along_x = jnp.asarray(jnp.gradient(x))
    along_y = jnp.asarray(jnp.gradient(y))
    # Unwrapped: the curvature is its slope, which must not jump by 2π.
    yaw = jnp.unwrap(jnp.arctan2(along_y, along_x))
    curvature = jnp.asarray(jnp.gradient(yaw)) / spacing
    samples = jnp.stack([x, y, yaw, curvature], axis=1)
    if closed:
        return Lap(samples[2:-2], jnp.asarray(spacing))
    return Path(samples, jnp.asarray(spacing))


def point_at(path: Path, s: Scalar) -> Float[Array, " 4"]:
    """Return x, y, yaw, curvature at arc length s [m], which is clamped to the path.

    Between two samples the path is a clothoid. Around a `Lap` s goes on for ever, and
    the yaw with it.
    """
    if isinstance(path, Lap):
        laps = jnp.floor(s / path.length)
        point = point_at(Path(*path), s - laps * path.length)
        return point.at[2].add(laps * (path.points[-1, 2] - path.points[0, 2]))
    last = path.points.shape[0] - 2
    index = jnp.clip(jnp.floor(s / path.spacing).astype(int), 0, last)
    start = path.points[index]
    end = path.points[index + 1]
    # Clipped: beyond its ends a path stays at its last point.
    ahead = jnp.clip(s - index * path.spacing, 0.0, path.spacing)
    slope = (end[3] - start[3]) / path.spacing
    yaw = start[2] + start[3] * ahead + 0.5 * slope * ahead**2
    # The chord points along the yaw at half the way, as in `path_from_curvature`.
    middle = start[2] + 0.5 * start[3] * ahead + 0.125 * slope * ahead**2
    x = start[0] + ahead * jnp.cos(middle)
    y = start[1] + ahead * jnp.sin(middle)
    return jnp.stack([x, y, yaw, start[3] + slope * ahead])


def project(
    path: Path, position: Float[Array, " 2"], s_guess: Scalar
) -> tuple[Scalar, Scalar]:
    """Return the arc length of the closest point and the signed distance to it [m].

    Newton steps from `s_guess`; left of the path the distance is positive. Beyond an
    end the closest point is the end; around a `Lap` the arc length starts anew.
    """
    closed = isinstance(path, Lap)
    s = s_guess
    # Few steps suffice, since the guess is the last foot point moved on.
    for _ in range(3):
        point = point_at(path, s)
        along, left = _offsets(point, position)
        # Near the centre of a curve the Newton step would divide by 0.
        s = s + along / jnp.maximum(1.0 - point[3] * left, 0.2)
        # Every step: one that left the path would go on from a point that is not on it.
        s = s % path.length if closed else jnp.clip(s, 0.0, path.length)
    return s, _offsets(point_at(path, s), position)[1]


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

    Before the end of a path the speed falls so that the points stop there, at speed 0.

    Args:
        path: open, or a `Lap`, which has no end.
        s: arc length of the vehicle [m].
        speed: v [m/s].
        dt: sampling period [s].
        horizon: number of points.
        deceleration: towards the end [m/s²].
    """
    # From one step ahead on: the present state cannot be changed any more.
    times = dt * jnp.arange(1, horizon + 1)
    ahead = s + speed * dt * jnp.arange(1, horizon + 1)
    speeds = jnp.broadcast_to(speed, ahead.shape)
    if not isinstance(path, Lap):
        left = jnp.maximum(path.length - s, 0.0)
        braking = speed**2 / 2 / deceleration
        # Until standstill: cruise and brake, or brake alone where the end is near.
        until = jnp.where(
            left > braking,
            (left - braking) / jnp.maximum(speed, 1e-3) + speed / deceleration,
            jnp.sqrt(2.0 * left / deceleration),
        )
        falling = deceleration * jnp.maximum(until - times, 0.0)
        near = (path.length - ahead < braking) & (speed > 0.0)
        ahead = jnp.where(near, path.length - falling**2 / 2 / deceleration, ahead)
        speeds = jnp.where(near, falling, speeds)
    points = jax.vmap(point_at, in_axes=(None, 0))(path, ahead)
    # The fourth column of a reference is the speed, where a path has its curvature.
    return points.at[:, 3].set(speeds)


def quintic(
    start: Float[Array, " 3"], target: Scalar, length: Scalar, s: Float[Array, ...]
) -> Float[Array, "4 ..."]:
    """Return d, d', d'', d''' of a lateral move at s, derivatives by arc length.

    The polynomial of degree five from (d, d', d'') at s = 0 to (target, 0, 0) at
    s = length; beyond its end it stays at the target.

    Args:
        start: d [m], d' [-], d'' [1/m].
        target: [m].
        length: of the move, positive [m].
        s: distance from its start, not negative [m].
    """
    first = start[1] * length
    second = 0.5 * start[2] * length**2
    gap = target - start[0]
    # Over t = s / length in [0, 1], or the powers would span many decades.
    cubic = 10.0 * gap - 6.0 * first - 3.0 * second
    quartic = -15.0 * gap + 8.0 * first + 3.0 * second
    fifth = 6.0 * gap - 3.0 * first - second
    coefficients = (fifth, quartic, cubic, second, first, start[0])
    t = jnp.clip(s / length, 0.0, 1.0)
    # At the end all derivatives are those of staying there, the third included.
    values = []
    scale = jnp.where(s < length, 1.0, 0.0)
    for order in range(4):
        value = jnp.zeros_like(t)
        for coefficient in coefficients:
            value = value * t + coefficient
        values.append(value if order == 0 else value * scale)
        scale = scale / length
        degree = len(coefficients) - 1
        coefficients = tuple(
            (degree - i) * one for i, one in enumerate(coefficients[:-1])
        )
    return jnp.stack(values)


def _offsets(
    point: Float[Array, " 4"], position: Float[Array, " 2"]
) -> tuple[Scalar, Scalar]:
    """Distance of a position ahead of and left of a point on the path [m]."""
    dx = position[0] - point[0]
    dy = position[1] - point[1]
    c = jnp.cos(point[2])
    s = jnp.sin(point[2])
    return c * dx + s * dy, -s * dx + c * dy
