"""Planning problems as pure functions: one rollout step, its cost and its limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.types import Control, Environment, Params, Scalar, State

Environments: TypeAlias = Float[Array, "*particle environment"]
"""One environment, or several that are equally likely."""
Actuator: TypeAlias = Callable[[State], Control]
"""Reads the actuator positions from an observation."""
Limiter: TypeAlias = Callable[[Control, Control], Control]
"""(wanted control, control before) -> the nearest control that the actuators allow."""


class PreviousControl(NamedTuple):
    """The control in force when planning starts.

    Attributes:
        control: applied at the previous control step.
        known: False at the first step, where no control was applied before.
    """

    control: Control
    known: Bool[Array, ""]


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
    state: State


class Task(NamedTuple):
    """A planning problem as pure functions of one sample; planners vmap them.

    Attributes:
        low: lower control limits.
        high: upper control limits.
        weights: of the cost, a pytree of numbers. Planners carry them in their state,
            so changing them does not recompile anything.
        prepare: (params, observation, env, reference, previous) -> `RolloutSetup`.
        step: (weights, context, sample, perturbation, target, last) -> `StepResult`;
            `last` is 1 at the final step of the horizon and 0 before it.
        check: (observation, env, reference, horizon) -> None; raises a ValueError that
            names an argument of the wrong shape.
    """

    low: Control
    high: Control
    weights: Any
    prepare: Callable[[Params, State, Environment, Any, PreviousControl], RolloutSetup]
    step: Callable[[Any, Any, Any, Control, Any, Scalar], StepResult]
    check: Callable[[State, Environments, Any, int], None]


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


class FreeSample(NamedTuple):
    """State of one rollout of a plain state equation: state and last control."""

    state: State
    control: Control


StageCost: TypeAlias = Callable[[Any, State, Control, Control, Any], Scalar]
"""(weights, state, control, control before, reference) -> cost of one step."""


def free_task(
    dynamics: Callable[[Params, State, Control, Environment], State],
    stage: StageCost,
    *,
    dt: float = 1.0,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    control_rate: tuple[float, ...] | None = None,
    terminal: Callable[[Any, State, Any], Scalar] | None = None,
    weights: Any = (),
    actuator: Actuator | None = None,
) -> Task:
    """Return the task of minimising any cost under any state equation.

        x⁺ = f(params, x, u, e),   J = Σ_k ℓ(weights, x_{k+1}, u_k, u_{k−1}, ref_k) + φ

    Args:
        dynamics: f.
        stage: ℓ, evaluated at the state after the control.
        dt: sampling period [s], used by `control_rate` alone.
        control_low: lower control limits.
        control_high: upper control limits.
        control_rate: largest change of a control per second, or None.
        terminal: φ(weights, x_T, ref_T).
        weights: a pytree of numbers that both costs read; it can be changed at run
            time through the planner's state.
        actuator: reads the actuator positions from the observation; without it, slew
            limits count from the control applied last.

    Returns:
        A `Task` whose reference is any array or pytree with the horizon as its leading
        axis, or () if there is none.

    Raises:
        ValueError: the limits are inconsistent, see `actuator_limits`.
    """
    limit = actuator_limits(control_low, control_high, control_rate, dt)
    low, high = (
        jnp.asarray(control_low, dtype=float),
        jnp.asarray(control_high, dtype=float),
    )
    initial = jnp.clip(jnp.zeros_like(low), low, high)

    def prepare(
        params: Params,
        observation: State,
        env: Environment,
        reference: Any,
        previous: PreviousControl,
    ) -> RolloutSetup:
        before = jnp.where(previous.known, previous.control, initial)
        if actuator is not None:
            before = actuator(observation)
        return RolloutSetup((params, env), FreeSample(observation, before), reference)

    def step(
        weights: Any,
        context: Any,
        before: FreeSample,
        nu: Control,
        goal: Any,
        last: Scalar,
    ) -> StepResult:
        params, env = context
        control = limit(nu, before.control)
        state = dynamics(params, before.state, control, env)
        cost = stage(weights, state, control, before.control, goal)
        if terminal is not None:
            cost = cost + last * terminal(weights, state, goal)
        return StepResult(FreeSample(state, control), cost, control, control, state)

    return Task(low, high, weights, prepare, step, _check_shapes)


def _check_shapes(
    observation: State, env: Environments, reference: Any, horizon: int
) -> None:
    """Raise a ValueError that names an argument of the wrong shape."""
    if observation.ndim != 1:
        raise ValueError(f"observation must have shape (nx,), got {observation.shape}")
    for leaf in jax.tree.leaves(reference):
        if leaf.shape[:1] != (horizon,):
            raise ValueError(
                f"reference must have {horizon} steps as its leading axis, "
                f"got shape {leaf.shape}"
            )
