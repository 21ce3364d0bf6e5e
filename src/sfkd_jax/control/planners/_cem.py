"""The cross-entropy method for any task."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from sfkd_jax.control._factory import factory
from sfkd_jax.control.planners._mppi import SamplingPlanner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Plan,
    PlannerState,
    SearchResult,
    candidate_plans,
    replace_nonfinite,
)
from sfkd_jax.control.planners._weights import keep_constraints
from sfkd_jax.types import Key


@dataclass(frozen=True, eq=False, kw_only=True)
class Cem(SamplingPlanner):
    """The cross-entropy method.

        ν ← mean of the elites,   σ_k ← max(their standard deviation at step k, σ_min)

    Each iteration samples plans, keeps the elites and fits mean and standard deviation
    to them. Sample 0 is the current mean, so the best cost never increases between
    iterations. A rollout that is not finite is never an elite.

    Attributes:
        elites: number of samples kept.
        smallest_scale: σ_min relative to noise_std; σ is reset to noise_std at every
            control step.

    Source: Rubinstein (1999); correlated noise as in Pinneri et al. (2020), iCEM.
    """

    num_samples: int = 500
    iterations: int = 3
    elites: int = 50
    smallest_scale: float = 0.05

    def __post_init__(self) -> None:
        """Raise a ValueError that names a setting out of its range."""
        super().__post_init__()
        if not 1 <= self.elites <= self.num_samples:
            raise ValueError(
                "elites must lie in [1, num_samples], "
                f"got {self.elites} of {self.num_samples}"
            )

    def search(self, key: Key, state: PlannerState, evaluate: Evaluate) -> SearchResult:
        """Return the mean of the elites of the last iteration."""
        std = state.tuning.noise_std

        def improve(
            carry: tuple[Plan, Plan], key: Key
        ) -> tuple[tuple[Plan, Plan], SearchResult]:
            plan, scale = carry
            # Narrower with every iteration, per step and control.
            noise = self.draw(key, self.num_samples, std) * scale[:, None]
            evaluated = evaluate(candidate_plans(plan, noise, state))
            costs, best = replace_nonfinite(evaluated.costs, jnp.inf), None
            if evaluated.violations is not None:
                costs, _ = keep_constraints(costs, evaluated.violations)
                best = evaluated.perturbations[:, jnp.argmin(costs)]
            negated, chosen = jax.lax.top_k(-costs, self.elites)
            # Fewer finite rollouts than elites: only those count.
            counts = jnp.isfinite(negated).astype(float)
            size = jnp.sum(counts)
            weights = counts / jnp.maximum(size, 1.0)
            elite = replace_nonfinite(evaluated.perturbations, 0.0)[:, chosen]
            mean = jnp.einsum("m,tmc->tc", weights, elite)
            squares = (elite - mean[:, None]) ** 2
            spread = jnp.sqrt(jnp.einsum("m,tmc->tc", weights, squares))
            kept = jnp.zeros_like(costs).at[chosen].set(weights)
            result = SearchResult(
                plan=mean,
                usable=size > 0,
                cost=-negated[0],
                effective_samples=size,
                samples=self._reported(evaluated, kept),
                best=best,
            )
            # A spread of zero could never grow again.
            scale = jnp.maximum(spread / std[None], self.smallest_scale)
            return (mean, scale), result

        start = (state.plan, jnp.ones_like(state.plan))
        keys = jax.random.split(key, self.iterations)
        _, results = jax.lax.scan(improve, start, keys)
        return jax.tree.map(lambda leaf: leaf[-1], results)


cem = factory(Cem, Cem.controller)
"""(task, settings of `Cem`) -> `Controller`."""
