"""Following a path as a task: what the brax and the gymnasium environment have in common, as pure functions."""

from __future__ import annotations

from collections.abc import Callable
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
)
from sfkd_jax.core.se2 import between, wrap_angle
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
from sfkd_jax.vehicle import Vehicle

MEASURES = ("lateral", "speed_error", "steering_rate")


class Moment(NamedTuple):
    """Where an episode stands.

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
    """What one step was worth.

    Attributes:
        reward: −ℓ.
        left: whether the car left the lane (or faces backwards, or its state is not
            finite).
        over: whether the road ended with the car on it.
        measures: by the names of `MEASURES`: |e_y| [m], |e_v| [m/s], |δ̇| [rad/s].
    """

    reward: Scalar
    left: Bool[Array, ""]
    over: Bool[Array, ""]
    measures: dict[str, Scalar]


class DrivingTask(NamedTuple):
    """Following a path, for one car; callers vmap.

    Attributes:
        plant: whose step is taken.
        steps: of an episode, at most.
        observation_size, action_size: of the vectors.
        reset: key -> (road, moment).
        step: (road, moment, action) -> (moment, outcome).
        observe: (road, moment) -> what a learner sees.
        situation: (road, moment) -> (state, environment, reference), what
            `Controller.act` takes.
        control: action in [-1, 1] -> control in physical units.
        action: its inverse.
    """

    plant: Vehicle
    steps: int
    observation_size: int
    action_size: int
    reset: Callable[[Key], tuple[Scenario, Moment]]
    step: Callable[[Scenario, Moment, Control], tuple[Moment, Outcome]]
    observe: Callable[[Scenario, Moment], Float[Array, " observation"]]
    situation: Callable[[Scenario, Moment], tuple[State, Environment, Reference]]
    control: Callable[[Control], Control]
    action: Callable[[Control], Control]


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
    """ℓ = q_y e_y² + q_v e_v² + q_δ̇ (Δδ / dt)², and once the cost of leaving.

    Road, friction and wind are drawn anew by every `reset`. The observation is, in this
    order, n = state size:

        e_y [m], e_ψ [rad]          distance left of the path, yaw against it              2
        s                           body state, e.g. v [m/s]                               n − 3
        a                           last action, in [-1, 1]                                2
        e                           friction [-], side wind [m/s], measured without error  2
        (x, y, ψ, v) × preview      the next points of the path in the car's frame, a row
                                    per sampling period at the speed to hold               4 · preview

    An action lies in [-1, 1] and is clipped to it; u = u_low + (u_high − u_low)(a +
    1)/2.

    Args:
        vehicle: "kinematic", "dynamic", or a plant.
        scenario: "s1", "s2", "s3", …, or a family for this plant.
        inner_loop: "none" or "speed", for a vehicle given by name.
        duration: of a road [s].
        preview: points ahead that are seen.
        lane: half width; further from the path the car has left it [m].
        lateral, speed, steering_rate: q_y [1/m²], q_v [s²/m²], q_δ̇ [s²/rad²], as the
            planner has them.
        leaving: charged once [-]; standing still costs half of it at 10 m/s and a
            discount of 0.99.

    Raises:
        ValueError: an unknown name, or a size, width, duration or weight that is not
            positive (0 is a weight too).
    """
    check_weights(
        lateral=lateral, speed=speed, steering_rate=steering_rate, leaving=leaving
    )
    plant = choose_plant(vehicle, inner_loop)
    check_sizes(plant.dt, duration=duration, preview=preview, lane=lane)
    family = choose_family(scenario, plant, duration)
    steps = count_steps(family, plant)
    low, high = jnp.asarray(plant.control_low), jnp.asarray(plant.control_high)

    def control(action: Control) -> Control:
        return low + (high - low) * 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0)

    def action(control: Control) -> Control:
        return 2.0 * (control - low) / (high - low) - 1.0

    def reset(key: Key) -> tuple[Scenario, Moment]:
        road = family(key)
        progress, offset = project(road.path, road.initial_state[:2], jnp.zeros(()))
        still = jnp.zeros(len(plant.control_low))
        return road, Moment(
            road.initial_state, progress, offset, still, jnp.zeros((), dtype=jnp.int32)
        )

    def step(road: Scenario, moment: Moment, action: Control) -> tuple[Moment, Outcome]:
        applied = control(action)
        after = plant.step(moment.state, applied, _now(road, moment))
        progress, offset = project(
            road.path, after[:2], moment.progress + after[3] * plant.dt
        )
        reached = Moment(after, progress, offset, applied, moment.count + 1)
        sound = jnp.all(
            jnp.isfinite(
                jnp.concatenate([after, applied, jnp.stack([progress, offset])])
            )
        )
        kept: Moment = jax.tree.map(
            lambda new, old: jnp.where(sound, new, old), reached, moment
        )
        backwards = jnp.abs(_heading(road, kept)) > 0.5 * jnp.pi
        left = ~sound | (jnp.abs(kept.lateral) > lane) | backwards
        over = ~left & (
            (kept.count >= road.envs.shape[0]) | (kept.progress >= _length(road))
        )
        missed, turned = (
            kept.state[3] - road.speed,
            (kept.control[0] - moment.control[0]) / plant.dt,
        )
        cost = lateral * kept.lateral**2 + speed * missed**2 + steering_rate * turned**2
        values = (kept.lateral, missed, turned)
        measures = {
            name: jnp.abs(value) for name, value in zip(MEASURES, values, strict=True)
        }
        return kept, Outcome(-cost - leaving * left, left, over, measures)

    def situation(
        road: Scenario, moment: Moment
    ) -> tuple[State, Environment, Reference]:
        reference = reference_window(
            road.path, moment.progress, road.speed, dt=plant.dt, horizon=preview
        )
        return moment.state, _now(road, moment), reference

    def observe(road: Scenario, moment: Moment) -> Float[Array, " observation"]:
        state, env, reference = situation(road, moment)
        ahead = jax.vmap(between, in_axes=(None, 0))(state[POSE], reference[:, :3])
        points = jnp.concatenate([ahead, reference[:, 3:]], axis=1).ravel()
        errors = jnp.stack([moment.lateral, _heading(road, moment)])
        return jnp.concatenate(
            [errors, state[BODY], action(moment.control), env, points]
        )

    size = 2 + (len(plant.state_names) - 3) + len(plant.control_low) + 2 + 4 * preview
    return DrivingTask(
        plant,
        steps,
        size,
        len(plant.control_low),
        reset,
        step,
        observe,
        situation,
        control,
        action,
    )


def _now(road: Scenario, moment: Moment) -> Environment:
    """e_k, the last one beyond the end of the schedule."""
    return road.envs[jnp.minimum(moment.count, road.envs.shape[0] - 1)]


def _heading(road: Scenario, moment: Moment) -> Scalar:
    """Yaw against the path [rad]."""
    return wrap_angle(moment.state[2] - point_at(road.path, moment.progress)[2])


def _length(road: Scenario) -> Scalar:
    """Of the path [m]."""
    return (road.path.points.shape[0] - 1) * road.path.spacing
