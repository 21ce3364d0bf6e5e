"""Planning problems as pure functions of one rollout step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Int

from sfkd_jax.types import Control, Params, Scalar

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
        followable: whether the plan is for the reference that was given; if not, the
            control is what the task does instead, and not healthy.
    """

    context: Any
    start: Any
    targets: Any
    followable: Bool[Array, ""] | bool = True


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
        check: (observation, env, reference, horizon) -> whether the positions are
            precise, or None where there are none; raises a ValueError that
            names an argument of the wrong shape.
        constraint: see `constrained`; None for no constraint.
        constraint_data: that the constraint is given.
    """

    low: Control
    high: Control
    weights: Any
    prepare: Callable[[Params, Any, Any, Any, PlanningStart], RolloutSetup]
    step: Callable[[Any, Any, Any, Control, Any, StepIndex], StepResult]
    check: Callable[[Any, Any, Any, int], Bool[Array, ""] | None]
    constraint: Callable[[Any, Any, Control, Any, StepIndex], Array] | None = None
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
