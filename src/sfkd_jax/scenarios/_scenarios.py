"""Scenario families: key -> start, environment and path of one episode, as arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp

from sfkd_jax.ranges import Positive, Span
from sfkd_jax.scenarios._conditions import (
    Schedule,
    steady_road,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.scenarios._manoeuvres import MANOEUVRES, Manoeuvre
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

FAMILIES: dict[str, Callable[[Key, int, float], Schedule]] = {
    "s1": lambda key, steps, dt: uniform_road(key, steps=steps),
    "s2": lambda key, steps, dt: wet_road(key, steps=steps, dt=dt),
    "s3": lambda key, steps, dt: switching_road(key, steps=steps, dt=dt),
    "seen": lambda key, steps, dt: steady_road(
        key, steps=steps, friction=(0.55, 0.9), wind=(0.0, 8.0)
    ),
    "interpolated": lambda key, steps, dt: steady_road(
        key, steps=steps, friction=(0.5, 0.55), wind=(4.0, 8.0)
    ),
    "extrapolated": lambda key, steps, dt: steady_road(
        key, steps=steps, friction=(0.27, 0.3), wind=(8.0, 9.0)
    ),
}
"""Environments of random roads: name -> (key, steps, sampling period [s]) -> e."""
NAMES = (*FAMILIES, *MANOEUVRES)


def scenario(
    *,
    name: str,
    duration: float,
    speed: Positive = 10.0,
    peak_curvature: float = 0.02,
    wavelengths: Span = (50.0, 160.0),
    state_size: int,
    dt: float,
) -> Family:
    """Return a family of the benchmark by name.

    "s1" is a uniform road, "s2" a wet road with gusts, "s3" a switching road. Three
    more have one constant pair of friction and wind per episode: "seen" in the range of
    the training drives, "interpolated" between friction levels that these have under
    wind, "extrapolated" outside their box. Manoeuvres have paths of their own:
    "double_lane_change", "gust_step", "gust_cosine", "friction_step", "braking_turn",
    and "silverstone", the circuit, with the environment of "s3".

    Args:
        name: of the family.
        duration: of an episode [s].
        speed: to hold [m/s].
        peak_curvature: of a random path, see `smooth_path`.
        wavelengths: of a random path, see `smooth_path`.
        state_size: of the vehicle; the episode starts on the path at `speed`, other
            body states zero.
        dt: sampling period [s].

    Raises:
        ValueError: unknown name.
    """
    if name not in NAMES:
        raise ValueError(f"unknown scenario {name!r}; choose one of {', '.join(NAMES)}")
    steps, length = round(duration / dt), speed * duration * 1.1 + 50.0

    def random_road(key: Key, length: float) -> Path:
        return smooth_path(
            key, length=length, peak_curvature=peak_curvature, wavelengths=wavelengths
        )

    chosen = MANOEUVRES.get(name) or Manoeuvre(random_road, FAMILIES[name])
    return family(
        lambda key: chosen.conditions(key, steps, dt),
        lambda key: chosen.path(key, length),
        speed=speed,
        state_size=state_size,
    )


def family(
    conditions: Callable[[Key], Schedule],
    paths: Callable[[Key], Path],
    *,
    speed: float,
    state_size: int,
) -> Family:
    """Combine a schedule of conditions and a family of paths.

    Args:
        conditions: key -> e_0 … e_{T-1}.
        paths: key -> path from the origin along x.
        speed: to hold [m/s].
        state_size: of the vehicle.
    """

    def sample(key: Key) -> Scenario:
        path_key, condition_key = jax.random.split(key)
        start = jnp.zeros(state_size).at[3].set(speed)
        envs = conditions(condition_key)
        return Scenario(start, envs, envs, paths(path_key), jnp.asarray(speed))

    return sample
