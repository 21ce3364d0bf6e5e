"""Scenario families: a key in, one episode's road, weather and start out, as arrays only."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from sfkd_jax.scenarios._conditions import (
    Schedule,
    steady_road,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.scenarios._paths import Path, smooth_path
from sfkd_jax.types import Key, Scalar, State


class Scenario(NamedTuple):
    """The task of one episode: start, environment, path and speed.

    Attributes:
        initial_state: x_0.
        envs: e_0 … e_{T-1} that the plant is in, (time, 2).
        observed_envs: the same as the controller observes it, (time, 2).
        path: to follow.
        speed: to hold [m/s].
    """

    initial_state: State
    envs: Schedule
    observed_envs: Schedule
    path: Path
    speed: Scalar


Family: TypeAlias = Callable[[Key], Scenario]
Conditions: TypeAlias = Callable[..., Schedule]


def scenario(
    *,
    name: str,
    duration: float,
    speed: float = 10.0,
    peak_curvature: float = 0.02,
    wavelengths: tuple[float, float] = (50.0, 160.0),
    state_size: int,
    dt: float,
) -> Family:
    """The family `name` of the benchmark: "s1" uniform road, "s2" wet road with gusts, "s3" switching road.

    Three more hold one pair of friction and wind for an episode: "seen" as training
    drives have it, "interpolated" between friction levels that they have under wind,
    "extrapolated" beyond the box that they cover.

    Args:
        name: which.
        duration: of an episode [s].
        speed: to hold [m/s].
        peak_curvature, wavelengths: of the random path, see `smooth_path`.
        state_size: of the vehicle; the episode starts on the path at `speed`, other
            body states zero.
        dt: sampling period [s].

    Raises:
        ValueError: unknown name.
    """
    steps = round(duration / dt)
    table = {
        "s1": partial(uniform_road, steps=steps),
        "s2": partial(wet_road, steps=steps, dt=dt),
        "s3": partial(switching_road, steps=steps, dt=dt),
        "seen": partial(
            steady_road, steps=steps, friction=(0.55, 0.9), wind=(0.0, 8.0)
        ),
        "interpolated": partial(
            steady_road, steps=steps, friction=(0.5, 0.55), wind=(4.0, 8.0)
        ),
        "extrapolated": partial(
            steady_road, steps=steps, friction=(0.27, 0.3), wind=(8.0, 9.0)
        ),
    }
    if name not in table:
        raise ValueError(f"unknown scenario {name!r}; choose one of {', '.join(table)}")
    return family(
        table[name],
        length=speed * duration * 1.1 + 50.0,
        speed=speed,
        peak_curvature=peak_curvature,
        wavelengths=wavelengths,
        state_size=state_size,
    )


def family(
    conditions: Conditions,
    *,
    length: float,
    speed: float,
    peak_curvature: float,
    wavelengths: tuple[float, float],
    state_size: int,
) -> Family:
    """Join a schedule of conditions and a family of paths to a family of scenarios."""

    def sample(key: Key) -> Scenario:
        path_key, condition_key = jax.random.split(key)
        path = smooth_path(
            path_key,
            length=length,
            peak_curvature=peak_curvature,
            wavelengths=wavelengths,
        )
        start = jnp.zeros(state_size).at[3].set(speed)
        envs = conditions(condition_key)
        return Scenario(start, envs, envs, path, jnp.asarray(speed))

    return sample
