"""Planning problems with any state equation and any cost."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from sfkd_jax.control.tasks._task import (
    Actuator,
    Limiter,
    PlanningStart,
    RolloutSetup,
    StepIndex,
    StepResult,
    Task,
    actuator_limits,
)
from sfkd_jax.types import Control, Key, Params, Scalar

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


class _Problem(NamedTuple):
    """Settings of `free_task` as its functions need them."""

    dynamics: Callable[..., Any]
    stage: StageCost
    terminal: Callable[..., Scalar] | None
    limit: Limiter
    initial: Control
    actuator: Actuator | None


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
    problem = _Problem(
        dynamics=_with_extras(dynamics),
        stage=_with_extras(stage),
        terminal=None if terminal is None else _with_extras(terminal),
        limit=actuator_limits(low, high, rate, dt or 1.0),
        initial=jnp.clip(jnp.zeros(len(low)), lowest, highest),
        actuator=actuator,
    )
    return Task(
        lowest,
        highest,
        weights,
        partial(_prepare, problem),
        partial(_step, problem),
        _check_reference,
    )


def _prepare(
    problem: _Problem,
    params: Params,
    observation: Any,
    env: Any,
    reference: Any,
    start: PlanningStart,
) -> RolloutSetup:
    """The first sample and what all samples share."""
    before = jnp.where(start.known, start.control, problem.initial)
    if problem.actuator is not None:
        before = problem.actuator(observation)
    first = FreeSample(jax.tree.map(jnp.asarray, observation), before)
    return RolloutSetup(_Context(params, env, start.key), first, reference)


def _step(
    problem: _Problem,
    weights: Any,
    context: _Context,
    before: FreeSample,
    nu: Control,
    goal: Any,
    at: StepIndex,
) -> StepResult:
    """One step of one rollout: limits, state equation, cost."""
    extras = context._asdict() | {"step": at.number}
    if context.key is not None:
        extras["key"] = jax.random.fold_in(context.key, at.number)
    control = problem.limit(nu, before.control)
    state = problem.dynamics(extras, context.params, before.state, control, context.env)
    cost = problem.stage(extras, weights, state, control, before.control, goal)
    if problem.terminal is not None:
        cost = cost + at.last * problem.terminal(extras, weights, state, goal)
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
