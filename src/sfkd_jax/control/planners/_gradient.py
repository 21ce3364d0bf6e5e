"""Projected gradient descent through the rollout of any task."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from sfkd_jax.control._factory import factory
from sfkd_jax.control._finite import replace_nonfinite
from sfkd_jax.control.planners._planner import (
    Evaluate,
    Planner,
    SearchResult,
    Tuning,
    iterate,
)
from sfkd_jax.control.planners._rollouts import Plan
from sfkd_jax.ranges import AtLeastOne, AtLeastTwo, Fraction
from sfkd_jax.types import Key, Scalar


@dataclass(frozen=True, eq=False, kw_only=True)
class GradientPlanner(Planner):
    """Descent along the gradient of the rollout's cost.

        d = −Σ ∇_ν J(ν),   ν ← the best of ν + s_i σ d / |d|_σ,   s_i ∈ {0, 1, c, c², …}

    Perturbations are measured in units of noise_std (Σ = diag(σ²)), so a step of 1
    moves a control by about σ. All candidates of a line search are rolled out as one
    batch. The plan itself (s = 0) and the law alone (ν = 0) are among them, so the cost
    never increases, and is never above that of the law. The perturbations that the
    limits allowed replace the plan, which projects it onto the limits.

    Nothing is random, and the key is not used. Derivatives that are not finite count
    as zero. The task must be differentiable.

    Attributes:
        iterations: number of gradients, each with a line search, per control step.
        steps: number of candidates of a line search.
        shrink: c in (0, 1).
    """

    iterations: AtLeastOne = 5
    steps: AtLeastTwo = 8
    shrink: Fraction = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.task.constraint is not None:
            raise ValueError("constraints need mppi or cem, which rank by them")

    def search(
        self, key: Key, plan: Plan, tuning: Tuning, evaluate: Evaluate
    ) -> SearchResult:
        """Return the plan at the end of the descent."""
        std = tuning.noise_std
        sizes = jnp.append(jnp.zeros(1), self.shrink ** jnp.arange(self.steps - 1.0))

        def cost_of(plan: Plan) -> Scalar:
            return evaluate(plan[:, None]).costs[0]

        def descend(plan: Plan, _: Key) -> tuple[Plan, SearchResult]:
            slope = replace_nonfinite(jax.grad(cost_of)(plan), 0.0)
            downhill = -slope * std[None]  # in units of std
            size = jnp.sqrt(jnp.mean(downhill**2))
            # The direction has size 1, so a step length means the same for every cost.
            direction = downhill / jnp.where(size > 0, size, 1.0) * std[None]
            ahead = plan[:, None] + sizes[None, :, None] * direction[:, None]
            # The law alone is a candidate too: after a switch of e it may be better
            # than the plan of the step before.
            law_alone = jnp.zeros_like(ahead[:, :1])
            evaluated = evaluate(jnp.append(ahead, law_alone, axis=1))
            costs, _ = evaluated.ranked()
            best = jnp.argmin(costs)
            plan = replace_nonfinite(evaluated.perturbations[:, best], 0.0)
            return plan, SearchResult(
                plan=plan,
                usable=jnp.isfinite(costs[best]),
                cost=costs[best],
                effective_samples=jnp.ones(()),
            )

        return iterate(descend, plan, key, self.iterations)


gradient_planner = factory(GradientPlanner, GradientPlanner.controller)
"""(task, settings of `GradientPlanner`) -> `Controller`."""
