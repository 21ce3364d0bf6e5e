"""Model predictive path integral control of any task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._factory import factory
from sfkd_jax.control.planners._noise import SamplingPlanner
from sfkd_jax.control.planners._planner import (
    Evaluate,
    Plan,
    PlannerState,
    Plans,
    SearchResult,
    Tuning,
    iterate,
    replace_nonfinite,
    tuned,
)
from sfkd_jax.ranges import Positive
from sfkd_jax.types import Key, Scalar

BISECTIONS, DECADES = 24, (-12.0, 4.0)
"""The temperature is searched between 10^-12 and 10^4 times the range of the costs. The
lower end is that small because a single outlier widens the range.
"""
FEW = 10.0
"""Effective samples where every sample violates a constraint."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mppi(SamplingPlanner):
    """Information-theoretic MPPI.

        ν ← Σ_m w_m ν^m,   w_m ∝ exp(−J^m / λ)

    Each iteration samples M plans around the current one and rolls all of them out in
    one scan. ν^m is the perturbation that the limits allowed. A rollout that is not
    finite has weight zero.

    Attributes:
        temperature: λ, in units of cost; initial value in `Tuning`.
        effective_samples: if not 0, λ is chosen at every iteration such that 1 / Σ w²
            has this value; 0 keeps λ at `temperature`. Both are data, see `Tuning`.
        shrinkage: whether the mean moves away from the plan only as far as its variance
            lets it, see `shrunk`: few samples then do no harm.

    Source: Williams et al. (2018), Information-Theoretic MPC, T-RO 34(6).
    """

    temperature: Positive = 5.0
    effective_samples: float = 0.0
    shrinkage: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        size, most = self.effective_samples, self.num_samples
        if size and not 1 <= size <= most:
            raise ValueError(
                f"effective_samples must be 0 or lie in [1, {most}], got {size}"
            )

    def init(self, key: Key) -> PlannerState:
        """Return the state before the first step, with λ in its tuning."""
        return tuned(
            super().init(key),
            temperature=self.temperature,
            effective_samples=self.effective_samples,
        )

    def search(
        self, key: Key, plan: Plan, tuning: Tuning, evaluate: Evaluate
    ) -> SearchResult:
        """Return the weighted mean of the sampled plans."""

        def improve(plan: Plan, key: Key) -> tuple[Plan, SearchResult]:
            noise = self.draw(key, tuning.noise_std)
            # Sample 0 is the plan itself: what was good stays among the candidates.
            plans = plan[:, None] + noise.at[:, 0].set(0.0)
            if self.shrinkage:
                # Sample 1 is the law alone; of one sample there is none.
                plans = plans.at[:, 1].set(0.0, mode="drop")
            evaluated = evaluate(plans)
            ranks, any_kept = evaluated.ranked()
            temperature = tuning.temperature
            if self.effective_samples:
                # On the cost scale of this step: robust where costs vary by decades.
                temperature = temperature_for(ranks, tuning.effective_samples)
            if evaluated.violations is not None:
                # Violations are in other units than costs: where no sample keeps all
                # constraints, average the least violated ones, sharply.
                few = temperature_for(ranks, jnp.asarray(FEW))
                temperature = jnp.where(any_kept, temperature, few)
            weights, usable = softmin(ranks, temperature)
            # Average what the limits allowed, not what was sampled.
            allowed = replace_nonfinite(evaluated.perturbations, 0.0)
            mean = jnp.einsum("m,tmc->tc", weights, allowed)
            if self.shrinkage:
                # The noise of earlier steps ends where the law alone is as good.
                best = jnp.where(ranks[1] <= ranks[0], allowed[:, 1], allowed[:, 0])
                mean = shrunk(mean, best, weights, allowed)
            return mean, SearchResult(
                plan=mean,
                usable=usable,
                cost=jnp.min(replace_nonfinite(evaluated.costs, jnp.inf)),
                effective_samples=effective_sample_size(weights),
                best=allowed[:, jnp.argmin(ranks)],
            )

        return iterate(improve, plan, key, self.iterations)


mppi = factory(Mppi, Mppi.controller)
"""(task, settings of `Mppi`) -> `Controller`."""


def softmin(
    costs: Float[Array, " sample"], temperature: Scalar
) -> tuple[Float[Array, " sample"], Bool[Array, ""]]:
    """Return weights ∝ exp(−J/λ) over the finite costs, and whether they are usable.

    They are not if no cost is finite, or λ is not positive.
    """
    finite = jnp.isfinite(costs)
    positive = temperature > 0
    usable = jnp.any(finite) & positive
    # Both branches are finite, or their derivatives would be NaN.
    scaled = jnp.where(finite, costs, 0.0) / jnp.where(positive, temperature, 1.0)
    scores = jnp.where(usable, jnp.where(finite, -scaled, -jnp.inf), 0.0)
    return jax.nn.softmax(scores), usable


def shrunk(
    mean: Plan,
    plan: Plan,
    weights: Float[Array, " sample"],
    samples: Plans,
) -> Plan:
    """Return a weighted mean, shrunk towards a plan by the James–Stein rule.

        ν + max(0, 1 − Σ_t s_t² / Σ_t |ν̄_t − ν_t|²) (ν̄ − ν),   s² = Σ_m w_m² (ν^m − ν̄)²

    for each control, with the positive part alone; s² estimates the variance of ν̄.
    """
    squares = (samples - mean[:, None]) ** 2
    variance = jnp.sum(jnp.einsum("m,tmc->tc", weights**2, squares), axis=0)
    moved = mean - plan
    # Away from 0: without a move there is nothing to shrink.
    share = 1.0 - variance / (jnp.sum(moved**2, axis=0) + 1e-12)
    return plan + jnp.maximum(share, 0.0) * moved


def effective_sample_size(weights: Float[Array, " sample"]) -> Scalar:
    """Return Kish's 1 / Σ w²: M for M equal weights, 1 if one sample has all weight."""
    return 1.0 / jnp.sum(weights**2)


def temperature_for(costs: Float[Array, " sample"], wanted: Scalar) -> Scalar:
    """Return λ at which `effective_sample_size` is `wanted`, by bisection of log λ.

    The bracket scales with the range of the finite costs, so λ scales with the costs.
    If no λ gives `wanted`, the result is an end of it. Derivatives take λ as constant.
    """
    costs = jax.lax.stop_gradient(costs)
    finite = jnp.isfinite(costs)
    lowest = jnp.min(jnp.where(finite, costs, jnp.inf))
    spread = jnp.max(jnp.where(finite, costs, -jnp.inf)) - lowest
    # All costs equal, or none finite: any positive scale will do.
    spread = jnp.where(jnp.isfinite(spread) & (spread > 0), spread, 1.0)
    # In [0, 1], whatever the units of cost.
    scaled = jnp.where(finite, (costs - lowest) / spread, jnp.inf)

    def narrow(_: Any, bracket: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bracket
        middle = 0.5 * (low + high)
        few = effective_sample_size(softmin(scaled, jnp.exp(middle))[0]) < wanted
        return jnp.where(few, middle, low), jnp.where(few, high, middle)

    # A fixed number of steps has a fixed cost, and compiles to a loop.
    ends = jnp.log(10.0) * jnp.asarray(DECADES)
    low, high = jax.lax.fori_loop(0, BISECTIONS, narrow, (ends[0], ends[1]))
    return spread * jnp.exp(0.5 * (low + high))
