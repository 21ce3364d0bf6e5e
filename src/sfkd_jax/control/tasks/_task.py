"""What a planner plans: a rollout with a cost, stated one sample at a time."""

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
"""Where the actuators stand, read off an observation."""


class Applied(NamedTuple):
    """The control in force when planning starts, and whether there is one."""

    control: Control
    known: Bool[Array, ""]


class Began(NamedTuple):
    """What a task evaluates once per control step, before anything is rolled out.

    Attributes:
        context: shared by all samples and steps.
        start: a sample before its first step.
        targets: what differs from step to step; every leaf has the horizon as leading
            axis.
        proposals: plans that the task itself suggests, sampled beside the planner's, if
            it has any.
    """

    context: Any
    start: Any
    targets: Any
    proposals: Float[Array, "*particle proposal horizon control"] | None = None


class Advanced(NamedTuple):
    """One step of one sample.

    Attributes:
        sample: after the step.
        cost: of the step.
        control: applied in it.
        perturbation: the part of the one asked for that was effective within the
            limits.
        state: where it led.
    """

    sample: Any
    cost: Scalar
    control: Control
    perturbation: Control
    state: State


class Task(NamedTuple):
    """A planning problem as pure functions.

    Attributes:
        low, high: the box of the controls.
        weights: of the cost, a pytree of numbers; planners carry them as data, so they
            change without a compilation.
        begin: (params, observation, env, reference, applied) -> `Began`.
        advance: (weights, context, sample, perturbation, target, last) -> `Advanced`;
            last is 1 at the final step.
        check: (observation, env, reference, horizon) -> None, or ValueError that names
            the argument of a wrong shape.
    """

    low: Control
    high: Control
    weights: Any
    begin: Callable[[Params, State, Environment, Any, Applied], Began]
    advance: Callable[[Any, Any, Any, Control, Any, Scalar], Advanced]
    check: Callable[[State, Environments, Any, int], None]


def actuator_limits(
    low: tuple[float, ...],
    high: tuple[float, ...],
    rate: tuple[float, ...] | None,
    dt: float,
) -> Callable[[Control, Control], Control]:
    """(wanted, before) -> the nearest control inside the box and within rate · dt of the one before.

    Raises:
        ValueError: a box that is empty or of another size, or rates that are not
            positive.
    """
    if len(low) != len(high) or not all(a < b for a, b in zip(low, high, strict=True)):
        raise ValueError(
            f"control_low must lie below control_high, entry by entry, got {low} and {high}"
        )
    if rate is None:
        return lambda wanted, before: jnp.clip(
            wanted, jnp.asarray(low), jnp.asarray(high)
        )
    if len(rate) != len(low) or not all(entry > 0 for entry in rate):
        raise ValueError(f"control_rate needs {len(low)} positive numbers, got {rate}")
    bottom, top, reach = jnp.asarray(low), jnp.asarray(high), dt * jnp.asarray(rate)

    def limit(wanted: Control, before: Control) -> Control:
        before = jnp.clip(
            before, bottom, top
        )  # an actuator outside its box comes back as fast as the box asks
        return jnp.clip(
            wanted,
            jnp.maximum(bottom, before - reach),
            jnp.minimum(top, before + reach),
        )

    return limit


class FreeSample(NamedTuple):
    """A sample of a plain state equation: state and last control."""

    state: State
    control: Control


StageLoss: TypeAlias = Callable[[Any, State, Control, Control, Any], Scalar]


def free_task(
    dynamics: Callable[[Params, State, Control, Environment], State],
    stage: StageLoss,
    *,
    dt: float = 1.0,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    control_rate: tuple[float, ...] | None = None,
    terminal: Callable[[Any, State, Any], Scalar] | None = None,
    weights: Any = (),
    actuator: Actuator | None = None,
) -> Task:
    """Any state equation and any cost: x⁺ = f(params, x, u, e), J = Σ_k ℓ(weights, x_{k+1}, u_k, u_{k−1}, ref_k) + φ.

    Args:
        dynamics: f.
        stage: ℓ, of the state that the control leads to.
        terminal: φ(weights, x_T, ref_T).
        dt: [s], for rates.
        control_low, control_high, control_rate: limits; the last per second, or None.
        weights: a pytree of numbers that both costs read, changed at run time through
            the planner's state.
        actuator: see `path_tracking`.

    Returns:
        A `Task` whose reference is any array or pytree with the horizon as leading
        axis; () if there is none.

    Raises:
        ValueError: limits that cannot be meant.
    """
    limit = actuator_limits(control_low, control_high, control_rate, dt)
    low, high = (
        jnp.asarray(control_low, dtype=float),
        jnp.asarray(control_high, dtype=float),
    )
    nothing = jnp.clip(jnp.zeros_like(low), low, high)

    def begin(
        params: Params,
        observation: State,
        env: Environment,
        reference: Any,
        applied: Applied,
    ) -> Began:
        before = jnp.where(applied.known, applied.control, nothing)
        if actuator is not None:
            before = actuator(observation)
        return Began((params, env), FreeSample(observation, before), reference)

    def advance(
        weights: Any,
        context: Any,
        before: FreeSample,
        nu: Control,
        goal: Any,
        last: Scalar,
    ) -> Advanced:
        params, env = context
        control = limit(nu, before.control)
        state = dynamics(params, before.state, control, env)
        charge = stage(weights, state, control, before.control, goal)
        if terminal is not None:
            charge = charge + last * terminal(weights, state, goal)
        return Advanced(FreeSample(state, control), charge, control, control, state)

    return Task(low, high, weights, begin, advance, _check_nothing)


def _check_nothing(
    observation: State, env: Environments, reference: Any, horizon: int
) -> None:
    """Of a free task, name the argument that has the wrong shape."""
    if observation.ndim != 1:
        raise ValueError(f"observation must have shape (nx,), got {observation.shape}")
    for leaf in jax.tree.leaves(reference):
        if leaf.shape[:1] != (horizon,):
            raise ValueError(
                f"reference must have {horizon} steps as its leading axis, got shape {leaf.shape}"
            )
