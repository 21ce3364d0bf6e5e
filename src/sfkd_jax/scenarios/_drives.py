"""Random drives of a class: reference speed and curvature at every step."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sfkd_jax.ranges import Positive, Span
from sfkd_jax.scenarios._conditions import within
from sfkd_jax.types import Key, Scalar

DRIVES = ("bends", "speeds", "lane_changes")
"""Groups of drives: bends at speeds that swing slowly, the same with braking and
accelerating from any speed to any other, and lane changes.
"""
CHANGE = (3.0, 7.0)
"""Duration of a lane change [s]."""
LEG = (2.0, 9.0)
"""From one wanted speed to the next [s]."""
STEEPEST = 5.7735
"""Largest second derivative of 10 t³ − 15 t⁴ + 6 t⁵."""


class DriveClass(NamedTuple):
    """What a reference may do: the class of drives that a corridor is about.

    Attributes:
        speed: range of v_ref [m/s].
        peak_curvature: largest |κ| [1/m].
        wavelengths: of the sinusoids of a road [m].
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

    A third of the roads are circles, the curvature of the others is a sum of three
    sinusoids, as a share of the tightest that the speed allows.

    Args:
        key: consumed.
        group: index into `DRIVES`.
        limits: the class.
        steps: of the drive.
        dt: sampling period [s].
    """
    speed_key, road_key, change_key = jax.random.split(key, 3)
    wanted, rates = _wanted_speeds(speed_key, group, limits, steps=steps, dt=dt)
    waves, phases, size = _sinusoids(road_key, limits.wavelengths)
    base, changes = _lane_changes(change_key, steps=steps, dt=dt)

    def step(carry: tuple[Scalar, ...], given: tuple[Scalar, ...]) -> Any:
        speed, along, curvature = carry
        want, rate, change = given
        # What turning uses of the friction is missing for the change of speed.
        used = speed**2 * curvature / limits.lateral_acceleration
        rate = rate * dt * jnp.sqrt(jnp.maximum(1.0 - used**2, 0.0))
        speed = speed + jnp.clip(want - speed, -rate, rate)
        bend = size * jnp.mean(jnp.sin(2 * jnp.pi * along / waves + phases))
        share = jnp.where(group == 2, base + (1.0 - jnp.abs(base)) * change, bend)
        # Friction limits v² κ, so that a fast road is a straight one.
        grip = limits.lateral_acceleration / speed**2
        tightest = jnp.minimum(limits.peak_curvature, grip)
        slope = jnp.minimum(limits.curvature_slope, limits.lateral_jerk / speed**3)
        turn = jnp.clip(share, -1.0, 1.0) * tightest - curvature
        curvature = curvature + jnp.clip(turn, -slope * speed * dt, slope * speed * dt)
        # Last: where the speed rises the slope must not keep a turn too tight.
        curvature = jnp.clip(curvature, -tightest, tightest)
        return (speed, along + speed * dt, curvature), (speed, curvature)

    start = (wanted[0], jnp.zeros(()), jnp.zeros(()))
    return jax.lax.scan(step, start, (wanted, rates, changes))[1]


def _wanted_speeds(
    key: Key, group: Int[Array, ""], limits: DriveClass, *, steps: int, dt: float
) -> tuple[Array, Array]:
    """The speed that a drive goes to [m/s] and at which rate [m/s²], at every step."""
    level_key, swing_key, leg_key, goal_key, rate_key, kind_key = jax.random.split(
        key, 6
    )
    low, high = limits.speed
    time = jnp.arange(steps) * dt
    legs = int(steps * dt / LEG[0]) + 2
    leg = jnp.searchsorted(jnp.cumsum(within(LEG, leg_key, legs)), time)
    # A quarter beyond the range, then clipped: its ends are reached and held.
    beyond = 0.25 * (high - low)
    goals = within((low - beyond, high + beyond), goal_key, legs)
    rates = within((0.25, 1.25), rate_key, legs)
    # Half of the drives with lane changes brake and accelerate as well.
    moves = (group == 1) | ((group == 2) & (jax.random.uniform(kind_key) < 0.5))
    # Others swing slowly about a level, not scaled to the range: its ends are reached.
    level = within(limits.speed, level_key)
    swing, period, begins = jax.random.uniform(swing_key, (3,))
    swings = level + 0.8 * swing * jnp.sin(
        2 * jnp.pi * (time / (5.0 + 15.0 * period) + begins)
    )
    wanted = jnp.clip(jnp.where(moves, goals[leg], swings), low, high)
    rate = jnp.where(moves, jnp.minimum(rates[leg], 1.0), 1.0)
    return wanted, limits.acceleration * rate


def _sinusoids(key: Key, wavelengths: tuple[float, float]) -> tuple[Array, ...]:
    """Wavelengths, phases and size of the sinusoids of a road, or of a circle.

    A third are circles: the steady turn is where e_y settles widest.
    """
    wave_key, phase_key, size_key, kind_key = jax.random.split(key, 4)
    waves = within(wavelengths, wave_key, 3)
    phases = jax.random.uniform(phase_key, (3,), maxval=2 * jnp.pi)
    size = jnp.sqrt(jax.random.uniform(size_key))
    circle = jax.random.uniform(kind_key) < 1.0 / 3.0
    # The sine of an infinite wavelength is constant, 1 or -1.
    side = jnp.where(phases < jnp.pi, 0.5 * jnp.pi, 1.5 * jnp.pi)[0]
    return (
        jnp.where(circle, jnp.inf, waves),
        jnp.where(circle, side, phases),
        # Three sinusoids seldom peak together: twice their mean, clipped, stays at the
        # extremes for a while as well. A third of the circles are the tightest.
        jnp.where(circle, jnp.minimum(1.5 * size**2, 1.0), 2.0 * size),
    )


def _lane_changes(
    key: Key, *, steps: int, dt: float
) -> tuple[Scalar, Float[Array, " time"]]:
    """Share of the tightest turn that the road takes, and that of lane changes.

    The offset of a change is a quintic, or its heading a sin²: the curvature is one
    period of a wave. A third of the changes follow without a gap.
    """
    over_key, gap_key, size_key, side_key, shape_key, start_key, base_key = (
        jax.random.split(key, 7)
    )
    count = int(steps * dt / CHANGE[0]) + 4
    over = within(CHANGE, over_key, count)
    gaps = jnp.maximum(within((-1.0, 2.0), gap_key, count), 0.0)
    ends = jnp.cumsum(over + gaps)
    # From anywhere in the first change on: a short drive need not wait for one.
    time = jnp.arange(steps) * dt + ends[0] * jax.random.uniform(start_key)
    index = jnp.searchsorted(ends, time)
    t = jnp.clip(1.0 - (ends[index] - time) / over[index], 0.0, 1.0)
    quintic = (60.0 * t - 180.0 * t**2 + 120.0 * t**3) / STEEPEST
    is_quintic = jax.random.uniform(shape_key) < 0.5
    shape = jnp.where(is_quintic, quintic, jnp.sin(2 * jnp.pi * t))
    sizes = within((0.3, 1.3), size_key, count)
    sides = jax.random.rademacher(side_key, (count,), dtype=float)
    base = jnp.maximum(within((-1.0, 0.5), base_key), 0.0)
    return base, (jnp.minimum(sizes, 1.0) * sides)[index] * shape
