"""Planning problems as pure functions of one rollout step; any dynamics and cost."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
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


Limit: TypeAlias = ArrayLike | Sequence[float] | None
"""One number for every control, one for each, or None for no limit."""
StageCost: TypeAlias = Callable[..., Scalar]
"""(weights, state, control, control before, reference) -> cost of one step."""


class FreeSample(NamedTuple):
    """State of one rollout of a plain state equation: state and last control."""

    state: Any
    control: Control


class _Context(NamedTuple):
    """What all steps of all rollouts share."""

    params: Params
    env: Any
    key: Key | None


def free_task(
    dynamics: Callable[..., Any],
    stage: StageCost,
    *,
    dt: float | None = None,
    control_low: Limit = None,
    control_high: Limit = None,
    control_rate: Limit = None,
    num_controls: int | None = None,
    terminal: Callable[..., Scalar] | None = None,
    weights: Any = (),
    actuator: Actuator | None = None,
) -> Task:
    """Return the task of minimising any cost under any state equation.

        x⁺ = f(params, x, u, e),   J = Σ_k ℓ(weights, x_{k+1}, u_k, u_{k−1}, ref_k) + φ

    The state, the environment and the reference may be arrays, any other pytrees, or
    None. A function is given `step` (number of the step), `params`, `env` and `key` as
    keyword arguments if it has parameters of these names. The key is that of a step in
    one environment, the same for all samples, so that they meet the same noise.

    Args:
        dynamics: f; may take `step` and `key` besides.
        stage: ℓ, evaluated at the state after the control; may take `params`, `env` and
            `step` besides.
        dt: sampling period [s]; needed with `control_rate`, and used by it alone.
        control_low: lower control limits, one number for all controls, or None.
        control_high: upper control limits, one number for all controls, or None.
        control_rate: largest change of a control per second, or None.
        num_controls: needed if no limit has one entry per control; 1 by default.
        terminal: φ(weights, x_T, ref_T); may take `params` and `env` besides.
        weights: a pytree of numbers that both costs read; it can be changed at run
            time through the planner's state.
        actuator: reads the actuator positions from the observation; without it, slew
            limits count from the control applied last.

    Returns:
        A `Task` whose reference has the horizon as the leading axis of every leaf.

    Raises:
        ValueError: the limits are inconsistent, see `actuator_limits`, or
            `control_rate` is given without `dt`.
    """
    if control_rate is not None and dt is None:
        raise ValueError("control_rate needs dt, the sampling period in seconds")
    limits = (control_low, control_high, control_rate)
    count = num_controls or max(
        1 if limit is None else np.size(limit) for limit in limits
    )
    low = _filled(control_low, count, -math.inf)
    high = _filled(control_high, count, math.inf)
    rate = None if control_rate is None else _filled(control_rate, count, math.inf)
    lowest, highest = jnp.asarray(low, dtype=float), jnp.asarray(high, dtype=float)
    problem = _FreeTask(
        dynamics=_with_extras(dynamics),
        stage=_with_extras(stage),
        terminal=None if terminal is None else _with_extras(terminal),
        limit=actuator_limits(low, high, rate, dt or 1.0),
        initial=jnp.clip(jnp.zeros(len(low)), lowest, highest),
        actuator=actuator,
    )
    return Task(
        lowest, highest, weights, problem.prepare, problem.step, _check_reference
    )


@dataclass(frozen=True, eq=False)
class _FreeTask:
    """The functions of `free_task`."""

    dynamics: Callable[..., Any]
    stage: StageCost
    terminal: Callable[..., Scalar] | None
    limit: Limiter
    initial: Control
    actuator: Actuator | None

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
        before = jnp.where(start.known, start.control, self.initial)
        if self.actuator is not None:
            # What is measured is better than what was commanded.
            before = self.actuator(observation)
        first = FreeSample(jax.tree.map(jnp.asarray, observation), before)
        return RolloutSetup(_Context(params, env, start.key), first, reference)

    def step(
        self,
        weights: Any,
        context: _Context,
        before: FreeSample,
        nu: Control,
        goal: Any,
        at: StepIndex,
    ) -> StepResult:
        """Return one step of one rollout: limits, state equation, cost."""
        extras = context._asdict() | {"step": at.number}
        if context.key is not None:
            # One key a step for all samples: plans are compared under equal noise.
            extras["key"] = jax.random.fold_in(context.key, at.number)
        control = self.limit(nu, before.control)
        params, env = context.params, context.env
        state = self.dynamics(extras, params, before.state, control, env)
        cost = self.stage(extras, weights, state, control, before.control, goal)
        if self.terminal is not None:
            cost = cost + at.last * self.terminal(extras, weights, state, goal)
        return StepResult(FreeSample(state, control), cost, control, control, state)


def _with_extras(function: Callable[..., Any]) -> Callable[..., Any]:
    """(extras, *arguments) -> the function with those extras that it names."""
    try:
        names = inspect.signature(function).parameters
    except (TypeError, ValueError):  # no signature: a built-in, for example
        names = {}
    wanted = [
        name for name in ("params", "env", "step", "key") if _is_extra(names, name)
    ]

    def call(extras: Mapping[str, Any], *arguments: Any) -> Any:
        return function(*arguments, **{name: extras[name] for name in wanted})

    return call


def _is_extra(names: Mapping[str, inspect.Parameter], name: str) -> bool:
    """Whether a parameter of this name can only be an extra."""
    # Positional names are the caller's own; `env` may be the fourth argument.
    return name in names and names[name].kind is inspect.Parameter.KEYWORD_ONLY


def _filled(limit: Limit, count: int, missing: float) -> tuple[float, ...]:
    """A limit as one number for each control."""
    if limit is None:
        return (missing,) * count
    entries = tuple(float(entry) for entry in np.ravel(limit))
    return entries * count if np.ndim(limit) == 0 else entries


def _check_reference(observation: Any, env: Any, reference: Any, horizon: int) -> None:
    """Raise a ValueError for a reference of another length than the horizon."""
    del observation, env
    for leaf in jax.tree.leaves(reference):
        shape = jnp.shape(leaf)
        if shape[:1] != (horizon,):
            raise ValueError(
                f"reference must have {horizon} steps as its leading axis, "
                f"got shape {shape}"
            )
