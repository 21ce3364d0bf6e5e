"""The cross-entropy method: a normal distribution is fitted to the best samples."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from sfkd_jax.control._factory import factory
from sfkd_jax.control._finite import replace_nonfinite
from sfkd_jax.control.planners._planner import Evaluate, SearchResult, Tuning, iterate
from sfkd_jax.control.planners._rollouts import Plan
from sfkd_jax.control.planners._sampling import SamplingPlanner
from sfkd_jax.types import Key


@dataclass(frozen=True, eq=False, kw_only=True)
class Cem(SamplingPlanner):
    """The cross-entropy method.

        ν ← mean of the elites,   σ_k ← max(their standard deviation at step k, σ_min)

    Each iteration samples plans, keeps the elites (the samples of the lowest costs) and
    fits a mean and a standard deviation to them. A rollout that is not finite is never
    an elite. Every control step starts with σ = noise_std.

    Attributes:
        elites: number of samples that are kept.
        smallest_scale: σ_min relative to noise_std.

    Source: Rubinstein (1999); correlated noise as in Pinneri et al. (2020), iCEM.
    """

    num_samples: int = 500
    iterations: int = 3
    elites: int = 50
    smallest_scale: float = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.elites <= self.num_samples:
            raise ValueError(
                "elites must lie in [1, num_samples], "
                f"got {self.elites} of {self.num_samples}"
            )

    def search(
        self, key: Key, plan: Plan, tuning: Tuning, evaluate: Evaluate
    ) -> SearchResult:
        """Return the mean of the elites of the last iteration."""

        def improve(
            carry: tuple[Plan, Plan], key: Key
        ) -> tuple[tuple[Plan, Plan], SearchResult]:
            plan, scale = carry
            # With every iteration the noise of each step and control is narrower.
            noise = self.draw(key, tuning.noise_std) * scale[:, None]
            # Sample 0 is the mean itself, so the best cost never increases.
            evaluated = evaluate(plan[:, None] + noise.at[:, 0].set(0.0))
            ranks, _ = evaluated.ranked()
            negated, chosen = jax.lax.top_k(-ranks, self.elites)
            # If fewer rollouts than elites are finite, only those count.
            counts = jnp.isfinite(negated).astype(float)
            size = jnp.sum(counts)
            weights = counts / jnp.maximum(size, 1.0)
            elite = replace_nonfinite(evaluated.perturbations, 0.0)[:, chosen]
            mean = jnp.einsum("m,tmc->tc", weights, elite)
            squares = (elite - mean[:, None]) ** 2
            spread = jnp.sqrt(jnp.einsum("m,tmc->tc", weights, squares))
            result = SearchResult(
                plan=mean,
                usable=size > 0,
                cost=-negated[0],
                effective_samples=size,
                best=elite[:, 0],
            )
            # A spread of zero could never grow again.
            scale = jnp.maximum(spread / tuning.noise_std, self.smallest_scale)
            return (mean, scale), result

        return iterate(improve, (plan, jnp.ones_like(plan)), key, self.iterations)


cem = factory(Cem, Cem.controller)
"""(task, settings of `Cem`) -> `Controller`."""
