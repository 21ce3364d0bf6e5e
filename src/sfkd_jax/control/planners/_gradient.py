"""Projected gradient descent through the rollout of any task."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from sfkd_jax.control._factory import factory
from sfkd_jax.control.planners._planner import Planner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Plan,
    PlannerState,
    Plans,
    SearchResult,
    replace_nonfinite,
)
from sfkd_jax.ranges import AtLeastTwo, Fraction
from sfkd_jax.types import Key, Scalar


@dataclass(frozen=True, eq=False, kw_only=True)
class GradientPlanner(Planner):
    """Descent along the gradient of the rollout's cost.

        d = −Σ ∇_ν J(ν),   ν ← the best of ν + s_i σ d / |d|_σ,   s_i ∈ {0, 1, c, c², …}

    Perturbations are measured in units of noise_std (Σ = diag(σ²)), so a step of 1
    moves a control by about σ. All candidates of a line search are rolled out as one
    batch; s = 0 is one of them, so the cost never increases. The perturbations that
    the limits allowed are kept, which projects the plan onto the limits. Proposals in
    the state compete at the first iteration.

    Nothing is random, and the key is not used. Derivatives that are not finite count
    as zero. The task must be differentiable.

    Attributes:
        iterations: of gradient and line search per control step.
        steps: candidates of a line search.
        shrink: c in (0, 1).
    """

    iterations: int = 5
    steps: AtLeastTwo = 8
    shrink: Fraction = 0.4

    def __post_init__(self) -> None:
        """Raise a ValueError that names a setting out of its range."""
        super().__post_init__()
        if self.iterations < 1 or self.steps < 2 or not 0 < self.shrink < 1:
            raise ValueError(
                "iterations >= 1, steps >= 2, 0 < shrink < 1, "
                f"got {self.iterations}, {self.steps}, {self.shrink}"
            )

    def search(self, key: Key, state: PlannerState, evaluate: Evaluate) -> SearchResult:
        """Return the plan at the end of the descent."""
        del key
        std = state.tuning.noise_std
        powers = self.shrink ** jnp.arange(self.steps - 1.0)
        sizes = jnp.concatenate([jnp.zeros(1), powers])

        def best_of(plans: Plans) -> tuple[Plan, SearchResult]:
            evaluated = evaluate(plans)
            costs = replace_nonfinite(evaluated.costs, jnp.inf)
            best = jnp.argmin(costs)
            plan = replace_nonfinite(evaluated.perturbations[:, best], 0.0)
            chosen = (jnp.arange(costs.shape[0]) == best).astype(costs.dtype)
            return plan, SearchResult(
                plan=plan,
                usable=jnp.isfinite(costs[best]),
                cost=costs[best],
                effective_samples=jnp.ones(()),
                samples=self._reported(evaluated, chosen),
            )

        def descend(plan: Plan, _: None) -> tuple[Plan, SearchResult]:
            def cost_of(plan: Plan) -> Scalar:
                return evaluate(plan[:, None]).costs[0]

            slope = replace_nonfinite(jax.grad(cost_of)(plan), 0.0)
            downhill = -slope * std[None]  # in units of std
            size = jnp.sqrt(jnp.mean(downhill**2))
            # Of unit size, so that a step length means the same for every cost.
            direction = downhill / jnp.where(size > 0, size, 1.0) * std[None]
            return best_of(plan[:, None] + sizes[None, :, None] * direction[:, None])

        plan = state.plan
        if state.proposals.shape[0]:
            # They may lie in another valley: compare before descending.
            proposals = state.proposals.swapaxes(0, 1)
            plan, _ = best_of(jnp.concatenate([plan[:, None], proposals], axis=1))
        _, results = jax.lax.scan(descend, plan, None, length=self.iterations)
        return jax.tree.map(lambda leaf: leaf[-1], results)


gradient_planner = factory(GradientPlanner, GradientPlanner.controller)
"""(task, settings of `GradientPlanner`) -> `Controller`."""
