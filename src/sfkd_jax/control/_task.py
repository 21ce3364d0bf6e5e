"""Planning problems as pure functions of a step, with any cost and any constraint."""

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
from sfkd_jax.control._returned import as_cost, check_next_state
from sfkd_jax.geometry import entrywise, outside_box
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
    """What a plan starts from.

    Attributes:
        control: that was applied last.
        known: whether there was one; False at the first step.
    """

    control: Control
    known: Bool[Array, ""]


class StepIndex(NamedTuple):
    """The place of a step in the horizon.

    Attributes:
        number: 0, 1, ….
        last: 1 at the last step, 0 before it.
    """

    number: Int[Array, ""]
    last: Scalar


class RolloutSetup(NamedTuple):
    """Everything that a task evaluates once per control step, before the rollouts.

    Attributes:
        context: shared by all samples and steps.
        start: state of one rollout before its first step; a `Sample` if the task has a
            `cost`.
        targets: data of each step; every leaf has the horizon as its leading axis.
        followable: whether the plan is for the reference of the caller. If it is not,
            the task does something else instead, and the control is not healthy.
    """

    context: Any
    start: Any
    targets: Any
    followable: Bool[Array, ""] | bool = True


class Sample(NamedTuple):
    """State of one rollout.

    Attributes:
        latent: of the model; () if the state is its own latent.
        state: that was predicted last.
        control: that was applied last.
    """

    latent: Any
    state: Any
    control: Control


class StepResult(NamedTuple):
    """One step of one rollout.

    Attributes:
        sample: state of the rollout after the step.
        control: that was applied in the step.
        perturbation: the part of the row of the plan that the limits allowed.
        state: predicted state after the step; it is reported, not carried on.
        cost: of the step; None if `Task.cost` gives it.
    """

    sample: Any
    control: Control
    perturbation: Control
    state: Any
    cost: Scalar | None = None


class Task(NamedTuple):
    """A planning problem as pure functions of one sample; planners vmap them.

    A step takes one row of the plan. The task decides what a row means: a control, a
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
            step, from samples without latents; None if `step` gives it. For short
            states it is evaluated for all steps at once, which is faster than in
            `step`.
        constraint: see `constrained`; None for no constraint.
        constraint_data: first argument of the constraint.
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
    lowest = jnp.asarray(low, dtype=float)
    highest = jnp.asarray(high, dtype=float)
    largest_change = jnp.asarray(dt * np.asarray(rate, float), dtype=float)

    def limit_entry(
        wanted: Scalar, before: Scalar, lowest: Scalar, highest: Scalar, change: Scalar
    ) -> Scalar:
        # An actuator outside its box returns to it at once, whatever its slew limit.
        before = jnp.clip(before, lowest, highest)
        low = jnp.maximum(lowest, before - change)
        high = jnp.minimum(highest, before + change)
        return jnp.clip(wanted, low, high)

    def limit(wanted: Control, before: Control) -> Control:
        limits = [
            jnp.broadcast_to(end, wanted.shape)
            for end in (lowest, highest, largest_change)
        ]
        return entrywise(limit_entry, wanted, before, *limits)

    return limit


def constrained(task: Task, constraint: Constraint, data: Any = ()) -> Task:
    """Return a task whose plans must keep constraints at every step.

    As long as any sample keeps all constraints, a planner drops the samples that
    violate one. If none does, it takes the samples with the smallest violations,
    whatever they cost. If the chosen mean of samples violates a constraint that single
    samples keep, the best of those samples replaces the mean.

    Args:
        task: any task.
        constraint: see `Constraint`; `outside_circles` and `outside_boxes` help to
            write one.
        data: pytree of numbers that the constraint reads, such as positions of
            obstacles and margins. A planner carries it in `Tuning.constraints`, where
            it may change at every control step.
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
        margin: by which each circle is enlarged [m].
    """
    away = position - circles[:, :2]
    # The small number keeps derivatives finite in the centre.
    return circles[:, 2] + margin - jnp.sqrt(jnp.sum(away**2, axis=1) + 1e-12)


def outside_boxes(
    position: Float[Array, " 2"],
    boxes: Float[Array, "box 5"],
    margin: Scalar | float = 0.0,
) -> Float[Array, " box"]:
    """Return how deep a point lies inside rectangles [m], negative outside.

    Args:
        position: x, y [m].
        boxes: x, y of the centre [m], yaw [rad], length, width [m] of each.
        margin: by which each rectangle is enlarged, with round corners [m].
    """
    away = position - boxes[:, :2]
    cos = jnp.cos(boxes[:, 2])
    sin = jnp.sin(boxes[:, 2])
    along = cos * away[:, 0] + sin * away[:, 1]
    left = cos * away[:, 1] - sin * away[:, 0]
    return margin - outside_box(along, left, (0.5 * boxes[:, 3], 0.5 * boxes[:, 4]))


def at_step(values: Array, at: StepIndex) -> Array:
    """Return the value of a step, such as the place of an obstacle that moves.

    Args:
        values: one for each step, (horizon, …).
        at: the step. Beyond the last value, that value holds.
    """
    return values[jnp.minimum(at.number, values.shape[0] - 1)]


@dataclass(frozen=True, eq=False)
class FreeTask:
    """The task of minimising any cost under any state equation.

        x⁺ = f(params, x, u, e),   J = Σ_k ℓ(weights, x_{k+1}, u_k, u_{k−1}, ref_k) + φ

    State, environment and reference may be arrays, any other pytrees, or None; every
    leaf of the reference has the horizon as its leading axis.

    Attributes:
        dynamics: f, which returns a state of the same shapes.
        stage: ℓ, one number, evaluated at the state after the control.
        control_low: lower control limits.
        control_high: upper control limits.
        control_rate: largest change of a control per second, or None.
        dt: sampling period [s], which `control_rate` needs.
        terminal: φ(weights, x_T, ref_T), one number.
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
        low, high = np.broadcast_arrays(self.control_low, self.control_high)
        return Task(
            low=jnp.asarray(low, dtype=float),
            high=jnp.asarray(high, dtype=float),
            weights=self.weights,
            prepare=self.prepare,
            step=self.step,
            check=_check_reference,
            cost=self.charge,
        )

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
        # Integers become real numbers if the dynamics make them so, because the types
        # of a scan's carry must not change.
        after = jax.eval_shape(self.dynamics, params, observation, before, env)
        check_next_state("dynamics", observation, after)

        def as_after(leaf: Any, after: jax.ShapeDtypeStruct) -> Array:
            return jnp.asarray(leaf, after.dtype)

        state = jax.tree.map(as_after, observation, after)
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
        return StepResult(
            sample=Sample((), state, control),
            control=control,
            perturbation=control,
            state=state,
        )

    def charge(
        self, weights: Any, before: Sample, after: Sample, goal: Any, at: StepIndex
    ) -> Scalar:
        """Return the cost of one step."""
        state = after.state
        stage = self.stage(weights, state, after.control, before.control, goal)
        cost = as_cost("stage", stage)
        if self.terminal is not None:
            terminal = as_cost("terminal", self.terminal(weights, state, goal))
            cost = cost + at.last * terminal
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
