"""Rollouts of many plans, in one environment or as a risk over several."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._plans import Evaluated, Plans, Tuning
from sfkd_jax.control.tasks._task import RolloutSetup, StepIndex, Task
from sfkd_jax.types import Scalar

RiskMeasure: TypeAlias = Callable[
    [Float[Array, "particle sample"]], Float[Array, " sample"]
]


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Rolls out plans from what a task evaluated once in a control step.

    Attributes:
        task: the planning problem.
        tuning: weights of its cost, data of its constraints.
        setup: of this control step; with a risk, every leaf has a leading axis of
            environments.
        risk: reduces the costs over several environments; None for one environment.
        unroll: number of steps that are compiled as one.
        sharding: of the samples over devices, or None.
    """

    task: Task
    tuning: Tuning
    setup: RolloutSetup
    risk: RiskMeasure | None = None
    unroll: int = 2
    sharding: jax.sharding.Sharding | None = None

    def __call__(self, plans: Plans) -> Evaluated:
        """Return costs, controls and predicted states of plans."""
        # A single plan cannot be split over devices.
        if self.sharding is not None and plans.shape[1] > 1:
            plans = jax.lax.with_sharding_constraint(plans, self.sharding)
        roll_out = partial(_roll_out, self.task, self.tuning, self.unroll)
        if self.risk is None:
            return roll_out(self.setup, plans)
        each = jax.vmap(roll_out, in_axes=(0, None))(self.setup, plans)
        # One of them is shown; the environments are exchangeable.
        controls, states = jax.tree.map(
            lambda leaf: leaf[0], (each.controls, each.states)
        )
        return Evaluated(
            costs=self.risk(each.costs),
            controls=controls,
            perturbations=jnp.mean(each.perturbations, axis=0),
            states=states,
            # The worst of the environments: a constraint must hold in all of them.
            violations=None
            if each.violations is None
            else jnp.max(each.violations, axis=0),
        )


def _roll_out(
    task: Task, tuning: Tuning, unroll: int, setup: RolloutSetup, plans: Plans
) -> Evaluated:
    """Roll out all plans in one environment, in one scan over the horizon."""
    horizon, count = plans.shape[:2]
    numbers = jnp.arange(horizon)
    places = StepIndex(numbers, (numbers == horizon - 1).astype(plans.dtype))
    inputs = (plans, setup.targets, places)
    step = jax.vmap(
        partial(task.step, tuning.cost, setup.context), in_axes=(0, 0, None, None)
    )
    violate = jax.vmap(partial(_violation, task, tuning), in_axes=(0, 0, None, None))

    def body(carry: Any, inputs: Any) -> Any:
        costs, samples, worst = carry
        after = step(samples, *inputs)
        if worst is not None:
            now = violate(after.state, after.control, *inputs[1:])
            worst = jnp.maximum(worst, now)
        along = after.control, after.perturbation, after.state
        return (costs + after.cost, after.sample, worst), along

    none = jnp.zeros(count, plans.dtype)
    start = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), setup.start
    )
    carry = (none, start, None if task.constraint is None else none)
    first = jax.tree.map(lambda leaf: leaf[0], inputs)
    # lax.scan wants a carry whose types do not change.
    carry = _as_returned(lambda carry: body(carry, first)[0], carry)
    # A single plan gains nothing from unrolling.
    (costs, _, worst), (controls, perturbations, states) = jax.lax.scan(
        body, carry, inputs, unroll=unroll if count > 1 else 1
    )
    return Evaluated(costs, controls, perturbations, states, worst)


def _violation(
    task: Task, tuning: Tuning, state: Any, control: Array, target: Any, at: StepIndex
) -> Scalar:
    """The largest violation of a step; infinite where it is not a number."""
    assert task.constraint is not None
    all_of_them = task.constraint(tuning.constraints, state, control, target, at)
    largest = jnp.max(all_of_them)
    # NaN compares as kept, so it must not get through.
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


RISKS = ("mean", "worst", "cvar")


def risk_measure(name: str, level: float) -> RiskMeasure:
    """Return the function that reduces the costs of whole trajectories to one per plan.

        mean_p J_p,   max_p J_p,   CVaR = mean of the ⌈level · P⌉ largest J_p

    The measure applies to whole trajectories, so one environment is the worst case
    over the entire horizon.

    Args:
        name: "mean", "worst" or "cvar".
        level: fraction of the largest costs that CVaR averages, in (0, 1].

    Raises:
        ValueError: the name is unknown, or the level is outside (0, 1].
    """
    if name not in RISKS:
        raise ValueError(f"risk must be one of {', '.join(RISKS)}, got {name!r}")
    if not 0 < level <= 1:
        raise ValueError(f"risk_level must lie in (0, 1], got {level}")

    def cvar(costs: Float[Array, "particle sample"]) -> Float[Array, " sample"]:
        count = math.ceil(level * costs.shape[0])
        return jnp.mean(jax.lax.top_k(costs.T, count)[0], axis=1)

    return {
        "mean": lambda costs: jnp.mean(costs, axis=0),
        "worst": lambda costs: jnp.max(costs, axis=0),
        "cvar": cvar,
    }[name]
