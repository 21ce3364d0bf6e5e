"""Rollouts of many plans, in one environment or in several."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._plans import Evaluate, Plan, Plans
from sfkd_jax.control.planners._risk import RiskMeasure
from sfkd_jax.control.tasks._task import RolloutSetup, Task
from sfkd_jax.types import Scalar


class Rollouts(NamedTuple):
    """Rollouts of many plans.

    Attributes:
        costs: of the whole rollouts.
        controls: applied, within the limits.
        perturbations: that the limits allowed.
        states: predicted.
    """

    costs: Float[Array, "*particle sample"]
    controls: Float[Array, "*particle horizon sample control"]
    perturbations: Float[Array, "*particle horizon sample control"]
    states: Float[Array, "*particle horizon sample state"]


class PlanRollout(NamedTuple):
    """The rollout of one plan; of several environments, in the first one.

    Attributes:
        cost: of the whole rollout; of several environments, the risk over them.
        controls: applied, within the limits.
        perturbations: that the limits allowed.
        states: predicted.
    """

    cost: Scalar
    controls: Plan
    perturbations: Plan
    states: Float[Array, "horizon state"]


RollOut: TypeAlias = Callable[[Plans], Rollouts]


def rollout_function(
    task: Task,
    weights: Any,
    setup: RolloutSetup,
    final_step: Float[Array, " horizon"],
    *,
    several: bool,
) -> RollOut:
    """Return the function that rolls out plans.

    Args:
        task: the planning problem.
        weights: of its cost.
        setup: of this control step.
        final_step: 1 at the last step of the horizon, 0 before it.
        several: whether `setup` has a leading axis of environments.
    """
    roll_out = partial(_roll_out, task, weights, final_step)
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

    def evaluate(plans: Plans) -> tuple[Float[Array, " sample"], Plans]:
        # A single plan cannot be split over devices.
        if sharding is not None and plans.shape[1] > 1:
            plans = jax.lax.with_sharding_constraint(plans, sharding)
        rollouts = _in_chunks(roll_out, plans, chunk)
        if risk is None:
            return rollouts.costs, rollouts.perturbations
        return risk(rollouts.costs), jnp.mean(rollouts.perturbations, axis=0)

    return evaluate


def roll_out_plan(
    roll_out: RollOut, risk: RiskMeasure | None, plan: Plan
) -> PlanRollout:
    """Roll out one plan; `risk` as in `evaluate_function`."""
    costs, *trajectories = roll_out(plan[:, None])
    if risk is None:
        return PlanRollout(costs[0], *(leaf[:, 0] for leaf in trajectories))
    return PlanRollout(risk(costs)[0], *(leaf[0, :, 0] for leaf in trajectories))


def _roll_out(
    task: Task,
    weights: Any,
    final_step: Float[Array, " horizon"],
    setup: RolloutSetup,
    plans: Plans,
) -> Rollouts:
    """Roll out all plans in one environment, in one scan over the horizon."""
    count = plans.shape[1]
    start = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), setup.start
    )

    def body(carry: Any, inputs: Any) -> Any:
        costs, samples = carry
        nus, target, last = inputs
        step = jax.vmap(task.step, in_axes=(None, None, 0, 0, None, None))
        after = step(weights, setup.context, samples, nus, target, last)
        return (costs + after.cost, after.sample), (
            after.control,
            after.perturbation,
            after.state,
        )

    (costs, _), trajectories = jax.lax.scan(
        body, (jnp.zeros(count), start), (plans, setup.targets, final_step)
    )
    return Rollouts(costs, *trajectories)


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

    def join(leaf: Array) -> Array:
        """Join the chunks along the sample axis, the second to last."""
        return jnp.moveaxis(leaf, 0, -3).reshape(*leaf.shape[1:-2], -1, leaf.shape[-1])[
            ..., :count, :
        ]

    costs = join(rollouts.costs[..., None])[..., 0]
    return Rollouts(costs, *(join(leaf) for leaf in rollouts[1:]))
