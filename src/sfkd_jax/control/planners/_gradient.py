"""Projected gradient descent through the rollout of any task."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax.control.planners._planner import planner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Found,
    PlannerState,
    finite_or_dear,
    finite_or_zero,
)
from sfkd_jax.control.tasks._task import Task
from sfkd_jax.types import Controller, Key, Scalar


def gradient_planner(
    task: Task,
    *,
    horizon: int = 20,
    iterations: int = 5,
    steps: int = 8,
    shrink: float = 0.4,
    **options: Any,
) -> Controller:
    """Descend along the gradient of the rollout's cost, with a line search that never goes up.

        d = −Σ ∇_ν J(ν),   ν ← the best of ν + s_i σ d / |d|_σ,   s_i ∈ {0, 1, c, c², …}

    Perturbations are measured in units of noise_std (Σ = diag(σ²)), so a step of 1
    moves a control by about its σ. All candidates of a line search are rolled out as
    one batch. What is kept is what was effective within the limits, which is the
    projection onto them. Proposals in the state compete at the first iteration.

    Nothing is random; the key is not used. Derivatives that are not finite count as
    zero.

    Args:
        task: what is planned; differentiable.
        horizon: T.
        iterations: of gradient and line search per control step.
        steps: candidates of a line search.
        shrink: c in (0, 1).
        options: of `planner`; noise_std is the unit of a step.

    Raises:
        ValueError: settings that cannot be meant.
    """
    if iterations < 1 or steps < 2 or not 0 < shrink < 1:
        raise ValueError(
            f"iterations >= 1, steps >= 2, 0 < shrink < 1, got {iterations}, {steps}, {shrink}"
        )
    sizes = jnp.concatenate([jnp.zeros(1), shrink ** jnp.arange(steps - 1.0)])

    def search(key: Key, state: PlannerState, evaluate: Evaluate) -> Found:
        del key
        std = state.tuning.noise_std

        def cost_of(plan: Array) -> Scalar:
            return evaluate(plan[:, None])[0][0]

        def descend(plan: Array, nothing: None) -> tuple[Array, Found]:
            downhill = -finite_or_zero(jax.grad(cost_of)(plan)) * std  # in units of std
            size = jnp.sqrt(jnp.mean(downhill**2))
            direction = downhill / jnp.where(size > 0, size, 1.0) * std
            return choose(plan[:, None] + sizes[:, None] * direction[:, None])

        def choose(plans: Array) -> tuple[Array, Found]:
            costs, effective = evaluate(plans)
            ranked = finite_or_dear(costs)
            best = jnp.argmin(ranked)
            plan = finite_or_zero(effective[:, best])
            return plan, Found(
                plan, jnp.isfinite(ranked[best]), ranked[best], jnp.ones(())
            )

        plan = state.plan
        if state.proposals.shape[0]:
            plan, _ = choose(
                jnp.concatenate([plan[:, None], state.proposals.swapaxes(0, 1)], axis=1)
            )
        _, founds = jax.lax.scan(descend, plan, None, length=iterations)
        return jax.tree.map(lambda leaf: leaf[-1], founds)

    return planner(task, search, horizon=horizon, **options)
