"""Path following as a task, shared by the brax and gymnasium adapters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax import build
from sfkd_jax.geometry import between, wrap_angle
from sfkd_jax.plants import Vehicle
from sfkd_jax.ranges import AtLeastOne, NonNegative, Positive, check_intervals
from sfkd_jax.scenarios import Family, Scenario, point_at, project, reference_window
from sfkd_jax.types import (
    BODY,
    POSE,
    Control,
    Environment,
    Key,
    Reference,
    Scalar,
    State,
)

MEASURES: tuple[str, ...] = ("lateral", "speed_error", "steering_rate")


class Moment(NamedTuple):
    """The state of an episode.

    Attributes:
        state: x.
        progress: arc length reached [m].
        lateral: signed distance from the path, left positive [m].
        control: applied last, 0 at the start.
        count: steps driven.
    """

    state: State
    progress: Scalar
    lateral: Scalar
    control: Control
    count: Int[Array, ""]


class Transition(NamedTuple):
    """What one step earned, and whether it was the last.

    Attributes:
        reward: −ℓ.
        left: whether the car left the lane, faces backwards, or its state is not
            finite.
        over: whether the road ended with the car on it.
        measures: by the names of `MEASURES`: |e_y| [m], |e_v| [m/s], |δ̇| [rad/s].
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

    An action lies in [-1, 1] and is clipped to it; u = u_low + (u_high − u_low)(a +
    1)/2.

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
        given, wanted = road.initial_state.shape, (len(self.plant.state_names),)
        if given != wanted:
            raise ValueError(
                f"the scenario starts in a state of shape {given}, "
                f"{self.plant.name!r} has {wanted}"
            )

    @cached_property
    def plant(self) -> Vehicle:
        """The simulated car."""
        if isinstance(self.vehicle, Vehicle):
            return self.vehicle
        return build.build_vehicle(
            {"name": self.vehicle, "inner_loop": self.inner_loop, "speed_gain": 1.0}
        )

    @cached_property
    def family(self) -> Family:
        """A key -> a road with its schedule of friction and wind."""
        if not isinstance(self.scenario, str):
            return self.scenario
        named = {"name": self.scenario}
        return build.build_scenario(named, self.plant, duration=self.duration)

    @property
    def action_size(self) -> int:
        """Entries of an action."""
        return len(self.plant.control_low)

    @property
    def observation_bounds(self) -> tuple[list[float], list[float]]:
        """Smallest and largest observation."""
        inf, body = math.inf, len(self.plant.state_names) - 3
        # Angles are wrapped and actions clipped; nothing else has a limit.
        errors, points = [inf, math.pi], [inf, inf, math.pi, inf] * self.preview
        high = [*errors, *[inf] * body, *[1.0] * self.action_size, inf, inf, *points]
        low = [-value for value in high]
        # Only friction is not symmetric about 0.
        low[-len(points) - 2] = 0.0
        return low, high

    @property
    def observation_size(self) -> int:
        """Entries of an observation."""
        return len(self.observation_bounds[0])

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
        plant, applied = self.plant, self.control(action)
        after = plant.step(moment.state, applied, _at(road.envs, moment))
        # The guess moves on with the car, so a path that crosses itself is no trap.
        guess = moment.progress + after[3] * plant.dt
        progress, offset = project(road.path, after[:2], guess)
        reached = Moment(after, progress, offset, applied, moment.count + 1)
        parts = [after, applied, jnp.stack([progress, offset])]
        sound = jnp.all(jnp.isfinite(jnp.concatenate(parts)))
        # A state that is not finite ends the episode; what is observed is the last one.
        kept: Moment = jax.tree.map(
            lambda new, old: jnp.where(sound, new, old), reached, moment
        )
        # Facing backwards is leaving too: the other errors would not show it.
        backwards = jnp.abs(_heading(road, kept)) > 0.5 * jnp.pi
        left = ~sound | (jnp.abs(kept.lateral) > self.lane) | backwards
        # Time or road, whichever ends first.
        over = kept.progress >= road.path.length
        ended = (kept.count >= road.envs.shape[0]) | over
        missed = kept.state[3] - road.speed
        turned = (kept.control[0] - moment.control[0]) / plant.dt
        cost = (
            self.lateral * kept.lateral**2
            + self.speed * missed**2
            + self.steering_rate * turned**2
        )
        values = map(jnp.abs, (kept.lateral, missed, turned))
        measures = dict(zip(MEASURES, values, strict=True))
        reward = -cost - self.leaving * left
        # Leaving at the last step is a failure, no end in time.
        return kept, Transition(reward, left, ~left & ended, measures)

    def situation(
        self, road: Scenario, moment: Moment
    ) -> tuple[State, Environment, Reference]:
        """Return state, environment and reference, what `Controller.act` takes."""
        reference = reference_window(
            road.path,
            moment.progress,
            road.speed,
            dt=self.plant.dt,
            horizon=self.preview,
        )
        return moment.state, _at(road.observed_envs, moment), reference

    def observe(self, road: Scenario, moment: Moment) -> Float[Array, " observation"]:
        """Return the observation, in the order that the class lists."""
        state, env, reference = self.situation(road, moment)
        # In the frame of the car: a policy need not know where it is in the world.
        ahead = jax.vmap(between, in_axes=(None, 0))(state[POSE], reference[:, :3])
        points = jnp.concatenate([ahead, reference[:, 3:]], axis=1).ravel()
        errors = jnp.stack([moment.lateral, _heading(road, moment)])
        action = self.action(moment.control)
        return jnp.concatenate([errors, state[BODY], action, env, points])


def _at(envs: Float[Array, "time environment"], moment: Moment) -> Environment:
    """e_k, the last one beyond the end of the schedule."""
    return envs[jnp.minimum(moment.count, envs.shape[0] - 1)]


def _heading(road: Scenario, moment: Moment) -> Scalar:
    """Yaw relative to the path [rad]."""
    return wrap_angle(moment.state[2] - point_at(road.path, moment.progress)[2])
