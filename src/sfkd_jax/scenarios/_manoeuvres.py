"""Standard manoeuvres, repeated along an episode: path, pace and environment."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.scenarios._conditions import Schedule, switching_road
from sfkd_jax.scenarios._paths import SPACING, Path, blended_in, path_from_curvature
from sfkd_jax.scenarios._silverstone import lap
from sfkd_jax.types import Key, Scalar

RUN_UP = (20.0, 50.0)
"""Range of the straight road before the first manoeuvre [m]."""
LANE = 3.5
"""Offset of a lane change [m]."""
SECTIONS = (30.0, 25.0, 25.0)
"""Lengths of the change, the other lane and the change back [m], as in ISO 3888-1."""
PERIOD = 150.0
"""From one manoeuvre to the next [m]."""
RADIUS = 50.0
"""Of a turn [m]."""
WIND = 8.0
"""Of a gust [m/s]."""
DRY, WET, SLIPPERY = 0.9, 0.6, 0.35
"""Levels of friction [-]."""


class Manoeuvre(NamedTuple):
    """A path and an environment that belong together.

    Attributes:
        path: (key, length [m]) -> path.
        conditions: (key, steps, sampling period [s]) -> e_0 … e_{T-1}.
    """

    path: Callable[[Key, float], Path]
    conditions: Callable[[Key, int, float], Schedule]


def lane_changes(key: Key, length: float) -> Path:
    """Change to the lane at a random side and back, once a period (ISO 3888-1).

    The heading of a change over ℓ is θ sin²(π s/ℓ), whose offset is close to θ ℓ / 2.
    """
    first, middle, last = SECTIONS
    s, side = _since_start(key, length)

    def change(begin: float, over: float, towards: float) -> Float[Array, " point"]:
        share = jnp.clip((s - begin) / over, 0.0, 1.0)
        largest = 2.0 * LANE / over
        return towards * largest * jnp.pi / over * jnp.sin(2.0 * jnp.pi * share)

    curvature = change(0.0, first, 1.0) + change(first + middle, last, -1.0)
    return path_from_curvature(side * curvature, spacing=SPACING)


def straight(key: Key, length: float) -> Path:
    """Drive straight ahead; nothing is drawn from the key."""
    del key
    return path_from_curvature(jnp.zeros(_points(length)), spacing=SPACING)


def turn(key: Key, length: float) -> Path:
    """Turn to a random side with a constant radius, after a straight road."""
    s, side = _since_start(key, length, repeated=False)
    curvature = blended_in(side / RADIUS, s)
    return path_from_curvature(curvature, spacing=SPACING)


def braking_turn(key: Key, length: float) -> Path:
    """`turn`, in which the speed is halved within 15 m and regained within 45 m.

    v² is linear in s, as with constant accelerations: −2.5 and 0.8 m/s² at 10 m/s.
    """
    road = turn(key, length)
    s = jnp.arange(_points(length)) * SPACING - 2.0 * RUN_UP[1]
    s = jnp.where(s > 0, s % PERIOD, PERIOD)
    squares = jnp.interp(
        s, jnp.asarray([0.0, 15.0, 35.0, 80.0]), jnp.asarray([1.0, 0.25, 0.25, 1.0])
    )
    return road._replace(pace=jnp.sqrt(squares))


def gust_steps(key: Key, steps: int, dt: float) -> Schedule:
    """Gusts that begin and end at once: every 6 s for 3 s, from a random side."""
    phase, side = _phase(key, steps, dt, period=6.0)
    return _schedule(DRY, jnp.where(phase < 0.5, side * WIND, 0.0))


def gust_cosines(key: Key, steps: int, dt: float) -> Schedule:
    """Gusts of the shape 1 − cos, every 6 s for 3 s, from a random side."""
    phase, side = _phase(key, steps, dt, period=6.0)
    shape = 0.5 - 0.5 * jnp.cos(4.0 * jnp.pi * jnp.minimum(phase, 0.5))
    return _schedule(DRY, side * WIND * shape)


def friction_drops(key: Key, steps: int, dt: float, *, to: float) -> Schedule:
    """Friction of a dry road that drops for 3 s of every 6."""
    phase, _ = _phase(key, steps, dt, period=6.0)
    return _schedule(jnp.where(phase < 0.5, to, DRY), jnp.zeros(steps))


def wet(key: Key, steps: int, dt: float) -> Schedule:
    """Friction from wet to dry, constant for an episode, and no wind."""
    del dt
    level = jax.random.uniform(key, (), minval=WET, maxval=DRY)
    return _schedule(jnp.full(steps, level), jnp.zeros(steps))


MANOEUVRES = {
    "double_lane_change": Manoeuvre(lane_changes, wet),
    "gust_step": Manoeuvre(straight, gust_steps),
    "gust_cosine": Manoeuvre(straight, gust_cosines),
    "friction_step": Manoeuvre(turn, partial(friction_drops, to=SLIPPERY)),
    "braking_turn": Manoeuvre(braking_turn, partial(friction_drops, to=WET)),
    "silverstone": Manoeuvre(
        lap, lambda key, steps, dt: switching_road(key, steps=steps, dt=dt)
    ),
}
"""Manoeuvres by the names of their scenarios."""


def _points(length: float) -> int:
    """Samples of a path of at least this length."""
    return int(length / SPACING) + 2


def _since_start(
    key: Key, length: float, *, repeated: bool = True
) -> tuple[Float[Array, " point"], Scalar]:
    """Arc length from the start of a manoeuvre [m], and its side, 1 or −1."""
    start_key, side_key = jax.random.split(key)
    start = jax.random.uniform(start_key, (), minval=RUN_UP[0], maxval=RUN_UP[1])
    s = jnp.arange(_points(length)) * SPACING - start
    if repeated:
        s = jnp.where(s > 0, s % PERIOD, s)
    return s, jax.random.rademacher(side_key, (), dtype=float)


def _phase(
    key: Key, steps: int, dt: float, *, period: float
) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
    """Share of the period that has passed, and the side drawn for it, 1 or −1.

    The first period starts after 3 to 6 s; before it the share is 1.
    """
    start_key, side_key = jax.random.split(key)
    start = jax.random.uniform(start_key, (), minval=3.0, maxval=6.0)
    time = jnp.arange(steps) * dt - start
    count = int(steps * dt / period) + 1
    sides = jax.random.rademacher(side_key, (count,), dtype=float)
    number = jnp.clip(jnp.floor(time / period).astype(int), 0, count - 1)
    return jnp.where(time < 0, 1.0, time / period % 1.0), sides[number]


def _schedule(friction: Array | float, wind: Float[Array, " time"]) -> Schedule:
    """Friction and wind as a schedule."""
    return jnp.stack([jnp.broadcast_to(friction, wind.shape), wind], axis=1)
