"""Path following as a task, shared by the brax and gymnasium adapters."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.adapters._settings import (
    check_sizes,
    check_weights,
    choose_family,
    choose_plant,
    count_steps,
    observation_bounds,
)
from sfkd_jax.geometry import between, wrap_angle
from sfkd_jax.plants import Vehicle
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

MEASURES = ("lateral", "speed_error", "steering_rate")


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


class Outcome(NamedTuple):
    """The outcome of one step.

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


class DrivingTask(NamedTuple):
    """Path following for one car; callers vmap.

    Attributes:
        plant: that is simulated.
        steps: of an episode, at most.
        lane: half width [m].
        observation_low: smallest observation, −∞ where there is no limit.
        observation_high: largest observation, ∞ where there is no limit.
        action_size: entries of an action.
        reset: key -> (road, moment).
        step: (road, moment, action) -> (moment, outcome).
        observe: (road, moment) -> observation.
        situation: (road, moment) -> (state, environment, reference), what
            `Controller.act` takes.
        control: action in [-1, 1] -> control in physical units.
        action: its inverse.
    """

    plant: Vehicle
    steps: int
    lane: float
    observation_low: tuple[float, ...]
    observation_high: tuple[float, ...]
    action_size: int
    reset: Callable[[Key], tuple[Scenario, Moment]]
    step: Callable[[Scenario, Moment, Control], tuple[Moment, Outcome]]
    observe: Callable[[Scenario, Moment], Float[Array, " observation"]]
    situation: Callable[[Scenario, Moment], tuple[State, Environment, Reference]]
    control: Callable[[Control], Control]
    action: Callable[[Control], Control]

    @property
    def observation_size(self) -> int:
        """Entries of an observation."""
        return len(self.observation_low)


class _Task(NamedTuple):
    """The settings of `tracking_task`."""

    plant: Vehicle
    family: Family
    preview: int
    lane: float
    lateral: float
    speed: float
    steering_rate: float
    leaving: float


def tracking_task(
    *,
    vehicle: str | Vehicle = "kinematic",
    scenario: str | Family = "s1",
    inner_loop: str = "none",
    duration: float = 60.0,
    preview: int = 10,
    lane: float = 3.0,
    lateral: float = 200.0,
    speed: float = 1.0,
    steering_rate: float = 5.0,
    leaving: float = 2e4,
) -> DrivingTask:
    """ℓ = q_y e_y² + q_v e_v² + q_δ̇ (Δδ / dt)², plus the cost of leaving, once.

    Every `reset` draws a new road, friction and wind. The observation is, in this
    order, n = state size:

        e_y [m], e_ψ [rad]        distance left of the path, yaw relative to it        2
        s                         body state, e.g. v [m/s]                         n − 3
        a                         last action, in [-1, 1]                              2
        e                         observed friction [-] and side wind [m/s]            2
        (x, y, ψ, v) × preview    the next points of the path in the car's
                                  frame, one per sampling period at the speed
                                  to hold                                    4 · preview

    An action lies in [-1, 1] and is clipped to it; u = u_low + (u_high − u_low)(a +
    1)/2.

    Args:
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

    Raises:
        ValueError: an unknown name, a size, width or duration that is not positive, or
            a negative weight.
    """
    check_weights(
        lateral=lateral, speed=speed, steering_rate=steering_rate, leaving=leaving
    )
    plant = choose_plant(vehicle, inner_loop)
    check_sizes(plant.dt, duration=duration, preview=preview, lane=lane)
    family = choose_family(scenario, plant, duration)
    task = _Task(plant, family, preview, lane, lateral, speed, steering_rate, leaving)
    low, high = observation_bounds(plant, preview)
    return DrivingTask(
        plant=plant,
        steps=count_steps(family, plant),
        lane=lane,
        observation_low=low,
        observation_high=high,
        action_size=len(plant.control_low),
        reset=partial(_reset, task),
        step=partial(_step, task),
        observe=partial(_observe, task),
        situation=partial(_situation, task),
        control=partial(_control, plant),
        action=partial(_action, plant),
    )


def _control(plant: Vehicle, action: Control) -> Control:
    """An action in physical units, clipped to the limits."""
    low, high = jnp.asarray(plant.control_low), jnp.asarray(plant.control_high)
    return low + (high - low) * 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0)


def _action(plant: Vehicle, control: Control) -> Control:
    """A control as an action in [-1, 1]."""
    low, high = jnp.asarray(plant.control_low), jnp.asarray(plant.control_high)
    return 2.0 * (control - low) / (high - low) - 1.0


def _reset(task: _Task, key: Key) -> tuple[Scenario, Moment]:
    """A new road, and the car at its start."""
    road = task.family(key)
    progress, offset = project(road.path, road.initial_state[:2], jnp.zeros(()))
    still = jnp.zeros(len(task.plant.control_low))
    return road, Moment(
        road.initial_state, progress, offset, still, jnp.zeros((), dtype=jnp.int32)
    )


def _step(
    task: _Task, road: Scenario, moment: Moment, action: Control
) -> tuple[Moment, Outcome]:
    """One sampling period; a state that is not finite is replaced by the last one."""
    plant = task.plant
    applied = _control(plant, action)
    after = plant.step(moment.state, applied, _at(road.envs, moment))
    progress, offset = project(
        road.path, after[:2], moment.progress + after[3] * plant.dt
    )
    reached = Moment(after, progress, offset, applied, moment.count + 1)
    sound = jnp.all(
        jnp.isfinite(jnp.concatenate([after, applied, jnp.stack([progress, offset])]))
    )
    kept: Moment = jax.tree.map(
        lambda new, old: jnp.where(sound, new, old), reached, moment
    )
    return kept, _outcome(task, road, moment, kept, sound)


def _outcome(
    task: _Task, road: Scenario, before: Moment, kept: Moment, sound: Bool[Array, ""]
) -> Outcome:
    """Reward, end and measures of a step."""
    backwards = jnp.abs(_heading(road, kept)) > 0.5 * jnp.pi
    left = ~sound | (jnp.abs(kept.lateral) > task.lane) | backwards
    over = ~left & (
        (kept.count >= road.envs.shape[0]) | (kept.progress >= _length(road))
    )
    missed, turned = (
        kept.state[3] - road.speed,
        (kept.control[0] - before.control[0]) / task.plant.dt,
    )
    cost = (
        task.lateral * kept.lateral**2
        + task.speed * missed**2
        + task.steering_rate * turned**2
    )
    values = (kept.lateral, missed, turned)
    measures = {
        name: jnp.abs(value) for name, value in zip(MEASURES, values, strict=True)
    }
    return Outcome(-cost - task.leaving * left, left, over, measures)


def _situation(
    task: _Task, road: Scenario, moment: Moment
) -> tuple[State, Environment, Reference]:
    """What a controller is given."""
    reference = reference_window(
        road.path,
        moment.progress,
        road.speed,
        dt=task.plant.dt,
        horizon=task.preview,
    )
    return moment.state, _at(road.observed_envs, moment), reference


def _observe(
    task: _Task, road: Scenario, moment: Moment
) -> Float[Array, " observation"]:
    """The observation, as `tracking_task` describes it."""
    state, env, reference = _situation(task, road, moment)
    ahead = jax.vmap(between, in_axes=(None, 0))(state[POSE], reference[:, :3])
    points = jnp.concatenate([ahead, reference[:, 3:]], axis=1).ravel()
    errors = jnp.stack([moment.lateral, _heading(road, moment)])
    action = _action(task.plant, moment.control)
    return jnp.concatenate([errors, state[BODY], action, env, points])


def _at(envs: Float[Array, "time environment"], moment: Moment) -> Environment:
    """e_k, the last one beyond the end of the schedule."""
    return envs[jnp.minimum(moment.count, envs.shape[0] - 1)]


def _heading(road: Scenario, moment: Moment) -> Scalar:
    """Yaw relative to the path [rad]."""
    return wrap_angle(moment.state[2] - point_at(road.path, moment.progress)[2])


def _length(road: Scenario) -> Scalar:
    """Of the path [m]."""
    return (road.path.points.shape[0] - 1) * road.path.spacing
