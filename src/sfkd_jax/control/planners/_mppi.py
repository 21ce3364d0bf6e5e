"""Model predictive path integral control of any task."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp

from sfkd_jax.control._factory import factory
from sfkd_jax.control.planners._noise import NoiseSampler, noise_sampler
from sfkd_jax.control.planners._planner import Planner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Plan,
    PlannerState,
    SearchResult,
    candidate_plans,
    replace_nonfinite,
    tuned,
)
from sfkd_jax.control.planners._weights import weigh
from sfkd_jax.ranges import AtLeastTwo, Positive, UnitInterval
from sfkd_jax.types import Key


@dataclass(frozen=True, eq=False, kw_only=True)
class SamplingPlanner(Planner):
    """A planner that perturbs a plan at random.

    Attributes:
        num_samples: M, plans that are sampled and rolled out per iteration.
        iterations: of sampling and choosing per control step.
        noise: "ar1", "white", "coloured", "rbf" or "spline", see `noise_sampler`.
        noise_correlation: ρ of "ar1".
        noise_exponent: of "coloured" noise, power ∝ 1 / f^exponent.
        noise_knots: number of knots of "rbf" and "spline".
    """

    num_samples: int = 1500
    iterations: int = 1
    noise: str = "ar1"
    noise_correlation: UnitInterval = 0.8
    noise_exponent: float = 2.0
    noise_knots: AtLeastTwo = 5

    def __post_init__(self) -> None:
        """Raise a ValueError that names a setting out of its range."""
        super().__post_init__()
        if self.num_samples < 1 or self.iterations < 1:
            raise ValueError(
                "num_samples and iterations must be at least 1, "
                f"got {self.num_samples} and {self.iterations}"
            )
        _ = self.draw  # raises for settings out of range

    @cached_property
    def draw(self) -> NoiseSampler:
        """(key, number of samples, standard deviation) -> perturbations."""
        return noise_sampler(
            self.noise,
            horizon=self.horizon,
            correlation=self.noise_correlation,
            exponent=self.noise_exponent,
            knots=self.noise_knots,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Mppi(SamplingPlanner):
    """Information-theoretic MPPI.

        ν ← Σ_m w_m ν^m,   w_m ∝ exp(−J^m / λ)

    Each iteration samples M plans around the current one and rolls all of them out in
    one scan. ν^m is the perturbation that the limits allowed. Sample 0 is the shifted
    plan itself; proposals in the planner's state are added to the samples. A rollout
    that is not finite has weight zero.

    Attributes:
        temperature: λ, in units of cost; initial value in `Tuning`.
        effective_samples: if not 0, λ is chosen at every iteration such that 1 / Σ w²
            has this value; 0 keeps λ at `temperature`. Both are data, see `Tuning`.

    Source: Williams et al. (2018), Information-Theoretic Model Predictive Control, T-RO
    34(6).
    """

    temperature: Positive = 5.0
    effective_samples: float = 0.0

    def __post_init__(self) -> None:
        """Raise a ValueError that names a setting out of its range."""
        super().__post_init__()
        if not self.temperature > 0:
            raise ValueError(f"temperature must be positive, got {self.temperature}")
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

    def search(self, key: Key, state: PlannerState, evaluate: Evaluate) -> SearchResult:
        """Return the weighted mean of the sampled plans."""

        def improve(plan: Plan, key: Key) -> tuple[Plan, SearchResult]:
            # Sample around the plan; sample 0 is the plan itself, so it can win.
            noise = self.draw(key, self.num_samples, state.tuning.noise_std)
            evaluated = evaluate(candidate_plans(plan, noise, state))
            # Weigh by cost. λ follows from the effective sample size, if one is set.
            solve = self.effective_samples != 0.0
            costs, violations = evaluated.costs, evaluated.violations
            chosen = weigh(costs, violations, state.tuning, solve=solve)
            # Average what the limits allowed, not what was sampled.
            allowed = replace_nonfinite(evaluated.perturbations, 0.0)
            mean = jnp.einsum("m,tmc->tc", chosen.weights, allowed)
            return mean, SearchResult(
                plan=mean,
                usable=chosen.usable,
                cost=jnp.min(replace_nonfinite(costs, jnp.inf)),
                effective_samples=chosen.size,
                samples=self._reported(evaluated, chosen.weights, chosen.temperature),
                best=None
                if violations is None
                else evaluated.perturbations[:, chosen.best],
            )

        # Splitting the key would change the plans of a single iteration.
        if self.iterations == 1:
            return improve(state.plan, key)[1]
        keys = jax.random.split(key, self.iterations)
        _, results = jax.lax.scan(improve, state.plan, keys)
        return jax.tree.map(lambda leaf: leaf[-1], results)


mppi = factory(Mppi, Mppi.controller)
"""(task, settings of `Mppi`) -> `Controller`."""
