"""Schedules drawn at random: values from a box, each held for some time."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Environment, Key, Scalar

Range = tuple[float, float]
Corner = tuple[float, ...] | Environment


def random_switching(
    key: Key,
    *,
    steps: int,
    dt: float,
    low: Corner,
    high: Corner,
    dwell: Range = (3.0, 6.0),
) -> Float[Array, "time environment"]:
    """Draw environments from a box, each of which is held for some time.

    Args:
        key: consumed.
        steps: number of time steps.
        dt: sampling period [s].
        low: lower corner of the box, (environment,), in units of e.
        high: upper corner of the box.
        dwell: range of the time between two switches [s].
    """
    level_key, hold_key = jax.random.split(key)
    # Enough even if every environment is held for the shortest time.
    count = int(steps * dt / dwell[0]) + 2
    drawn = partial(from_box, low=low, high=high)
    levels = jax.vmap(drawn)(jax.random.split(level_key, count))
    ends = jnp.cumsum(within(dwell, hold_key, count))
    return levels[jnp.searchsorted(ends, jnp.arange(steps) * dt, side="right")]


def within(
    bounds: tuple[float | Scalar, float | Scalar], key: Key, *shape: int
) -> Float[Array, "*shape"]:
    """Draw an array of the given shape, uniform in a range."""
    return jax.random.uniform(key, shape, minval=bounds[0], maxval=bounds[1])


def from_box(key: Key, low: Corner, high: Corner) -> Float[Array, " environment"]:
    """Draw a point of a box; each entry is at an end of its range with probability 1/3.

    The ends are drawn so often because models are worst there.
    """
    # A sixth of the wider range lies beyond each end, and is clipped to it.
    share = jnp.clip(within((-0.25, 1.25), key, len(low)), 0.0, 1.0)
    bottom = jnp.asarray(low)
    top = jnp.asarray(high)
    return bottom + share * (top - bottom)
