"""Random drives of a class: reference speed and curvature at every step."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sfkd_jax.ranges import Positive, Span
from sfkd_jax.schedules import within
from sfkd_jax.types import Key, Scalar

DRIVES = ("bends", "speeds", "lane_changes")
"""Groups of drives. "bends" follow a winding road at a speed that swings slowly.
"speeds" follow such a road and brake or accelerate from any speed to any other.
"lane_changes" move from lane to lane.
"""
CHANGE_DURATION = (3.0, 7.0)
"""Range of the duration of a lane change [s]."""
SPEED_DURATION = (2.0, 9.0)
"""Range of the time from one wanted speed to the next [s]."""
QUINTIC_PEAK = 5.7735
"""Largest second derivative of the quintic 10 t³ − 15 t⁴ + 6 t⁵ for t in [0, 1]."""


class DriveClass(NamedTuple):
    """Limits of a reference: the class of drives that a corridor is about.

    Attributes:
        speed: range of v_ref [m/s].
        peak_curvature: largest |κ| [1/m].
        wavelengths: range of those of the sinusoids of a road [m].
        lateral_acceleration: a_y, largest v_ref² |κ| [m/s²].
        acceleration: a_x, with |dv_ref/dt| ≤ a_x √(1 − (v_ref² κ / a_y)²) [m/s²].
        lateral_jerk: largest v_ref³ |dκ/ds| [m/s³].
        curvature_slope: largest |dκ/ds| [1/m²].
    """

    speed: Span = (3.0, 12.0)
    peak_curvature: Positive = 0.05
    wavelengths: Span = (50.0, 200.0)
    lateral_acceleration: Positive = 2.0
    acceleration: Positive = 2.0
    lateral_jerk: Positive = 7.0
    curvature_slope: Positive = 0.02


def random_drive(
    key: Key, group: Int[Array, ""], limits: DriveClass, *, steps: int, dt: float
) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
    """Return v_ref [m/s] and κ [1/m] at every step of a drive.

    A third of the roads are circles. The curvature of the others is a sum of three
    sinusoids. Both are shares of the tightest curvature that the speed allows.

    Args:
        key: consumed.
        group: index into `DRIVES`.
        limits: the class.
        steps: number of time steps.
        dt: sampling period [s].
    """
    speed_key, road_key, change_key = jax.random.split(key, 3)
    wanted_speeds, rates = _wanted_speeds(speed_key, group, limits, steps=steps, dt=dt)
    wavelengths, phases, size = _sinusoids(road_key, limits.wavelengths)
    base, changes = _lane_changes(change_key, steps=steps, dt=dt)

    def step(carry: tuple[Scalar, ...], inputs: tuple[Scalar, ...]) -> Any:
        speed, along, curvature = carry
        wanted_speed, rate, change = inputs
        # The part of the friction that turning uses is missing for changes of speed.
        used = speed**2 * curvature / limits.lateral_acceleration
        speed_step = rate * dt * jnp.sqrt(jnp.maximum(1.0 - used**2, 0.0))
        speed = speed + jnp.clip(wanted_speed - speed, -speed_step, speed_step)
        bend = size * jnp.mean(jnp.sin(2 * jnp.pi * along / wavelengths + phases))
        lane_change = base + (1.0 - jnp.abs(base)) * change
        is_lane_change = group == DRIVES.index("lane_changes")
        share = jnp.where(is_lane_change, lane_change, bend)
        # Friction limits v² κ, so that a fast road is nearly straight.
        grip = limits.lateral_acceleration / speed**2
        tightest = jnp.minimum(limits.peak_curvature, grip)
        slope = jnp.minimum(limits.curvature_slope, limits.lateral_jerk / speed**3)
        missing = jnp.clip(share, -1.0, 1.0) * tightest - curvature
        largest_change = slope * speed * dt
        curvature = curvature + jnp.clip(missing, -largest_change, largest_change)
        # This limit comes last. Where the speed rises, the limit of the slope must not
        # keep a turn that has become too tight.
        curvature = jnp.clip(curvature, -tightest, tightest)
        return (speed, along + speed * dt, curvature), (speed, curvature)

    start = (wanted_speeds[0], jnp.zeros(()), jnp.zeros(()))
    _, reference = jax.lax.scan(step, start, (wanted_speeds, rates, changes))
    return reference


def _wanted_speeds(
    key: Key, group: Int[Array, ""], limits: DriveClass, *, steps: int, dt: float
) -> tuple[Array, Array]:
    """Draw the speed that a drive goes to [m/s] and its rate [m/s²] at every step."""
    level_key, swing_key, duration_key, goal_key, rate_key, choice_key = (
        jax.random.split(key, 6)
    )
    low, high = limits.speed
    time = jnp.arange(steps) * dt
    count = int(steps * dt / SPEED_DURATION[0]) + 2
    ends = jnp.cumsum(within(SPEED_DURATION, duration_key, count))
    index = jnp.searchsorted(ends, time)
    # Goals are drawn from a range that is wider by a quarter on either side, and then
    # clipped. The ends of the allowed range are therefore reached and held.
    beyond = 0.25 * (high - low)
    goals = within((low - beyond, high + beyond), goal_key, count)
    rates = within((0.25, 1.25), rate_key, count)
    # Half of the drives with lane changes brake and accelerate as well.
    is_speeds = group == DRIVES.index("speeds")
    is_lane_change = group == DRIVES.index("lane_changes")
    goes_to_goals = is_speeds | (
        is_lane_change & (jax.random.uniform(choice_key) < 0.5)
    )
    # The others swing slowly about a level. The swing is not scaled to fit the allowed
    # range, so that clipping holds the speed at the ends of the range.
    level = within(limits.speed, level_key)
    swing, period, phase = jax.random.uniform(swing_key, (3,))
    swings = level + 0.8 * swing * jnp.sin(
        2 * jnp.pi * (time / (5.0 + 15.0 * period) + phase)
    )
    wanted_speeds = jnp.where(goes_to_goals, goals[index], swings)
    rate_shares = jnp.where(goes_to_goals, jnp.minimum(rates[index], 1.0), 1.0)
    return jnp.clip(wanted_speeds, low, high), limits.acceleration * rate_shares


def _sinusoids(key: Key, limits: tuple[float, float]) -> tuple[Array, ...]:
    """Draw wavelengths [m], phases [rad] and size of the sinusoids of a road.

    A third of the roads are circles, because e_y grows largest in a steady turn. A
    circle has infinite wavelengths.

    Args:
        key: consumed.
        limits: range of the wavelengths [m].
    """
    wavelength_key, phase_key, size_key, choice_key = jax.random.split(key, 4)
    wavelengths = within(limits, wavelength_key, 3)
    phases = jax.random.uniform(phase_key, (3,), maxval=2 * jnp.pi)
    size = jnp.sqrt(jax.random.uniform(size_key))
    is_circle = jax.random.uniform(choice_key) < 1.0 / 3.0
    # With an infinite wavelength the sine is constant: 1 to the left, -1 to the right.
    circle_phase = jnp.where(phases < jnp.pi, 0.5 * jnp.pi, 1.5 * jnp.pi)[0]
    # A third of the circles have the tightest curvature.
    circle_size = jnp.minimum(1.5 * size**2, 1.0)
    return (
        jnp.where(is_circle, jnp.inf, wavelengths),
        jnp.where(is_circle, circle_phase, phases),
        # The three sinusoids seldom peak together. Twice their mean, clipped, stays at
        # the extremes for a while.
        jnp.where(is_circle, circle_size, 2.0 * size),
    )


def _lane_changes(
    key: Key, *, steps: int, dt: float
) -> tuple[Scalar, Float[Array, " time"]]:
    """Draw the curvature of the road and that of lane changes at every step.

    Both are shares of the tightest curvature. During a change the curvature is one
    period of a wave: either the lateral offset is a quintic, or the heading is a sin².
    A third of the changes follow the one before without a gap.
    """
    duration_key, gap_key, size_key, side_key, shape_key, start_key, base_key = (
        jax.random.split(key, 7)
    )
    count = int(steps * dt / CHANGE_DURATION[0]) + 4
    durations = within(CHANGE_DURATION, duration_key, count)
    gaps = jnp.maximum(within((-1.0, 2.0), gap_key, count), 0.0)
    ends = jnp.cumsum(durations + gaps)
    # A drive starts anywhere in the first change, so that a short one has a change too.
    time = jnp.arange(steps) * dt + ends[0] * jax.random.uniform(start_key)
    index = jnp.searchsorted(ends, time)
    # The gap comes before the change: t stays 0 there, then rises to 1.
    t = jnp.clip(1.0 - (ends[index] - time) / durations[index], 0.0, 1.0)
    quintic = (60.0 * t - 180.0 * t**2 + 120.0 * t**3) / QUINTIC_PEAK
    is_quintic = jax.random.uniform(shape_key) < 0.5
    shape = jnp.where(is_quintic, quintic, jnp.sin(2 * jnp.pi * t))
    sizes = within((0.3, 1.3), size_key, count)
    sides = jax.random.rademacher(side_key, (count,), dtype=float)
    base = jnp.maximum(within((-1.0, 0.5), base_key), 0.0)
    return base, (jnp.minimum(sizes, 1.0) * sides)[index] * shape
