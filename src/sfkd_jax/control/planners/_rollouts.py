"""Rollouts of many plans, in one environment or in several."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._plans import Evaluate, Evaluated, Plan, Plans
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
    """

    costs: Float[Array, "*particle sample"]
    controls: Float[Array, "*particle horizon sample control"]
    perturbations: Float[Array, "*particle horizon sample control"]
    states: Any


class PlanRollout(NamedTuple):
    """The rollout of one plan; of several environments, in the first one.

    Attributes:
        cost: of the whole rollout; of several environments, the risk over them.
        controls: applied, within the limits.
        perturbations: that the limits allowed.
        states: predicted, (horizon, …) of every leaf.
    """

    cost: Scalar
    controls: Plan
    perturbations: Plan
    states: Any


RollOut: TypeAlias = Callable[[Plans], Rollouts]


def rollout_function(
    task: Task,
    weights: Any,
    setup: RolloutSetup,
    *,
    several: bool,
) -> RollOut:
    """Return the function that rolls out plans.

    Args:
        task: the planning problem.
        weights: of its cost.
        setup: of this control step.
        several: whether `setup` has a leading axis of environments.
    """
    roll_out = partial(_roll_out, task, weights)
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
        costs, perturbations, states = (
            rollouts.costs,
            rollouts.perturbations,
            rollouts.states,
        )
        if risk is None:
            return Evaluated(costs, perturbations, states)
        first = jax.tree.map(lambda leaf: leaf[0], states)
        return Evaluated(risk(costs), jnp.mean(perturbations, axis=0), first)

    return evaluate


def roll_out_plan(
    roll_out: RollOut, risk: RiskMeasure | None, plan: Plan
) -> PlanRollout:
    """Roll out one plan; `risk` as in `evaluate_function`."""
    costs, *trajectories = roll_out(plan[:, None])
    cost = costs[0] if risk is None else risk(costs)[0]
    first = (slice(None), 0) if risk is None else (0, slice(None), 0)
    return PlanRollout(cost, *jax.tree.map(lambda leaf: leaf[first], trajectories))


def _roll_out(task: Task, weights: Any, setup: RolloutSetup, plans: Plans) -> Rollouts:
    """Roll out all plans in one environment, in one scan over the horizon."""
    horizon, count = plans.shape[:2]
    numbers = jnp.arange(horizon)
    places = StepIndex(numbers, (numbers == horizon - 1).astype(plans.dtype))
    step = jax.vmap(
        partial(task.step, weights, setup.context), in_axes=(0, 0, None, None)
    )
    start = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), setup.start
    )
    first = jax.tree.map(lambda leaf: leaf[0], (plans, setup.targets, places))

    def body(carry: Any, inputs: Any) -> Any:
        costs, samples = carry
        after = step(samples, *inputs)
        return (costs + after.cost, after.sample), (
            after.control,
            after.perturbation,
            after.state,
        )

    carry = _as_returned(
        lambda carry: body(carry, first)[0], (jnp.zeros(count, plans.dtype), start)
    )
    (costs, _), trajectories = jax.lax.scan(body, carry, (plans, setup.targets, places))
    return Rollouts(costs, *trajectories)


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

    costs = join(rollouts.costs, particles)
    trajectories = jax.tree.map(partial(join, axis=particles + 1), rollouts[1:])
    return Rollouts(costs, *trajectories)
