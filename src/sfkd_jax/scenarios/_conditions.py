"""Schedules of the environment e = (friction [-], side wind [m/s]) over time."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Environment, Key, Scalar

Range = tuple[float, float]
Corner = tuple[float, ...] | Environment
Schedule = Float[Array, "time 2"]

SWITCH_LEVELS = ((0.9, 0.0), (0.6, 4.0), (0.3, 8.0), (0.6, 4.0))
"""S3's order A, B, C, B, A, …: (friction, |wind|)."""
SWITCH_PERIOD = 3.0
"""Between two switches of S3 [s]."""
PEAK_WIND = 8.0
"""Largest gust of S2 [m/s]."""
BOX = ((0.3, -PEAK_WIND), (0.9, PEAK_WIND))
"""The environments of the benchmark, which levels and ranges are about."""
HOLD, RAMP = (1.0, 3.0), 0.5
"""Of gusts: range of the time from one ramp to the next, and its duration [s]."""


def uniform_road(key: Key, *, steps: int, friction: Range = (0.9, 0.9)) -> Schedule:
    """S1: one friction level from a range, no wind.

    Args:
        steps: length.
        friction: range [-].
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
    """S2: friction drops abruptly once, while smooth gusts blow.

    Args:
        steps: length.
        dt: sampling period [s].
        before: range of the friction before the drop [-].
        after: range of the friction after it [-].
        drop_time: range of its time [s].
    """
    before_key, after_key, time_key, gust_key = jax.random.split(key, 4)
    high = within(before, before_key)
    low = within(after, after_key)
    # A hair early: k dt may round to just below the time of the drop.
    dry = jnp.arange(steps) * dt < within(drop_time, time_key) - 1e-6
    wind = gusts(gust_key, steps=steps, dt=dt, peak=PEAK_WIND)
    return jnp.stack([jnp.where(dry, high, low), wind], axis=1)


def switching_road(key: Key, *, steps: int, dt: float) -> Schedule:
    """S3: the next of the levels A, B, C, B, A, … every period, wind side random.

    Args:
        steps: length.
        dt: sampling period [s].
    """
    # One visit more, for the rest of a period at the end.
    visits = int(steps * dt / SWITCH_PERIOD) + 1
    sides = jax.random.rademacher(key, (visits,), dtype=float)
    levels = jnp.asarray(SWITCH_LEVELS)[jnp.arange(visits) % len(SWITCH_LEVELS)]
    # Friction is the first column and has no side.
    levels = levels.at[:, 1].multiply(sides)
    # The same hair, so that a period has the same number of steps each time.
    visit = jnp.floor(jnp.arange(steps) * dt / SWITCH_PERIOD + 1e-6).astype(int)
    return levels[visit]


def in_box(envs: Schedule, low: Corner, high: Corner) -> Float[Array, "time env"]:
    """Move a schedule of the benchmark to another box, at the same shares of its ends.

    The first entry takes the place of the friction, from its lower to its upper end;
    all others that of the wind: to both sides if 0 lies inside their range, else from
    the lower end on. In the benchmark's own box nothing changes, not a bit.

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
    sided = (bottom < 0.0) & (top > 0.0)
    from_zero = jnp.where(wind < 0.0, -wind * bottom[1:], wind * top[1:])
    from_end = bottom[1:] + jnp.abs(wind) * (top - bottom)[1:]
    first = bottom[:1] + grip * (top - bottom)[:1]
    return jnp.concatenate([first, jnp.where(sided[1:], from_zero, from_end)], axis=1)


def random_side_forces(
    key: Key, *, steps: int, dt: float, largest: float | Scalar, hold: float = 1.0
) -> Float[Array, " time"]:
    """Draw unmeasured side forces, uniform in [-F, F], each constant for a while [N].

    Args:
        key: consumed; the same key gives the same forces at every F, up to the factor.
        steps: length.
        dt: sampling period [s].
        largest: F [N].
        hold: duration of a level [s].
    """
    # In whole steps: a force that changed within a step would not be held by it.
    each = round(hold / dt)
    # Shares of F: the same pushes at every size.
    levels = jax.random.uniform(key, (-(-steps // each),), minval=-1.0)
    return largest * jnp.repeat(levels, each)[:steps]


def gusts(key: Key, *, steps: int, dt: float, peak: float) -> Float[Array, " time"]:
    """Draw wind levels, uniform in [-peak, peak], joined by 1 − cos ramps [m/s].

    Args:
        steps: length.
        dt: sampling period [s].
        peak: [m/s].
    """
    level_key, hold_key = jax.random.split(key)
    # Enough for the shortest holds; what is beyond the end is not used.
    count = int(steps * dt / HOLD[0]) + 2
    levels = within((-peak, peak), level_key, count + 1)
    starts = jnp.cumsum(within(HOLD, hold_key, count))
    time = jnp.arange(steps) * dt
    gust = jnp.searchsorted(starts, time, side="right")
    # Before the first ramp the level is that of gust 0, as if its ramp were over.
    since = time - jnp.where(gust > 0, starts[gust - 1], -RAMP)
    blend = 0.5 - 0.5 * jnp.cos(jnp.pi * jnp.clip(since / RAMP, 0.0, 1.0))
    # Gust 0 has none before it, and a negative index would wrap to the last.
    before = levels[jnp.maximum(gust - 1, 0)]
    return before + (levels[gust] - before) * blend


def held_road(
    key: Key, *, steps: int, low: tuple[float, ...], high: tuple[float, ...]
) -> Float[Array, "time environment"]:
    """One constant environment from the box E.

    Each entry is uniform in its range or, with probability 1/3, at one of its ends.

    Args:
        steps: length.
        low: lower corner of E, in units of e.
        high: upper corner of E.
    """
    return jnp.tile(_from_box(key, low, high), (steps, 1))


def random_switching(
    key: Key,
    *,
    steps: int,
    dt: float,
    low: Corner,
    high: Corner,
    dwell: Range = (3.0, 6.0),
) -> Float[Array, "time environment"]:
    """Environments from the box E, as in `held_road`, each held for some time.

    Args:
        steps: length.
        dt: sampling period [s].
        low: lower corner of E, (environment,), in units of e.
        high: upper corner of E.
        dwell: range of the time between two switches [s].
    """
    level_key, hold_key = jax.random.split(key)
    # One level more than the shortest dwells need.
    count = int(steps * dt / dwell[0]) + 2
    levels = jax.vmap(lambda key: _from_box(key, low, high))(
        jax.random.split(level_key, count)
    )
    ends = jnp.cumsum(within(dwell, hold_key, count))
    return levels[jnp.searchsorted(ends, jnp.arange(steps) * dt, side="right")]


def within(
    bounds: tuple[float | Scalar, float | Scalar], key: Key, *shape: int
) -> Float[Array, "*shape"]:
    """Draw uniformly from a range."""
    return jax.random.uniform(key, shape, minval=bounds[0], maxval=bounds[1])


def _from_box(key: Key, low: Corner, high: Corner) -> Float[Array, " environment"]:
    """A point of a box; each entry is at an end of its range with probability 1/3."""
    # A wider range, clipped: the ends, where models are worst, are drawn often.
    share = jnp.clip(within((-0.25, 1.25), key, len(low)), 0.0, 1.0)
    bottom = jnp.asarray(low)
    top = jnp.asarray(high)
    return bottom + share * (top - bottom)
