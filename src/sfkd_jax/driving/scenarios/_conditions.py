"""Schedules of the environment e = (friction [-], side wind [m/s]) over time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.schedules import Corner, Range, from_box, within
from sfkd_jax.types import Key, Scalar

Schedule = Float[Array, "time 2"]
"""Friction [-] and side wind [m/s] over time."""

SWITCH_LEVELS = ((0.9, 0.0), (0.6, 4.0), (0.3, 8.0), (0.6, 4.0))
"""Levels (friction [-], |wind| [m/s]) of S3 in their order A, B, C, B, then A again."""
SWITCH_PERIOD = 3.0
"""Time between two switches of S3 [s]."""
PEAK_WIND = 8.0
"""Largest gust of S2 [m/s]."""
BOX = ((0.3, -PEAK_WIND), (0.9, PEAK_WIND))
"""Lower and upper corner of the environments of the benchmark. All levels and ranges of
its schedules lie in this box.
"""
GUST_HOLD = (1.0, 3.0)
"""Range of the time from the start of one gust to that of the next [s]."""
GUST_RAMP = 0.5
"""Time in which the wind changes at the start of a gust [s]."""


def uniform_road(key: Key, *, steps: int, friction: Range = (0.9, 0.9)) -> Schedule:
    """Draw S1: one friction level from a range for the whole time, and no wind.

    Args:
        key: consumed.
        steps: number of time steps.
        friction: range of the level [-].
    """
    level = within(friction, key)
    return jnp.stack([jnp.full(steps, level), jnp.zeros(steps)], axis=1)


def wet_road(
    key: Key,
    *,
    steps: int,
    dt: float,
    before: Range = (0.7, 0.7),
    after: Range = (0.35, 0.35),
    drop_time: Range = (5.0, 5.0),
) -> Schedule:
    """Draw S2: friction drops abruptly once, while smooth gusts blow.

    Args:
        key: consumed.
        steps: number of time steps.
        dt: sampling period [s].
        before: range of the friction before the drop [-].
        after: range of the friction after it [-].
        drop_time: range of its time [s].
    """
    before_key, after_key, time_key, gust_key = jax.random.split(key, 4)
    high = within(before, before_key)
    low = within(after, after_key)
    # 1e-6 s, because k dt may round to just below the time of the drop.
    dry = jnp.arange(steps) * dt < within(drop_time, time_key) - 1e-6
    wind = gusts(gust_key, steps=steps, dt=dt, peak=PEAK_WIND)
    return jnp.stack([jnp.where(dry, high, low), wind], axis=1)


def switching_road(key: Key, *, steps: int, dt: float) -> Schedule:
    """Draw S3: the next of `SWITCH_LEVELS` every period, with wind from a random side.

    Args:
        key: consumed.
        steps: number of time steps.
        dt: sampling period [s].
    """
    # One visit more than there are full periods, for the part of one at the end.
    visits = int(steps * dt / SWITCH_PERIOD) + 1
    sides = jax.random.rademacher(key, (visits,), dtype=float)
    levels = jnp.asarray(SWITCH_LEVELS)[jnp.arange(visits) % len(SWITCH_LEVELS)]
    # Friction is the first column and has no side.
    levels = levels.at[:, 1].multiply(sides)
    # 1e-6, so that rounding does not change the number of steps from period to period.
    visit = jnp.floor(jnp.arange(steps) * dt / SWITCH_PERIOD + 1e-6).astype(int)
    return levels[visit]


def in_box(envs: Schedule, low: Corner, high: Corner) -> Float[Array, "time env"]:
    """Move a schedule of the benchmark from `BOX` to another box of environments.

    The first entry of the new environment takes the place of the friction: it is at the
    same share of the way from its lower to its upper end. All other entries take the
    place of the wind, as a share of `PEAK_WIND`. If 0 lies inside the range of such an
    entry, it goes to both sides of 0, otherwise from its lower end upwards. For `BOX`
    itself the schedule is returned unchanged, to the last bit.

    Args:
        envs: (friction, wind) over time.
        low: lower corner of E, in units of e.
        high: upper corner of E.
    """
    if (tuple(low), tuple(high)) == BOX:
        return envs
    grip = (envs[:, :1] - BOX[0][0]) / (BOX[1][0] - BOX[0][0])
    wind = jnp.repeat(envs[:, 1:] / PEAK_WIND, len(low) - 1, axis=1)
    bottom = jnp.asarray(low)
    top = jnp.asarray(high)
    first = bottom[:1] + grip * (top - bottom)[:1]
    spans_zero = (bottom < 0.0) & (top > 0.0)
    from_zero = jnp.where(wind < 0.0, -wind * bottom[1:], wind * top[1:])
    from_low_end = bottom[1:] + jnp.abs(wind) * (top - bottom)[1:]
    others = jnp.where(spans_zero[1:], from_zero, from_low_end)
    return jnp.concatenate([first, others], axis=1)


def random_side_forces(
    key: Key, *, steps: int, dt: float, largest: float | Scalar, hold: float = 1.0
) -> Float[Array, " time"]:
    """Draw side forces that nobody measures, uniform in [-F, F] [N].

    Args:
        key: consumed. With the same key, the forces are the same shares of every F.
        steps: number of time steps.
        dt: sampling period [s].
        largest: F [N].
        hold: time for which a force stays constant [s].
    """
    # In whole steps: the plant holds its inputs during a step.
    hold_steps = round(hold / dt)
    count = -(-steps // hold_steps)
    shares = jax.random.uniform(key, (count,), minval=-1.0)
    return largest * jnp.repeat(shares, hold_steps)[:steps]


def gusts(key: Key, *, steps: int, dt: float, peak: float) -> Float[Array, " time"]:
    """Draw wind levels, uniform in [-peak, peak], joined by 1 − cos ramps [m/s].

    Args:
        key: consumed.
        steps: number of time steps.
        dt: sampling period [s].
        peak: largest wind [m/s].
    """
    level_key, hold_key = jax.random.split(key)
    # Enough even if all times between gusts are the shortest. The rest is not used.
    count = int(steps * dt / GUST_HOLD[0]) + 2
    levels = within((-peak, peak), level_key, count + 1)
    starts = jnp.cumsum(within(GUST_HOLD, hold_key, count))
    time = jnp.arange(steps) * dt
    gust = jnp.searchsorted(starts, time, side="right")
    # Gust 0 blows from the beginning: its ramp counts as over at time 0.
    since_start = time - jnp.where(gust > 0, starts[gust - 1], -GUST_RAMP)
    ramp = jnp.clip(since_start / GUST_RAMP, 0.0, 1.0)
    blend = 0.5 - 0.5 * jnp.cos(jnp.pi * ramp)
    # No gust comes before gust 0, and a negative index would wrap to the last one.
    before = levels[jnp.maximum(gust - 1, 0)]
    return before + (levels[gust] - before) * blend


def held_road(
    key: Key, *, steps: int, low: tuple[float, ...], high: tuple[float, ...]
) -> Float[Array, "time environment"]:
    """Draw one environment from the box E, for the whole time.

    Each entry is uniform in its range or, with probability 1/3, at one of its ends.

    Args:
        key: consumed.
        steps: number of time steps.
        low: lower corner of E, in units of e.
        high: upper corner of E.
    """
    return jnp.tile(from_box(key, low, high), (steps, 1))
