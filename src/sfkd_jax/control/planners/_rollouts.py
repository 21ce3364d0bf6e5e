"""Rollouts of many plans, in one environment or in several."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._plans import Evaluate, Evaluated, Plan, Plans, Tuning
from sfkd_jax.control.planners._risk import RiskMeasure
from sfkd_jax.control.tasks._task import RolloutSetup, StepIndex, Task
from sfkd_jax.types import Scalar


class Rollouts(NamedTuple):
    """Rollouts of many plans.

    Attributes:
        costs: of the whole rollouts.
        controls: applied, within the limits.
        perturbations: that the limits allowed.
        states: predicted, (*particle, horizon, sample, …) of every leaf.
        violations: largest of a constraint, not below 0; None without constraints.
    """

    costs: Float[Array, "*particle sample"]
    controls: Float[Array, "*particle horizon sample control"]
    perturbations: Float[Array, "*particle horizon sample control"]
    states: Any
    violations: Float[Array, "*particle sample"] | None = None


class PlanRollout(NamedTuple):
    """The rollout of one plan; of several environments, in the first one.

    Attributes:
        cost: of the whole rollout; of several environments, the risk over them.
        controls: applied, within the limits.
        perturbations: that the limits allowed.
        states: predicted, (horizon, …) of every leaf.
        violation: largest of a constraint; None without constraints.
    """

    cost: Scalar
    controls: Plan
    perturbations: Plan
    states: Any
    violation: Scalar | None = None


RollOut: TypeAlias = Callable[[Plans], Rollouts]


def rollout_function(
    task: Task,
    tuning: Tuning,
    setup: RolloutSetup,
    *,
    several: bool,
    unroll: int,
) -> RollOut:
    """Return the function that rolls out plans.

    Args:
        task: the planning problem.
        tuning: weights of its cost, data of its constraints.
        setup: of this control step.
        several: whether `setup` has a leading axis of environments.
        unroll: number of steps that are compiled as one.
    """
    roll_out = partial(_roll_out, task, tuning, unroll)
    if several:
        roll_out = jax.vmap(roll_out, in_axes=(0, None))
    return partial(roll_out, setup)


def evaluate_function(
    roll_out: RollOut,
    risk: RiskMeasure | None,
    *,
    chunk: int,
    sharding: jax.sharding.Sharding | None,
) -> Evaluate:
    """Return the function that a search calls to evaluate plans.

    Args:
        roll_out: see `rollout_function`.
        risk: reduces the costs over several environments; None for one environment.
        chunk: number of samples rolled out at a time; 0 for all at once.
        sharding: of the samples over devices, or None.
    """

    def evaluate(plans: Plans) -> Evaluated:
        # A single plan cannot be split over devices.
        if sharding is not None and plans.shape[1] > 1:
            plans = jax.lax.with_sharding_constraint(plans, sharding)
        rollouts = _in_chunks(roll_out, plans, chunk)
        costs, _, perturbations, states, violations = rollouts
        if risk is None:
            return Evaluated(costs, perturbations, states, violations)
        first = jax.tree.map(lambda leaf: leaf[0], states)
        mean = jnp.mean(perturbations, axis=0)
        return Evaluated(risk(costs), mean, first, _worst(violations))

    return evaluate


def roll_out_plan(
    roll_out: RollOut, risk: RiskMeasure | None, plan: Plan
) -> PlanRollout:
    """Roll out one plan; `risk` as in `evaluate_function`."""
    costs, controls, perturbations, states, violations = roll_out(plan[:, None])
    first = (slice(None), 0) if risk is None else (0, slice(None), 0)
    trajectories = (controls, perturbations, states)
    controls, perturbations, states = jax.tree.map(
        lambda leaf: leaf[first], trajectories
    )
    if risk is not None:
        costs, violations = risk(costs), _worst(violations)
    violation = None if violations is None else violations[0]
    return PlanRollout(costs[0], controls, perturbations, states, violation)


def _worst(violations: Array | None) -> Float[Array, " sample"] | None:
    """The largest violation over several environments."""
    return None if violations is None else jnp.max(violations, axis=0)


def _roll_out(
    task: Task, tuning: Tuning, unroll: int, setup: RolloutSetup, plans: Plans
) -> Rollouts:
    """Roll out all plans in one environment, in one scan over the horizon."""
    horizon, count = plans.shape[:2]
    numbers = jnp.arange(horizon)
    places = StepIndex(numbers, (numbers == horizon - 1).astype(plans.dtype))
    step = jax.vmap(
        partial(task.step, tuning.cost, setup.context), in_axes=(0, 0, None, None)
    )
    violate = jax.vmap(partial(_violation, task, tuning), in_axes=(0, 0, None, None))
    start = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), setup.start
    )
    first = jax.tree.map(lambda leaf: leaf[0], (plans, setup.targets, places))

    def body(carry: Any, inputs: Any) -> Any:
        costs, samples, worst = carry
        after = step(samples, *inputs)
        if worst is not None:
            now = violate(after.state, after.control, *inputs[1:])
            worst = jnp.maximum(worst, now)
        return (costs + after.cost, after.sample, worst), (
            after.control,
            after.perturbation,
            after.state,
        )

    none = jnp.zeros(count, plans.dtype)
    carry = _as_returned(
        lambda carry: body(carry, first)[0],
        (none, start, None if task.constraint is None else none),
    )
    inputs = (plans, setup.targets, places)
    # A single plan gains nothing from it.
    (costs, _, worst), (controls, perturbations, states) = jax.lax.scan(
        body, carry, inputs, unroll=unroll if count > 1 else 1
    )
    return Rollouts(costs, controls, perturbations, states, worst)


def _violation(
    task: Task, tuning: Tuning, state: Any, control: Array, target: Any, at: StepIndex
) -> Scalar:
    """The largest violation of a step; infinite where it is not a number."""
    assert task.constraint is not None
    all_of_them = task.constraint(tuning.constraints, state, control, target, at)
    largest = jnp.max(all_of_them)
    return jnp.where(jnp.isnan(largest), jnp.inf, largest)


def _as_returned(function: Callable[[Any], Any], carry: Any) -> Any:
    """Return a carry in the types that the function returns.

    An integer observation becomes real, for example, if the dynamics make it so.
    """
    if len({leaf.dtype for leaf in jax.tree.leaves(carry)}) == 1:
        return carry
    for _ in range(2):
        after = jax.eval_shape(function, carry)
        carry = jax.tree.map(_as_type, carry, after)
    return carry


def _as_type(leaf: Array, like: jax.ShapeDtypeStruct) -> Array:
    """A leaf in another type; one of the same type as it is, a random key as well."""
    return leaf if leaf.dtype == like.dtype else leaf.astype(like.dtype)


def _in_chunks(roll_out: RollOut, plans: Plans, chunk: int) -> Rollouts:
    """Roll out all plans, `chunk` at a time, to bound the memory."""
    horizon, count, channels = plans.shape
    if not chunk or chunk >= count:
        return roll_out(plans)
    parts = (
        jnp.pad(plans, ((0, 0), (0, -count % chunk), (0, 0)))
        .reshape(horizon, -1, chunk, channels)
        .swapaxes(0, 1)
    )
    rollouts = jax.lax.map(roll_out, parts)
    particles = rollouts.costs.ndim - 2

    def join(leaf: Array, axis: int) -> Array:
        """Join the chunks along the axis of the samples."""
        leaf = jnp.moveaxis(leaf, 0, axis)
        shape = (*leaf.shape[:axis], -1, *leaf.shape[axis + 2 :])
        return jax.lax.slice_in_dim(leaf.reshape(shape), 0, count, axis=axis)

    controls, perturbations, states = jax.tree.map(
        partial(join, axis=particles + 1), rollouts[1:4]
    )
    costs, violations = jax.tree.map(
        partial(join, axis=particles), (rollouts.costs, rollouts.violations)
    )
    return Rollouts(costs, controls, perturbations, states, violations)
