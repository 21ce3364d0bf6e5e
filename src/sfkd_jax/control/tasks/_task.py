"""Planning problems as pure functions of one rollout step; any dynamics and cost."""

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
from sfkd_jax.types import Control, Params, Scalar

Environments: TypeAlias = Float[Array, "*particle environment"]
"""One environment, or several that are equally likely."""
Limiter: TypeAlias = Callable[[Control, Control], Control]
"""(wanted control, control before) -> the nearest control that the actuators allow."""
Limit: TypeAlias = ArrayLike | Sequence[float]
"""One number for all controls, or one for each."""


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
        start: state of one rollout before its first step.
        targets: data of each step; every leaf has the horizon as its leading axis.
    """

    context: Any
    start: Any
    targets: Any


class StepResult(NamedTuple):
    """One step of one rollout.

    Attributes:
        sample: state of the rollout after the step.
        cost: of the step.
        control: applied in the step.
        perturbation: the part of the row of the plan that the limits allowed.
        state: predicted state after the step; reported, not carried.
    """

    sample: Any
    cost: Scalar
    control: Control
    perturbation: Control
    state: Any


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
        check: (observation, env, reference, horizon) -> None; raises a ValueError that
            names an argument of the wrong shape.
        constraint: see `constrained`; None for no constraint.
        constraint_data: that the constraint is given.
    """

    low: Control
    high: Control
    weights: Any
    prepare: Callable[[Params, Any, Any, Any, PlanningStart], RolloutSetup]
    step: Callable[[Any, Any, Any, Control, Any, StepIndex], StepResult]
    check: Callable[[Any, Any, Any, int], None]
    constraint: Callable[[Any, Any, Control, Any, StepIndex], Array] | None = None
    constraint_data: Any = ()


def actuator_limits(low: Limit, high: Limit, rate: Limit | None, dt: float) -> Limiter:
    """Return the projection of a control onto its box and its slew limits.

    Args:
        low: lower control limits.
        high: upper control limits.
        rate: largest change per second, or None for no slew limit.
        dt: sampling period [s].

    Raises:
        ValueError: the box is empty, the sizes differ, or a rate is not positive.
    """
    if np.shape(low) != np.shape(high) or not np.all(np.less(low, high)):
        raise ValueError(
            "control_low must lie below control_high, entry by entry, "
            f"got {low} and {high}"
        )
    bottom, top = jnp.asarray(low, dtype=float), jnp.asarray(high, dtype=float)
    if rate is None:
        return lambda wanted, before: jnp.clip(wanted, bottom, top)
    if np.shape(rate) not in ((), np.shape(low)) or not np.all(np.greater(rate, 0)):
        raise ValueError(f"control_rate needs positive numbers, got {rate}")
    most = dt * jnp.asarray(rate, dtype=float)

    def limit(wanted: Control, before: Control) -> Control:
        # An actuator outside its box returns to it at once, whatever its slew limit.
        before = jnp.clip(before, bottom, top)
        low, high = before - most, before + most
        return jnp.clip(wanted, jnp.maximum(bottom, low), jnp.minimum(top, high))

    return limit


class FreeSample(NamedTuple):
    """State of one rollout of a plain state equation: state and last control."""

    state: Any
    control: Control


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

    Raises:
        ValueError: the limits are inconsistent, or a rate is given without `dt`.
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
        """Raise a ValueError for inconsistent limits."""
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
        steps = self.prepare, self.step, _check_reference
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
        state = jax.tree.map(jnp.asarray, observation)
        # Integers become real if the dynamics make them so: a scan keeps types.
        after = jax.eval_shape(self.dynamics, params, state, before, env)
        state = jax.tree.map(
            lambda leaf, like: leaf if leaf.dtype == like.dtype else leaf.astype(like),
            state,
            after,
        )
        return RolloutSetup((params, env), FreeSample(state, before), reference)

    def step(
        self,
        weights: Any,
        context: tuple[Params, Any],
        before: FreeSample,
        nu: Control,
        goal: Any,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of one rollout: limits, state equation, cost."""
        params, env = context
        control = self.limit(nu, before.control)
        state = self.dynamics(params, before.state, control, env)
        cost = self.stage(weights, state, control, before.control, goal)
        if self.terminal is not None:
            cost = cost + at.last * self.terminal(weights, state, goal)
        return StepResult(FreeSample(state, control), cost, control, control, state)


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
