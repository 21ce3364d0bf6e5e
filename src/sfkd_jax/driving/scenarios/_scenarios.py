"""Families of scenarios: start, environment, path and obstacles of random episodes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.lanes import Lane, Obstacles, circles, clearance, lane_along
from sfkd_jax.driving.paths import SPACING, Path, path_from_curvature, point_at
from sfkd_jax.driving.scenarios._conditions import (
    BOX,
    Schedule,
    in_box,
    switching_road,
    uniform_road,
    wet_road,
)
from sfkd_jax.ranges import Positive, Span
from sfkd_jax.schedules import within
from sfkd_jax.types import Key, Scalar, State

RUN_UP = 20.0
"""Length over which the curvature of a path is blended in; of a car [m]."""
FIRST = 70.0
"""Smallest arc length of the first obstacle [m]; of a car. It is out of sight at the
start.
"""
GAP = (40.0, 60.0)
"""Range of the distance from one obstacle to the next; of a car [m]."""
PASSED = 15.0
"""Distance behind the car from which on an obstacle counts as passed; of a car [m]."""
IN_SIGHT = 60.0
"""Distance from which on it is seen; of a car [m]."""
RADIUS = 0.8
"""Of an obstacle; of a car [m]."""
ASIDE = 1.5
"""Largest distance of an obstacle from the path; of a car [m]."""
ROOM = 10.5
"""Width of a lane with obstacles, three times the usual one; of a car [m]."""
FREE = 50.0
"""Length of the end of the path without obstacles; of a car [m]."""
IN_VIEW = 4
"""Number of obstacles that a controller is shown: those that are passed next."""


class Course(NamedTuple):
    """A lane with obstacles, each of which is seen from a distance on.

    Attributes:
        lane: with its path.
        obstacles: all of them, in the order in which they are passed.
        along: arc length of the path beside each obstacle [m], rising, (obstacle,).
        view: distance along the path from which on each is seen [m], (obstacle,).
        passed: distance behind the car from which on one counts as passed [m].
    """

    lane: Lane
    obstacles: Obstacles
    along: Float[Array, " obstacle"]
    view: Float[Array, " obstacle"]
    passed: Scalar


def random_course(
    key: Key, path: Path, *, speed: float = 10.0, scale: float = 1.0
) -> Course:
    """Draw round obstacles beside a path, which come into sight one after the other.

    The lane is so wide that the car may pass each obstacle on either side.

    Args:
        key: consumed.
        path: open. Its end stays free.
        speed: wanted speed on the lane [m/s].
        scale: of the lengths of the vehicle, see `sizes.length_scale`.
    """
    gap_key, offset_key = jax.random.split(key)
    length = (path.points.shape[0] - 1) * SPACING
    first = scale * FIRST
    gap = (scale * GAP[0], scale * GAP[1])
    aside = (-scale * ASIDE, scale * ASIDE)
    # Enough even if all gaps are the shortest, and no fewer than are shown at once.
    count = max(int((length - first) / gap[0]), IN_VIEW)
    along = first - gap[0] + jnp.cumsum(within(gap, gap_key, count))
    places = beside(path, along, within(aside, offset_key, count))
    obstacles = circles(places, scale * RADIUS)
    return Course(
        lane=lane_along(path, width=scale * ROOM, speed=speed),
        obstacles=obstacles._replace(present=along <= path.length - scale * FREE),
        along=along,
        view=jnp.full(count, scale * IN_SIGHT),
        passed=jnp.asarray(scale * PASSED),
    )


def beside(
    path: Path, along: Float[Array, " place"], aside: Float[Array, " place"]
) -> Float[Array, "place 2"]:
    """Return the positions beside a path [m].

    Args:
        path: that they are beside.
        along: arc lengths [m].
        aside: distances to the left of the path [m].
    """
    points = jax.vmap(point_at, in_axes=(None, 0))(path, along)
    normals = jnp.stack([-jnp.sin(points[:, 2]), jnp.cos(points[:, 2])], axis=1)
    return points[:, :2] + aside[:, None] * normals


def in_view(course: Course, progress: Scalar) -> Obstacles:
    """Return the next `IN_VIEW` obstacles; those that are out of sight are not present.

    Args:
        course: with at least as many obstacles, present or not.
        progress: arc length of the car [m].
    """
    ahead = course.along - progress
    first = jnp.clip(
        jnp.sum(ahead < -course.passed), 0, course.along.shape[0] - IN_VIEW
    )
    present = course.obstacles.present & (ahead <= course.view)
    obstacles = course.obstacles._replace(present=present)
    # The window has a constant size, so that a controller is compiled once for all
    # courses.
    window = partial(
        jax.lax.dynamic_slice_in_dim, start_index=first, slice_size=IN_VIEW
    )
    return jax.tree.map(window, obstacles)


def car_clearance(
    obstacles: Obstacles, state: State, *, size: tuple[float, float]
) -> Scalar:
    """Return how far a car is from the nearest obstacle now [m].

    Args:
        obstacles: as they are now.
        state: of the car.
        size: length and width of the car [m].
    """
    direction = jnp.stack([jnp.cos(state[2]), jnp.sin(state[2])])
    half = (0.5 * size[0], 0.5 * size[1])
    return jnp.min(clearance(obstacles, state[:2], direction=direction, half=half))


class Scenario(NamedTuple):
    """The task of one episode: start, environment, path and speed.

    Attributes:
        initial_state: x_0.
        envs: e_0 … e_{T-1} that the plant is in, (time, environment).
        observed_envs: e_0 … e_{T-1} as the controller observes them, (time,
            environment).
        path: to follow.
        speed: to hold [m/s].
        course: obstacles on the path, or None. With obstacles the car has to stay in
            the lane of the course, without it has to follow the path.
    """

    initial_state: State
    envs: Float[Array, "time environment"]
    observed_envs: Float[Array, "time environment"]
    path: Path
    speed: Scalar
    course: Course | None = None


Family: TypeAlias = Callable[[Key], Scenario]
"""A family of scenarios: every key gives another scenario."""


def _dry_road(key: Key, *, steps: int, dt: float) -> Schedule:
    """S1, whose environment is constant; dt is not needed."""
    del dt
    return uniform_road(key, steps=steps)


ROADS: dict[str, Callable[..., Schedule]] = {
    "s1": _dry_road,
    "s2": wet_road,
    "s3": switching_road,
    "obstacles": switching_road,
}
"""Schedules of the environment by the name of the scenario. Each is called with (key,
steps=number of time steps, dt=sampling period [s]) and returns e_0 … e_{T-1}.
"""
COURSES: dict[str, Callable[..., Course]] = {"obstacles": random_course}
"""Obstacles by the name of the scenario, for those scenarios that have any. Each is
called with (key, path, speed=v [m/s], scale=of the vehicle) and returns a course on the
path.
"""


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
    scale: float = 1.0,
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
        scale: of the lengths of the vehicle, and so of run-up and obstacles.

    Raises:
        ValueError: no scenario has this name.
    """
    if name not in ROADS:
        raise ValueError(f"unknown scenario {name!r}; choose one of {', '.join(ROADS)}")
    schedule = ROADS[name]
    # `round`, because duration / dt may fall just below the whole number of steps.
    steps = round(duration / dt)
    paths = partial(
        smooth_path,
        # Longer than the distance by a tenth and a horizon, so that no plan meets the
        # end of the path.
        length=speed * duration * 1.1 + 50.0,
        peak_curvature=peak_curvature,
        wavelengths=wavelengths,
        run_up=scale * RUN_UP,
    )
    courses = None
    if name in COURSES:
        courses = partial(COURSES[name], speed=speed, scale=scale)

    def conditions(key: Key) -> Float[Array, "time environment"]:
        return in_box(schedule(key, steps=steps, dt=dt), env_low, env_high)

    return family(conditions, paths, courses, speed=speed, state_size=state_size)


def family(
    conditions: Callable[[Key], Float[Array, "time environment"]],
    paths: Callable[[Key], Path],
    courses: Callable[[Key, Path], Course] | None = None,
    *,
    speed: float,
    state_size: int,
) -> Family:
    """Return the family that combines conditions, paths and obstacles on them.

    Args:
        conditions: key -> e_0 … e_{T-1}.
        paths: key -> path that starts at the origin along x.
        courses: (key, path) -> obstacles on the path; None for none.
        speed: to hold [m/s].
        state_size: of the vehicle.
    """

    def sample(key: Key) -> Scenario:
        course_key = key
        if courses is not None:
            key, course_key = jax.random.split(key)
        # Path and conditions have separate keys: in other conditions an episode still
        # has the same path.
        path_key, condition_key = jax.random.split(key)
        envs = conditions(condition_key)
        path = paths(path_key)
        return Scenario(
            initial_state=jnp.zeros(state_size).at[3].set(speed),
            envs=envs,
            # The controller observes the truth. Evaluation replaces this field where
            # its measurements are to have errors.
            observed_envs=envs,
            path=path,
            speed=jnp.asarray(speed),
            course=None if courses is None else courses(course_key, path),
        )

    return sample


def smooth_path(
    key: Key,
    *,
    length: float,
    peak_curvature: float = 0.02,
    wavelengths: tuple[float, float] = (50.0, 160.0),
    run_up: float = RUN_UP,
) -> Path:
    """Draw a path whose curvature is a sum of three sinusoids.

        κ(s) = Σᵢ aᵢ sin(2π s/λᵢ + φᵢ),   max |κ| = κ_max

    It is blended in over the first metres, so that an episode can start straight ahead.

    Args:
        key: consumed.
        length: smallest length [m].
        peak_curvature: κ_max [1/m].
        wavelengths: range of λᵢ [m].
        run_up: length over which the curvature is blended in [m].
    """
    amplitude_key, wavelength_key, phase_key = jax.random.split(key, 3)
    s = jnp.arange(int(length / SPACING) + 2) * SPACING
    # At least 0.3, so that no sinusoid vanishes.
    amplitudes = within((0.3, 1.0), amplitude_key, 3, 1)
    waves = within(wavelengths, wavelength_key, 3, 1)
    phases = jax.random.uniform(phase_key, (3, 1), maxval=2 * jnp.pi)
    curvature = jnp.sum(amplitudes * jnp.sin(2 * jnp.pi * s / waves + phases), axis=0)
    blend = jnp.clip(s / run_up, 0.0, 1.0)
    # Smoothstep: the curvature and its slope start at 0, as the steering does.
    curvature = curvature * blend**2 * (3.0 - 2.0 * blend)
    # Scaled after the blend, so that the path itself reaches the peak.
    curvature = curvature * peak_curvature / jnp.max(jnp.abs(curvature))
    return path_from_curvature(curvature, spacing=SPACING)
