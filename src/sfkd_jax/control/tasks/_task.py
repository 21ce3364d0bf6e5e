"""Planning problems: pure functions of a rollout step, with any cost or constraint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control._factory import factory
from sfkd_jax.geometry import entrywise
from sfkd_jax.lanes import outside_box
from sfkd_jax.types import Control, Params, Scalar

Limiter: TypeAlias = Callable[[Control, Control], Control]
"""(wanted control, control before) -> the nearest control that the actuators allow."""
Limit: TypeAlias = ArrayLike | Sequence[float]
"""One number for all controls, or one for each."""
Violations: TypeAlias = Float[Array, " constraint"]
"""How far each constraint is violated; negative where it is kept."""
Constraint: TypeAlias = Callable[[Any, Any, Control, Any, "StepIndex"], Violations]
"""(data, predicted state, control, target, step index) -> `Violations`."""


class PlanningStart(NamedTuple):
    """The control applied last, and whether there was one: False at the first step."""

    control: Control
    known: Bool[Array, ""]


class StepIndex(NamedTuple):
    """The number of a step: 0, 1, …; and 1 at the last one, 0 before it."""

    number: Int[Array, ""]
    last: Scalar


class RolloutSetup(NamedTuple):
    """Everything that a task evaluates once per control step, before the rollouts.

    Attributes:
        context: shared by all samples and steps.
        start: state of one rollout before its first step; a `Sample` if the task has a
            `cost`.
        targets: data of each step; every leaf has the horizon as its leading axis.
        followable: whether the plan is for the reference that was given; if not, the
            control is what the task does instead, and not healthy.
    """

    context: Any
    start: Any
    targets: Any
    followable: Bool[Array, ""] | bool = True


class Sample(NamedTuple):
    """State of one rollout.

    Attributes:
        latent: of the model; () where that is the state.
        state: predicted last.
        control: applied last.
    """

    latent: Any
    state: Any
    control: Control


class StepResult(NamedTuple):
    """One step of one rollout.

    Attributes:
        sample: state of the rollout after the step.
        control: applied in the step.
        perturbation: the part of the row of the plan that the limits allowed.
        state: predicted state after the step; reported, not carried.
        cost: of the step; None where `Task.cost` gives it.
    """

    sample: Any
    control: Control
    perturbation: Control
    state: Any
    cost: Scalar | None = None


class Task(NamedTuple):
    """A planning problem as pure functions of one sample; planners vmap them.

    A step takes one row of the plan. What a row means is up to the task: a control, a
    perturbation of a feedback law, or, with `horizon=1`, the parameters of a whole
    manoeuvre, which `step` evaluates at once and returns as `state`.

    Attributes:
        low: lower limits of a control.
        high: upper limits of a control.
        weights: of the cost, a pytree of numbers that planners carry in their state.
        prepare: (params, observation, env, reference, start) -> `RolloutSetup`.
        step: (weights, context, sample, row, target, step index) -> `StepResult`.
        check: (observation, env, reference, horizon) -> whether the positions are
            precise, or None where there are none; raises a ValueError that
            names an argument of the wrong shape.
        cost: (weights, sample before, sample after, target, step index) -> cost of a
            step, from samples without latents. Short states are charged for all steps
            at once, which is faster than in `step`; None if `step` gives it.
        constraint: see `constrained`; None for no constraint.
        constraint_data: that the constraint is given.
    """

    low: Control
    high: Control
    weights: Any
    prepare: Callable[[Params, Any, Any, Any, PlanningStart], RolloutSetup]
    step: Callable[[Any, Any, Any, Control, Any, StepIndex], StepResult]
    check: Callable[[Any, Any, Any, int], Bool[Array, ""] | None]
    cost: Callable[[Any, Sample, Sample, Any, StepIndex], Scalar] | None = None
    constraint: Constraint | None = None
    constraint_data: Any = ()


def actuator_limits(low: Limit, high: Limit, rate: Limit | None, dt: float) -> Limiter:
    """Return the projection of a control onto its box and its slew limits.

    Args:
        low: lower control limits.
        high: upper control limits.
        rate: largest change per second, or None for no slew limit.
        dt: sampling period [s].
    """
    if np.shape(low) != np.shape(high) or not np.all(np.less(low, high)):
        raise ValueError(
            "control_low must lie below control_high, entry by entry, "
            f"got {low} and {high}"
        )
    rate = np.inf if rate is None else rate
    if np.shape(rate) not in ((), np.shape(low)) or not np.all(np.greater(rate, 0)):
        raise ValueError(f"control_rate needs positive numbers, got {rate}")
    ends = low, high, dt * np.asarray(rate, float)
    bottom, top, most = (jnp.asarray(end, dtype=float) for end in ends)

    def entry(wanted: Scalar, before: Scalar, *ends: Scalar) -> Scalar:
        bottom, top, most = ends
        # An actuator outside its box returns to it at once, whatever its slew limit.
        before = jnp.clip(before, bottom, top)
        low = before - most
        high = before + most
        return jnp.clip(wanted, jnp.maximum(bottom, low), jnp.minimum(top, high))

    def limit(wanted: Control, before: Control) -> Control:
        ends = (jnp.broadcast_to(end, wanted.shape) for end in (bottom, top, most))
        return entrywise(entry, wanted, before, *ends)

    return limit


def constrained(task: Task, constraint: Constraint, data: Any = ()) -> Task:
    """Return a task whose plans must keep constraints at every step.

    A planner drops the samples that violate one, as long as any sample keeps all. If
    none does, it takes the samples with the smallest violations, whatever they cost. If
    the chosen mean of samples violates a constraint that single samples keep, the best
    of those replaces it.

    Args:
        task: any task.
        constraint: see `Constraint`; `outside_circles` and `outside_boxes` help.
        data: pytree of numbers that the constraint is given: positions of obstacles,
            margins. A planner carries it in `Tuning.constraints`, where it may change
            at every control step.
    """
    return task._replace(constraint=constraint, constraint_data=data)


def outside_circles(
    position: Float[Array, " 2"],
    circles: Float[Array, "circle 3"],
    margin: Scalar | float = 0.0,
) -> Float[Array, " circle"]:
    """Return how deep a point lies inside circles [m], negative outside.

    Args:
        position: x, y [m].
        circles: x, y, radius of each [m].
        margin: by which each is enlarged [m].
    """
    away = position - circles[:, :2]
    # Finite derivatives in the centre too.
    return circles[:, 2] + margin - jnp.sqrt(jnp.sum(away**2, axis=1) + 1e-12)


def outside_boxes(
    position: Float[Array, " 2"],
    boxes: Float[Array, "box 5"],
    margin: Scalar | float = 0.0,
) -> Float[Array, " box"]:
    """Return how deep a point lies inside rectangles [m], negative outside.

    Args:
        position: x, y [m].
        boxes: x, y of the centre, yaw [rad], length, width [m] of each.
        margin: by which each is enlarged, with round corners [m].
    """
    away = position - boxes[:, :2]
    cos = jnp.cos(boxes[:, 2])
    sin = jnp.sin(boxes[:, 2])
    along = cos * away[:, 0] + sin * away[:, 1]
    left = cos * away[:, 1] - sin * away[:, 0]
    return margin - outside_box(along, left, (0.5 * boxes[:, 3], 0.5 * boxes[:, 4]))


def at_step(values: Array, at: StepIndex) -> Array:
    """Return the entry of a step: of moving obstacles, or of a tube's radii.

    Args:
        values: (horizon, …).
        at: the step; beyond the last entry, that one.
    """
    return values[jnp.minimum(at.number, values.shape[0] - 1)]


@dataclass(frozen=True, eq=False)
class FreeTask:
    """The task of minimising any cost under any state equation.

        x⁺ = f(params, x, u, e),   J = Σ_k ℓ(weights, x_{k+1}, u_k, u_{k−1}, ref_k) + φ

    State, environment and reference may be arrays, any other pytrees, or None; every
    leaf of the reference has the horizon as its leading axis.

    Attributes:
        dynamics: f.
        stage: ℓ, evaluated at the state after the control.
        control_low: lower control limits.
        control_high: upper control limits.
        control_rate: largest change of a control per second, or None.
        dt: sampling period [s], which `control_rate` needs.
        terminal: φ(weights, x_T, ref_T).
        weights: a pytree of numbers that both costs read, see `Tuning.cost`.
    """

    dynamics: Callable[[Params, Any, Control, Any], Any]
    stage: Callable[[Any, Any, Control, Control, Any], Scalar]
    _: KW_ONLY
    control_low: Limit = -np.inf
    control_high: Limit = np.inf
    control_rate: Limit | None = None
    dt: float | None = None
    terminal: Callable[[Any, Any, Any], Scalar] | None = None
    weights: Any = ()

    def __post_init__(self) -> None:
        if self.control_rate is not None and self.dt is None:
            raise ValueError("control_rate needs dt, the sampling period in seconds")
        _ = self.limit

    @cached_property
    def limit(self) -> Limiter:
        """The projection onto the limits of the actuators."""
        rate = np.inf if self.control_rate is None else self.control_rate
        low, high, rate = np.broadcast_arrays(self.control_low, self.control_high, rate)
        return actuator_limits(low, high, rate, self.dt or 1.0)

    def task(self) -> Task:
        """Return the planning problem as functions."""
        box = np.broadcast_arrays(self.control_low, self.control_high)
        low, high = (jnp.asarray(end, dtype=float) for end in box)
        steps = self.prepare, self.step, _check_reference, self.charge
        return Task(low, high, self.weights, *steps)

    def prepare(
        self,
        params: Params,
        observation: Any,
        env: Any,
        reference: Any,
        start: PlanningStart,
    ) -> RolloutSetup:
        """Return the first sample and what all samples share."""
        # Before the first control, slew limits count from rest.
        rest = self.limit(jnp.zeros_like(start.control), start.control)
        before = jnp.where(start.known, start.control, rest)
        # Integers become real if the dynamics make them so: a scan keeps types.
        after = jax.eval_shape(self.dynamics, params, observation, before, env)
        state = jax.tree.map(
            lambda leaf, like: jnp.asarray(leaf, like.dtype), observation, after
        )
        return RolloutSetup((params, env), Sample((), state, before), reference)

    def step(
        self,
        weights: Any,
        context: tuple[Params, Any],
        before: Sample,
        nu: Control,
        goal: Any,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of one rollout: limits and state equation."""
        params, env = context
        control = self.limit(nu, before.control)
        state = self.dynamics(params, before.state, control, env)
        return StepResult(Sample((), state, control), control, control, state)

    def charge(
        self, weights: Any, before: Sample, after: Sample, goal: Any, at: StepIndex
    ) -> Scalar:
        """Return the cost of one step."""
        cost = self.stage(weights, after.state, after.control, before.control, goal)
        if self.terminal is not None:
            cost = cost + at.last * self.terminal(weights, after.state, goal)
        return cost


free_task = factory(FreeTask, FreeTask.task)
"""(dynamics, stage, settings of `FreeTask`) -> `Task`."""


def _check_reference(observation: Any, env: Any, reference: Any, horizon: int) -> None:
    """Raise a ValueError for a reference of another length than the horizon."""
    del observation, env
    for shape in map(jnp.shape, jax.tree.leaves(reference)):
        if shape[:1] != (horizon,):
            raise ValueError(
                f"reference must have {horizon} steps as its leading axis, "
                f"got shape {shape}"
            )
