"""Scenario families: key -> start, environment, path and obstacles of one episode."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.lanes import Lane, Obstacles, circles, clearance, lane_along
from sfkd_jax.paths import SPACING, Path, path_from_curvature, point_at
from sfkd_jax.ranges import Positive, Span
from sfkd_jax.scenarios._conditions import (
    BOX,
    Schedule,
    in_box,
    switching_road,
    uniform_road,
    wet_road,
    within,
)
from sfkd_jax.types import Key, Scalar, State

RUN_UP = 20.0
"""Over which the curvature of a path is blended in [m]."""
FIRST = 70.0
"""Arc length of the first obstacle at the earliest [m]: out of sight at the start."""
GAP = (40.0, 60.0)
"""Range of the distance from one obstacle to the next [m]."""
PASSED = 15.0
"""Distance behind the car at which an obstacle is out of its way [m]."""
CAR = (2.25, 1.0)
"""Half of length and width of the car [m]."""
IN_VIEW = 4
"""Most obstacles that a controller is shown, the ones that are passed next."""


class Course(NamedTuple):
    """A lane with obstacles, each of which is seen from a distance on.

    Attributes:
        lane: with its path.
        obstacles: all of them, in the order in which they are passed.
        along: arc length of the path beside each [m], rising, (obstacle,).
        view: distance along the path from which each is seen [m], (obstacle,).
    """

    lane: Lane
    obstacles: Obstacles
    along: Float[Array, " obstacle"]
    view: Float[Array, " obstacle"]


def random_course(key: Key, path: Path, *, speed: float = 10.0) -> Course:
    """Draw obstacles up to 1.5 m beside a path, of radius 0.8 m, seen from 60 m on.

    The lane is as wide as three, so that the car may pass each of them on either side.

    Args:
        key: consumed.
        path: open; its last 50 m stay free.
        speed: wanted [m/s].
    """
    gap_key, offset_key = jax.random.split(key)
    length = (path.points.shape[0] - 1) * SPACING
    # As many as the shortest gaps need, and no less than are shown at once.
    count = max(int((length - FIRST) / GAP[0]), IN_VIEW)
    along = FIRST - GAP[0] + jnp.cumsum(within(GAP, gap_key, count))
    aside = within((-1.5, 1.5), offset_key, count)
    obstacles = circles(beside(path, along, aside), 0.8)
    obstacles = obstacles._replace(present=along <= path.length - 50.0)
    lane = lane_along(path, width=10.5, speed=speed)
    return Course(lane, obstacles, along, jnp.full(count, 60.0))


def beside(
    path: Path, along: Float[Array, " place"], aside: Float[Array, " place"]
) -> Float[Array, "place 2"]:
    """Return positions at arc lengths and distances to the left of a path [m]."""
    point = jax.vmap(point_at, in_axes=(None, 0))(path, along)
    normal = jnp.stack([-jnp.sin(point[:, 2]), jnp.cos(point[:, 2])], axis=1)
    return point[:, :2] + aside[:, None] * normal


def in_view(course: Course, progress: Scalar) -> Obstacles:
    """Return what a car sees: of the obstacles to pass, the next `IN_VIEW`.

    Args:
        course: with at least as many obstacles, present or not.
        progress: arc length of the car [m].
    """
    ahead = course.along - progress
    first = jnp.clip(jnp.sum(ahead < -PASSED), 0, course.along.shape[0] - IN_VIEW)
    present = course.obstacles.present & (ahead <= course.view)
    seen = course.obstacles._replace(present=present)
    # A window of constant size: a controller is compiled once for all courses.
    return jax.tree.map(
        lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, IN_VIEW), seen
    )


def car_clearance(obstacles: Obstacles, state: State) -> Scalar:
    """Return how far a car, a box of `CAR`, is from the nearest obstacle now [m]."""
    direction = jnp.stack([jnp.cos(state[2]), jnp.sin(state[2])])
    return jnp.min(clearance(obstacles, state[:2], direction=direction, half=CAR))


class Scenario(NamedTuple):
    """The task of one episode: start, environment, path and speed.

    Attributes:
        initial_state: x_0.
        envs: e_0 … e_{T-1} that the plant is in, (time, environment).
        observed_envs: the same as the controller observes it, (time, environment).
        path: to follow.
        speed: to hold [m/s].
        course: obstacles on the path, or None: the path is to be followed.
    """

    initial_state: State
    envs: Float[Array, "time environment"]
    observed_envs: Float[Array, "time environment"]
    path: Path
    speed: Scalar
    course: Course | None = None


Family: TypeAlias = Callable[[Key], Scenario]


ROADS: dict[str, Callable[..., Schedule]] = {
    "s1": lambda key, steps, dt: uniform_road(key, steps=steps),
    "s2": wet_road,
    "s3": switching_road,
    "obstacles": switching_road,
}
"""Scenarios by name -> (key, steps=, dt=sampling period [s]) -> e_0 … e_{T-1}."""
COURSES: dict[str, Callable[..., Course]] = {"obstacles": random_course}
"""Those with obstacles -> (key, path, speed=v [m/s]) -> obstacles on the path."""


def scenario(
    *,
    name: str,
    duration: float,
    speed: Positive = 10.0,
    peak_curvature: float = 0.02,
    wavelengths: Span = (50.0, 160.0),
    state_size: int,
    dt: float,
    env_low: tuple[float, ...] = BOX[0],
    env_high: tuple[float, ...] = BOX[1],
) -> Family:
    """Return a family of the benchmark by name, see `ROADS`, in any box of e.

    Args:
        name: of the family.
        duration: of an episode [s].
        speed: to hold [m/s].
        peak_curvature: of a random path, see `smooth_path`.
        wavelengths: of a random path, see `smooth_path`.
        state_size: of the vehicle; the episode starts on the path at `speed`, other
            body states zero.
        dt: sampling period [s].
        env_low: lower corner of E, see `in_box`.
        env_high: upper corner of E.
    """
    if name not in ROADS:
        raise ValueError(f"unknown scenario {name!r}; choose one of {', '.join(ROADS)}")
    # round: duration / dt may fall just below the whole number of steps.
    road = ROADS[name]
    steps = round(duration / dt)
    # Longer than the distance by a tenth and a horizon: no plan meets its end.
    length = speed * duration * 1.1 + 50.0

    bends: Any = {"peak_curvature": peak_curvature, "wavelengths": wavelengths}
    path = partial(smooth_path, length=length, **bends)

    def conditions(key: Key) -> Float[Array, "time environment"]:
        return in_box(road(key, steps=steps, dt=dt), env_low, env_high)

    course = COURSES.get(name)
    course = course and partial(course, speed=speed)
    return family(conditions, path, course, speed=speed, state_size=state_size)


def family(
    conditions: Callable[[Key], Float[Array, "time environment"]],
    paths: Callable[[Key], Path],
    courses: Callable[[Key, Path], Course] | None = None,
    *,
    speed: float,
    state_size: int,
) -> Family:
    """Combine conditions, paths from the origin along x, and obstacles on them."""

    def sample(key: Key) -> Scenario:
        course_key = key
        if courses is not None:
            key, course_key = jax.random.split(key)
        # A key each: other conditions leave the path of an episode as it is.
        path_key, condition_key = jax.random.split(key)
        start = jnp.zeros(state_size).at[3].set(speed)
        envs = conditions(condition_key)
        path = paths(path_key)
        course = courses and courses(course_key, path)
        # The controller observes the truth; a measurement error replaces this field.
        return Scenario(start, envs, envs, path, jnp.asarray(speed), course)

    return sample


def smooth_path(
    key: Key,
    *,
    length: float,
    peak_curvature: float = 0.02,
    wavelengths: tuple[float, float] = (50.0, 160.0),
) -> Path:
    """Draw a path whose curvature is a sum of three sinusoids.

        κ(s) = Σᵢ aᵢ sin(2π s/λᵢ + φᵢ),   max |κ| = κ_max

    It is blended in over the first metres, so that an episode starts on the path.

    Args:
        key: consumed.
        length: smallest length [m].
        peak_curvature: κ_max [1/m].
        wavelengths: range of λᵢ [m].
    """
    amplitude_key, wavelength_key, phase_key = jax.random.split(key, 3)
    s = jnp.arange(int(length / SPACING) + 2) * SPACING
    # At least 0.3, or one sinusoid could be left alone.
    amplitudes = within((0.3, 1.0), amplitude_key, 3, 1)
    waves = within(wavelengths, wavelength_key, 3, 1)
    phases = jax.random.uniform(phase_key, (3, 1), maxval=2 * jnp.pi)
    curvature = jnp.sum(amplitudes * jnp.sin(2 * jnp.pi * s / waves + phases), axis=0)
    blend = jnp.clip(s / RUN_UP, 0.0, 1.0)
    # Smoothstep: the curvature and its slope start at 0, as does the steering.
    curvature = curvature * blend**2 * (3.0 - 2.0 * blend)
    # After the blend, so that the peak is reached on the path that is driven.
    curvature = curvature * peak_curvature / jnp.max(jnp.abs(curvature))
    return path_from_curvature(curvature, spacing=SPACING)
