"""Reference paths by arc length: random smooth paths, interpolation and projection."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Key, Reference, Scalar

SPACING = 0.5
"""Between samples of a path [m]."""
RUN_UP = 20.0
"""Over which the curvature of a path is blended in [m]."""
LANE = 3.5
"""Offset of a lane change [m]."""
SECTIONS = (30.0, 25.0, 25.0)
"""Lengths of the change, the other lane and the change back [m], as in ISO 3888-1."""
LANE_CHANGE_SPACING = 150.0
"""From one lane change to the next [m]."""


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


def smooth_path(
    key: Key,
    *,
    length: float,
    peak_curvature: float = 0.02,
    wavelengths: tuple[float, float] = (50.0, 160.0),
) -> Path:
    """Draw a path whose curvature is a sum of three sinusoids.

        κ(s) = Σᵢ aᵢ sin(2π s/λᵢ + φᵢ),   max |κ| = κ_max

    The curvature is blended in over the first metres, so that an episode starts on the
    path.

    Args:
        key: consumed.
        length: smallest length [m].
        peak_curvature: κ_max [1/m].
        wavelengths: range of λᵢ [m].
    """
    amplitude_key, wavelength_key, phase_key = jax.random.split(key, 3)
    s = jnp.arange(int(length / SPACING) + 2) * SPACING
    # At least 0.3, or one sinusoid could be left alone.
    amplitudes = jax.random.uniform(amplitude_key, (3, 1), minval=0.3, maxval=1.0)
    waves = jax.random.uniform(
        wavelength_key, (3, 1), minval=wavelengths[0], maxval=wavelengths[1]
    )
    phases = jax.random.uniform(phase_key, (3, 1), maxval=2 * jnp.pi)
    curvature = jnp.sum(amplitudes * jnp.sin(2 * jnp.pi * s / waves + phases), axis=0)
    blend = jnp.clip(s / RUN_UP, 0.0, 1.0)
    # Smoothstep: the curvature and its slope start at 0, as does the steering.
    curvature = curvature * blend**2 * (3.0 - 2.0 * blend)
    # After the blend, so that the peak is reached on the path that is driven.
    curvature = curvature * peak_curvature / jnp.max(jnp.abs(curvature))
    return path_from_curvature(curvature, spacing=SPACING)


def double_lane_change(key: Key, length: float) -> Path:
    """Change to the lane at a random side and back, once a period (ISO 3888-1).

    The heading of a change over ℓ is θ sin²(π s/ℓ), whose offset is close to θ ℓ / 2.
    The path is at least `length` long [m].
    """
    first, middle, last = SECTIONS
    start_key, side_key = jax.random.split(key)
    start = jax.random.uniform(start_key, (), minval=20.0, maxval=50.0)
    s = jnp.arange(int(length / SPACING) + 2) * SPACING - start
    s = jnp.where(s > 0, s % LANE_CHANGE_SPACING, s)  # straight until the first change

    def change(begin: float, over: float, towards: float) -> Float[Array, " point"]:
        share = jnp.clip((s - begin) / over, 0.0, 1.0)
        largest = 2.0 * LANE / over
        # Derivative of θ sin²(π s/ℓ): curvature is the slope of the heading.
        return towards * largest * jnp.pi / over * jnp.sin(2.0 * jnp.pi * share)

    # The change back is the mirror image, so that the car returns to its lane.
    curvature = change(0.0, first, 1.0) + change(first + middle, last, -1.0)
    side = jax.random.rademacher(side_key, (), dtype=float)
    return path_from_curvature(side * curvature, spacing=SPACING)


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
    along_x, along_y = jnp.asarray(jnp.gradient(x)), jnp.asarray(jnp.gradient(y))
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
    start, end = path.points[index], path.points[index + 1]
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
        left, braking = jnp.maximum(path.length - s, 0.0), speed**2 / 2 / deceleration
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


def _offsets(
    point: Float[Array, " 4"], position: Float[Array, " 2"]
) -> tuple[Scalar, Scalar]:
    """Distance of a position ahead of and left of a point on the path [m]."""
    dx, dy = position[0] - point[0], position[1] - point[1]
    c, s = jnp.cos(point[2]), jnp.sin(point[2])
    return c * dx + s * dy, -s * dx + c * dy
