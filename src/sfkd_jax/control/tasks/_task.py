"""Planning problems as pure functions: one rollout step, its cost and its limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.types import Control, Key, Params, Scalar, State

Environments: TypeAlias = Float[Array, "*particle environment"]
"""One environment, or several that are equally likely."""
Actuator: TypeAlias = Callable[[State], Control]
"""Reads the actuator positions from an observation."""
Limiter: TypeAlias = Callable[[Control, Control], Control]
"""(wanted control, control before) -> the nearest control that the actuators allow."""


class PlanningStart(NamedTuple):
    """What a planner knows at the start of a control step.

    Attributes:
        control: applied at the previous control step.
        known: False at the first step, where no control was applied before.
        key: of this control step (and environment), for a task that is random itself.
    """

    control: Control
    known: Bool[Array, ""]
    key: Key | None = None


class StepIndex(NamedTuple):
    """The place of a step in the horizon.

    Attributes:
        number: 0, 1, …
        last: 1 at the final step and 0 before it.
    """

    number: Int[Array, ""]
    last: Scalar


class RolloutSetup(NamedTuple):
    """Everything that a task evaluates once per control step, before the rollouts.

    Attributes:
        context: shared by all samples and steps.
        start: state of one rollout before its first step.
        targets: data of each step; every leaf has the horizon as its leading axis.
        proposals: plans suggested by the task, evaluated beside the sampled ones.
    """

    context: Any
    start: Any
    targets: Any
    proposals: Float[Array, "*particle proposal horizon control"] | None = None


class StepResult(NamedTuple):
    """One step of one rollout.

    Attributes:
        sample: state of the rollout after the step.
        cost: of the step.
        control: applied in the step.
        perturbation: the part of the requested perturbation that the limits allowed.
        state: predicted state after the step.
    """

    sample: Any
    cost: Scalar
    control: Control
    perturbation: Control
    state: Any


class Task(NamedTuple):
    """A planning problem as pure functions of one sample; planners vmap them.

    Attributes:
        low: lower control limits.
        high: upper control limits.
        weights: of the cost, a pytree of numbers. Planners carry them in their state,
            so changing them does not recompile anything.
        prepare: (params, observation, env, reference, planning start) ->
            `RolloutSetup`.
        step: (weights, context, sample, perturbation, target, step index) ->
            `StepResult`.
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


def actuator_limits(
    low: tuple[float, ...],
    high: tuple[float, ...],
    rate: tuple[float, ...] | None,
    dt: float,
) -> Limiter:
    """Return the projection of a control onto its box and its slew limits.

    Args:
        low: lower control limits.
        high: upper control limits.
        rate: largest change per second, or None for no slew limit.
        dt: sampling period [s].

    Raises:
        ValueError: the box is empty, the sizes differ, or a rate is not positive.
    """
    if len(low) != len(high) or not all(a < b for a, b in zip(low, high, strict=True)):
        raise ValueError(
            "control_low must lie below control_high, entry by entry, "
            f"got {low} and {high}"
        )
    if rate is None:
        return lambda wanted, before: jnp.clip(
            wanted, jnp.asarray(low), jnp.asarray(high)
        )
    if len(rate) != len(low) or not all(entry > 0 for entry in rate):
        raise ValueError(f"control_rate needs {len(low)} positive numbers, got {rate}")
    bottom, top, reach = jnp.asarray(low), jnp.asarray(high), dt * jnp.asarray(rate)

    def limit(wanted: Control, before: Control) -> Control:
        # An actuator outside its box returns to it at once, whatever its slew limit.
        before = jnp.clip(before, bottom, top)
        return jnp.clip(
            wanted,
            jnp.maximum(bottom, before - reach),
            jnp.minimum(top, before + reach),
        )

    return limit
