"""Projected gradient descent through the rollout of any task."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax.control.planners._planner import planner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Plan,
    PlannerState,
    Plans,
    Samples,
    SearchResult,
    replace_nonfinite,
)
from sfkd_jax.control.tasks._task import Task
from sfkd_jax.ranges import AtLeastTwo, Fraction
from sfkd_jax.types import Controller, Key, Scalar


def gradient_planner(
    task: Task,
    *,
    horizon: AtLeastTwo = 20,
    iterations: int = 5,
    steps: AtLeastTwo = 8,
    shrink: Fraction = 0.4,
    info_level: str = "plan",
    **options: Any,
) -> Controller:
    """Return the controller that descends the gradient of the rollout's cost.

        d = −Σ ∇_ν J(ν),   ν ← the best of ν + s_i σ d / |d|_σ,   s_i ∈ {0, 1, c, c², …}

    Perturbations are measured in units of noise_std (Σ = diag(σ²)), so a step of 1
    moves a control by about σ. All candidates of a line search are rolled out as one
    batch; s = 0 is one of them, so the cost never increases. The perturbations that
    the limits allowed are kept, which projects the plan onto the limits. Proposals in
    the state compete at the first iteration.

    Nothing is random, and the key is not used. Derivatives that are not finite count
    as zero.

    Args:
        task: the planning problem; must be differentiable.
        horizon: T, number of steps.
        iterations: of gradient and line search per control step.
        steps: candidates of a line search.
        shrink: c in (0, 1).
        info_level: see `planner`; the samples are those of the last line search.
        options: of `planner`; noise_std is the unit of a step.

    Raises:
        ValueError: a setting is out of its range.
    """
    if iterations < 1 or steps < 2 or not 0 < shrink < 1:
        raise ValueError(
            "iterations >= 1, steps >= 2, 0 < shrink < 1, "
            f"got {iterations}, {steps}, {shrink}"
        )
    sizes = jnp.concatenate([jnp.zeros(1), shrink ** jnp.arange(steps - 1.0)])

    def search(key: Key, state: PlannerState, evaluate: Evaluate) -> SearchResult:
        del key
        std = state.tuning.noise_std

        def cost_of(plan: Plan) -> Scalar:
            return evaluate(plan[:, None]).costs[0]

        def descend(plan: Plan, _: None) -> tuple[Plan, SearchResult]:
            slope = replace_nonfinite(jax.grad(cost_of)(plan), 0.0)
            downhill = -slope * std[None]  # in units of std
            size = jnp.sqrt(jnp.mean(downhill**2))
            direction = downhill / jnp.where(size > 0, size, 1.0) * std[None]
            return best_of(plan[:, None] + sizes[None, :, None] * direction[:, None])

        def best_of(plans: Plans) -> tuple[Plan, SearchResult]:
            evaluated = evaluate(plans)
            effective, costs = evaluated.perturbations, evaluated.costs
            costs = replace_nonfinite(costs, jnp.inf)
            best = jnp.argmin(costs)
            plan, lowest = replace_nonfinite(effective[:, best], 0.0), costs[best]
            usable = jnp.isfinite(lowest)
            samples = None
            if info_level == "samples":
                chosen = (jnp.arange(costs.shape[0]) == best).astype(costs.dtype)
                samples = Samples(evaluated, chosen)
            return plan, SearchResult(plan, usable, lowest, jnp.ones(()), samples)

        plan = state.plan
        if state.proposals.shape[0]:
            proposals = state.proposals.swapaxes(0, 1)
            plan, _ = best_of(jnp.concatenate([plan[:, None], proposals], axis=1))
        _, results = jax.lax.scan(descend, plan, None, length=iterations)
        return jax.tree.map(lambda leaf: leaf[-1], results)

    return planner(task, search, horizon=horizon, info_level=info_level, **options)
