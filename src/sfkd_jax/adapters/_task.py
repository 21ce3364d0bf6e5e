"""Path following and driving in a lane as tasks, for brax and gymnasium."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax import assembly
from sfkd_jax.driving.paths import point_at, project, reference_window
from sfkd_jax.driving.plants import Vehicle
from sfkd_jax.driving.scenarios import Course, Family, Scenario, car_clearance, in_view
from sfkd_jax.geometry import between, wrap_angle
from sfkd_jax.ranges import AtLeastOne, NonNegative, Positive, check_intervals
from sfkd_jax.types import BODY, POSE, Control, Environment, Key, Scalar, State

MEASURES: tuple[str, ...] = ("lateral", "speed_error", "steering_rate")
"""Names of what a step measures: |e_y| [m], |e_v| [m/s] and |δ̇| [rad/s]."""


class Moment(NamedTuple):
    """The state of an episode.

    Attributes:
        state: state x of the car.
        progress: arc length that the car has reached [m].
        lateral: signed distance from the path, left positive [m].
        control: the control that was applied last, 0 at the start.
        count: number of steps driven.
    """

    state: State
    progress: Scalar
    lateral: Scalar
    control: Control
    count: Int[Array, ""]


class Transition(NamedTuple):
    """The reward of a step, and whether it was the last.

    Attributes:
        reward: −ℓ.
        left: whether the car left the lane, faces backwards, or its state is not
            finite.
        over: whether the road ended with the car on it.
        measures: measures of the step by name, see `MEASURES`.
    """

    reward: Scalar
    left: Bool[Array, ""]
    over: Bool[Array, ""]
    measures: dict[str, Scalar]


@dataclass(frozen=True, kw_only=True, eq=False)
class DrivingTask:
    """ℓ = q_y e_y² + q_v e_v² + q_δ̇ (Δδ / dt)², plus the cost of leaving, once.

    Pure functions for one car; callers vmap. Every `reset` draws a new road, friction
    and wind. The observation is, in this order, n = state size:

        e_y [m], e_ψ [rad]        distance left of the path, yaw relative to it        2
        s                         body state, e.g. v [m/s]                         n − 3
        a                         last action, in [-1, 1]                              2
        e                         observed friction [-] and side wind [m/s]            2
        (x, y, ψ, v) × preview    the next points of the path in the car's
                                  frame, one per sampling period at the speed
                                  to hold                                    4 · preview

    An action is clipped to [-1, 1]; u = u_low + (u_high − u_low)(a + 1)/2.

    Attributes:
        vehicle: "kinematic", "dynamic", or a plant.
        scenario: "s1", "s2", "s3", …, or a family for this plant.
        inner_loop: "none" or "speed", for a vehicle given by name.
        duration: of a road [s].
        preview: number of points ahead.
        lane: half width; farther from the path the car has left it [m].
        lateral: q_y [1/m²], as the planner has it.
        speed: q_v [s²/m²].
        steering_rate: q_δ̇ [s²/rad²].
        leaving: charged once [-]; standing still costs half of it at 10 m/s and a
            discount of 0.99.
    """

    vehicle: str | Vehicle = "kinematic"
    scenario: str | Family = "s1"
    inner_loop: str = "none"
    duration: Positive = 60.0
    preview: AtLeastOne = 10
    lane: Positive = 3.0
    lateral: NonNegative = 200.0
    speed: NonNegative = 1.0
    steering_rate: NonNegative = 5.0
    leaving: NonNegative = 2e4

    def __post_init__(self) -> None:
        """Check the settings, and that scenario and plant fit."""
        check_intervals(self)
        if not self.duration >= self.plant.dt:
            raise ValueError(f"duration must be at least a step, got {self.duration}")
        road = jax.eval_shape(self.family, jax.random.key(0))
        shape = road.initial_state.shape
        if self.plant.hidden:
            raise ValueError(
                f"vehicle {self.plant.name} has hidden states, which this environment "
                "does not keep"
            )
        plant_shape = (len(self.plant.state_names),)
        if shape != plant_shape:
            raise ValueError(
                f"the scenario starts in a state of shape {shape}, "
                f"{self.plant.name!r} has {plant_shape}"
            )

    @cached_property
    def plant(self) -> Vehicle:
        """The simulated car."""
        if isinstance(self.vehicle, Vehicle):
            return self.vehicle
        return assembly.build_vehicle(
            {"name": self.vehicle, "inner_loop": self.inner_loop, "speed_gain": 1.0}
        )

    @cached_property
    def family(self) -> Family:
        """A key -> a road with its schedule of friction and wind."""
        if not isinstance(self.scenario, str):
            return self.scenario
        options: dict[str, Any] = {"name": self.scenario}
        if self.scenario == "obstacles":
            options["peak_curvature"] = 0.004
            options["wavelengths"] = (100.0, 300.0)
        return assembly.build_scenario(options, self.plant, duration=self.duration)

    @property
    def action_size(self) -> int:
        """Entries of an action."""
        return len(self.plant.control_low)

    @property
    def observation_bounds(self) -> tuple[Any, Any]:
        """Smallest and largest observation."""
        inf = math.inf
        # Angles are wrapped and actions clipped; nothing else has a limit.
        errors = [inf, math.pi]
        body = [inf] * (len(self.plant.state_names) - 3)
        action = [1.0] * self.action_size
        env = [inf, inf]
        points = [inf, inf, math.pi, inf] * self.preview
        high = [*errors, *body, *action, *env, *points]
        low = [-value for value in high]
        # Only friction is not symmetric about 0.
        low[-len(points) - 2] = 0.0
        return np.asarray(low, np.float32), np.asarray(high, np.float32)

    @property
    def observation_size(self) -> int:
        """Entries of an observation."""
        return self.observation_bounds[0].size

    def control(self, action: Control) -> Control:
        """Return an action in [-1, 1] in physical units, clipped to the limits."""
        low, high = map(jnp.asarray, (self.plant.control_low, self.plant.control_high))
        # A single number would be broadcast to steering and drive.
        if action.shape != low.shape:
            raise ValueError(f"action must have shape {low.shape}, got {action.shape}")
        return low + (high - low) * 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0)

    def action(self, control: Control) -> Control:
        """Return a control in physical units as an action in [-1, 1]."""
        low, high = map(jnp.asarray, (self.plant.control_low, self.plant.control_high))
        return 2.0 * (control - low) / (high - low) - 1.0

    def reset(self, key: Key) -> tuple[Scenario, Moment]:
        """Draw a new road, with the car at its start."""
        road = self.family(key)
        progress, offset = project(road.path, road.initial_state[:2], jnp.zeros(()))
        # As if the last control had been 0: the first steering rate counts from it.
        still = jnp.zeros(self.action_size)
        count = jnp.zeros((), dtype=jnp.int32)
        return road, Moment(road.initial_state, progress, offset, still, count)

    def step(
        self, road: Scenario, moment: Moment, action: Control
    ) -> tuple[Moment, Transition]:
        """Simulate one sampling period with an action in [-1, 1]."""
        plant = self.plant
        applied = self.control(action)
        after = plant.step(moment.state, applied, _at(road.envs, moment))
        # The guess moves on with the car, so a path that crosses itself is no trap.
        guess = moment.progress + after[3] * plant.dt
        progress, offset = project(road.path, after[:2], guess)
        reached = Moment(after, progress, offset, applied, moment.count + 1)
        parts = [after, applied, jnp.stack([progress, offset])]
        finite = jnp.all(jnp.isfinite(jnp.concatenate(parts)))
        # A state that is not finite ends the episode; what is observed is the last one.
        kept: Moment = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old), reached, moment
        )
        # Facing backwards is leaving too: the other errors would not show it.
        backwards = jnp.abs(_heading(road, kept)) > 0.5 * jnp.pi
        left = ~finite | self._outside(road, kept) | backwards
        # Time or road, whichever ends first.
        road_ended = kept.progress >= road.path.length
        ended = (kept.count >= road.envs.shape[0]) | road_ended
        speed_error = kept.state[3] - road.speed
        steering_rate = (kept.control[0] - moment.control[0]) / plant.dt
        cost = (
            self.lateral * kept.lateral**2
            + self.speed * speed_error**2
            + self.steering_rate * steering_rate**2
        )
        values = map(jnp.abs, (kept.lateral, speed_error, steering_rate))
        measures = dict(zip(MEASURES, values, strict=True))
        reward = -cost - self.leaving * left
        # Leaving at the last step is a failure, no end in time.
        return kept, Transition(reward, left, ~left & ended, measures)

    def _outside(self, road: Scenario, moment: Moment) -> Bool[Array, ""]:
        """Return whether the car has left the lane."""
        return jnp.abs(moment.lateral) > self.lane

    def situation(self, road: Scenario, moment: Moment) -> tuple[State, Any, Any]:
        """Return state, environment and reference, what `Controller.act` takes."""
        reference = reference_window(
            road.path,
            moment.progress,
            road.speed,
            dt=self.plant.dt,
            horizon=self.preview,
        )
        return moment.state, _at(road.observed_envs, moment), reference

    def observe(self, road: Scenario, moment: Moment) -> Any:
        """Return the observation, in the order that the class lists."""
        state, env, reference = DrivingTask.situation(self, road, moment)
        # In the frame of the car: a policy need not know where it is in the world.
        ahead = jax.vmap(between, in_axes=(None, 0))(state[POSE], reference[:, :3])
        points = jnp.concatenate([ahead, reference[:, 3:]], axis=1).ravel()
        errors = jnp.stack([moment.lateral, _heading(road, moment)])
        action = self.action(moment.control)
        return jnp.concatenate([errors, state[BODY], action, env, points])


@dataclass(frozen=True, kw_only=True, eq=False)
class LaneTask(DrivingTask):
    """`DrivingTask` round obstacles that are seen late, in the middle of a lane.

    The observation is a dict of arrays; x, y, ψ are in the frame of the car:

        observation  e_y off the middle, e_ψ, s, a as of `DrivingTask`       n + 1
        environment  observed friction [-] and side wind [m/s]                   2
        lane         next points: x, y, ψ, v, to left and right edge   preview × 6
        obstacles    in view: x, y, ψ, half of length and width, radius,
                     1; rows of 0 are none                             in view × 7

    The car has left the lane when it touches an edge or an obstacle.

    Attributes:
        scenario: "obstacles", or a family with courses.
        preview: number of points ahead.
        lateral: q_y [1/m²]: whoever passes an obstacle is off the middle.
    """

    scenario: str | Family = "obstacles"
    preview: AtLeastOne = 60
    lateral: NonNegative = 0.02

    @property
    def observation_bounds(self) -> tuple[Any, Any]:
        """Smallest and largest observation; there are none."""
        seen = jax.eval_shape(
            self.observe, *jax.eval_shape(self.reset, jax.random.key(0))
        )
        high = {name: np.full(x.shape, np.inf, np.float32) for name, x in seen.items()}
        return {name: -rows for name, rows in high.items()}, high

    def _outside(self, road: Scenario, moment: Moment) -> Bool[Array, ""]:
        """Return whether the car touches an edge of the lane or an obstacle."""
        course = _course(road)
        size = self.plant.size
        side = moment.lateral * jnp.asarray([1.0, -1.0]) + 0.5 * size.width
        room = jnp.min(_edges(course, moment.progress) - side)
        gap = car_clearance(course.obstacles, moment.state, size=size)
        return (room < 0.0) | (gap < 0.0)

    def situation(self, road: Scenario, moment: Moment) -> tuple[State, Any, Any]:
        """Return state, environment and scene, what a controller in a lane takes."""
        state, env, _ = super().situation(road, moment)
        course = _course(road)
        return state, env, (course.lane, in_view(course, moment.progress))

    def observe(self, road: Scenario, moment: Moment) -> Any:
        """Return the observation, as the class describes it."""
        state, env, (_, near) = self.situation(road, moment)
        flat = super().observe(road, moment)
        num_points = 4 * self.preview
        poses = jnp.concatenate([near.position[:, 0], near.yaw[:, None]], axis=1)
        poses = jax.vmap(between, in_axes=(None, 0))(state[POSE], poses)
        columns = [poses, near.half, near.radius[:, None], near.present[:, None]]
        rows = jnp.concatenate(columns, axis=1)
        # Where the next points of the path are: one sampling period apart.
        ahead = road.speed * self.plant.dt * jnp.arange(1, self.preview + 1)
        edges = _edges(_course(road), moment.progress + ahead)
        points = flat[-num_points:].reshape(-1, 4)
        return {
            "observation": flat[: -num_points - len(env)],
            "environment": env,
            "lane": jnp.concatenate([points, edges], axis=1),
            "obstacles": jnp.where(near.present[:, None], rows, 0.0),
        }


def _course(road: Scenario) -> Course:
    """Return the obstacles of a road."""
    if road.course is None:
        raise ValueError("a lane needs a scenario with obstacles, this one has none")
    return road.course


def _edges(course: Course, s: Float[Array, "*shape"]) -> Array:
    """Return the distances from the middle to the edges at arc lengths s [m], (…, 2).

    The left edge comes first.
    """
    lane = course.lane
    at = lane.path.spacing * jnp.arange(lane.left.shape[0])
    left = jnp.interp(s, at, lane.left)
    right = jnp.interp(s, at, lane.right)
    return jnp.stack([left, right], axis=-1)


def _at(envs: Float[Array, "time environment"], moment: Moment) -> Environment:
    """Return e at a step; beyond the end of the schedule it is the last one."""
    return envs[jnp.minimum(moment.count, envs.shape[0] - 1)]


def _heading(road: Scenario, moment: Moment) -> Scalar:
    """Return the yaw relative to the path [rad]."""
    return wrap_angle(moment.state[2] - point_at(road.path, moment.progress)[2])
