"""Schedules of the environment in generated runs, and how many runs have which."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.driving.scenarios import (
    BOX,
    held_road,
    in_box,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.schedules import random_switching
from sfkd_jax.types import Key

Conditions: TypeAlias = Callable[[Key], Float[Array, "time environment"]]
"""Maps a key to e_0 … e_{T-1}."""

SCENARIOS = ("uniform", "wet", "held", "switching")
"""Environments of generated segments: a uniform road, friction that drops under gusts,
e held anywhere in E, and e switching anywhere in E. Their levels are drawn at random;
those of the benchmark are in `scenarios.ROADS`.
"""
UNIFORM_FRICTION = (0.3, 0.9)
"""Range of the friction of a uniform road [-]."""
WET_BEFORE = (0.55, 0.9)
"""Range of the friction of a wet road before it drops [-]."""
WET_AFTER = (0.3, 0.5)
"""Range of the friction of a wet road after it has dropped [-]."""
SWITCHES = (1.5, 6.0)
"""Range of the time between two switches of e [s]."""


def segment_scenarios(
    segments: int, *, along_path: bool = False
) -> Int[np.ndarray, " segment"]:
    """Return the scenario of every generated segment, as index into `SCENARIOS`.

    Args:
        segments: number of them.
        along_path: whether `generate_along_path` makes them, or `generate`.
    """
    counts = counts_by_scenario(segments, along_path=along_path)
    return np.repeat(np.arange(len(counts), dtype=np.int32), list(counts.values()))


def counts_by_scenario(segments: int, *, along_path: bool) -> dict[str, int]:
    """Return the number of segments by scenario, in the order of their generation."""
    if along_path:
        quarter = segments // 4
        sizes = (quarter, quarter, quarter, segments - 3 * quarter)
    else:
        sizes = (segments - segments // 2, segments // 2)
    return dict(zip(SCENARIOS, sizes, strict=False))


def schedules_in_world(
    steps: int, dt: float, env_low: tuple[float, ...], env_high: tuple[float, ...]
) -> dict[str, Conditions]:
    """Return the conditions of segments in the world, and S3, by name.

    Args:
        steps: of a segment.
        dt: sampling period [s].
        env_low: lower corner of E, which the levels are moved into by `in_box`.
        env_high: upper corner of E.
    """

    def uniform(key: Key) -> Float[Array, "time environment"]:
        road = uniform_road(key, steps=steps, friction=UNIFORM_FRICTION)
        return in_box(road, env_low, env_high)

    def wet(key: Key) -> Float[Array, "time environment"]:
        road = wet_road(
            key,
            steps=steps,
            dt=dt,
            before=WET_BEFORE,
            after=WET_AFTER,
            # Friction may drop at any time of the segment.
            drop_time=(0.0, steps * dt),
        )
        return in_box(road, env_low, env_high)

    return {"uniform": uniform, "wet": wet, "s3": from_s3(steps, dt, env_low, env_high)}


def schedules_along_path(
    steps: int, dt: float, env_low: tuple[float, ...], env_high: tuple[float, ...]
) -> dict[str, Conditions]:
    """Return the conditions of segments along a path, and S3, by name.

    The arguments are those of `schedules_in_world`.
    """
    schedules = schedules_in_world(steps, dt, env_low, env_high)
    schedules["held"] = partial(held_road, steps=steps, low=env_low, high=env_high)
    schedules["switching"] = partial(
        random_switching,
        steps=steps,
        dt=dt,
        low=env_low,
        high=env_high,
        dwell=SWITCHES,
    )
    return schedules


def from_s3(
    steps: int,
    dt: float,
    env_low: tuple[float, ...] = BOX[0],
    env_high: tuple[float, ...] = BOX[1],
) -> Conditions:
    """Return the schedule of S3 in the box E, from a random time of it on."""

    def conditions(key: Key) -> Float[Array, "time environment"]:
        road_key, moment_key = jax.random.split(key)
        schedule = switching_road(road_key, steps=4 * steps, dt=dt)
        schedule = in_box(schedule, env_low, env_high)
        first = jax.random.randint(moment_key, (), 0, 3 * steps)
        return jax.lax.dynamic_slice_in_dim(schedule, first, steps)

    return conditions


def planned_segments(
    key: Key, schedules: dict[str, Conditions], counts: dict[str, int]
) -> list[tuple[Conditions, Array]]:
    """Return the conditions of every scenario, and a key for each of its segments.

    Args:
        key: consumed.
        schedules: conditions by name.
        counts: number of segments by name, of `counts_by_scenario`.
    """
    return [
        (schedules[name], jax.random.split(jax.random.fold_in(key, index), count))
        for index, (name, count) in enumerate(counts.items())
    ]


def held_out_segments(
    key: Key, schedules: dict[str, Conditions], segments: int
) -> list[tuple[Conditions, Array]]:
    """Return the conditions of S3 and a key for each segment, for tests."""
    return [(schedules["s3"], jax.random.split(key, segments))]
