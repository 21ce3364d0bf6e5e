"""Model predictive path integral control (MPPI): a weighted mean of sampled plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._factory import factory
from sfkd_jax.control._finite import replace_nonfinite
from sfkd_jax.control.planners._planner import (
    Evaluate,
    PlannerState,
    SearchResult,
    Tuning,
    iterate,
    tuned,
)
from sfkd_jax.control.planners._rollouts import Plan, Plans
from sfkd_jax.control.planners._sampling import SamplingPlanner
from sfkd_jax.ranges import NonNegativeInt, Positive
from sfkd_jax.types import Key, Scalar

BISECTIONS = 24
"""Steps of the search for a temperature."""
DECADES = (-12.0, 4.0)
"""The temperature is searched between 10^-12 and 10^4 times the range of the costs. The
lower end is that small because a single outlier widens the range.
"""
FEW_SAMPLES = 10.0
"""Effective samples where every sample violates a constraint."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mppi(SamplingPlanner):
    """Information-theoretic MPPI.

        ν ← Σ_m w_m ν^m,   w_m ∝ exp(−J^m / λ)

    Each iteration samples M plans around the current one and rolls all of them out in
    one scan. ν^m is the perturbation that the limits allowed. A rollout that is not
    finite has weight zero.

    Attributes:
        temperature: λ, in units of cost. It is the initial value of the entry in
            `Tuning`.
        effective_samples: if it is not 0, λ is chosen in every iteration such that
            1 / Σ w² has this value; 0 keeps λ at `temperature`. It is the initial value
            of the entry in `Tuning` as well.
        shrinkage: whether the mean moves away from the plan only as far as its variance
            allows, see `shrunk`. Then a small number of samples does no harm.
        smoothing_window: number of steps in the window of `savitzky_golay`, which
            smooths the mean; 0 for no smoothing.

    Source: Williams et al. (2018), Information-Theoretic MPC, T-RO 34(6).
    """

    temperature: Positive = 5.0
    effective_samples: float = 0.0
    shrinkage: bool = False
    smoothing_window: NonNegativeInt = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        size = self.effective_samples
        if size and not 1 <= size <= self.num_samples:
            raise ValueError(
                f"effective_samples must be 0 or lie in [1, {self.num_samples}], "
                f"got {size}"
            )
        window = self.smoothing_window
        if window and not (window % 2 == 1 and 5 <= window <= self.horizon):
            raise ValueError(
                "smoothing_window must be 0 or an odd number in "
                f"[5, {self.horizon}], got {window}"
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
            # Sample 0 is the plan itself, so a good plan stays among the candidates.
            plans = plan[:, None] + noise.at[:, 0].set(0.0)
            if self.shrinkage:
                # Sample 1 is the law alone, if there is a sample 1.
                plans = plans.at[:, 1].set(0.0, mode="drop")
            evaluated = evaluate(plans)
            ranks, any_kept = evaluated.ranked()
            temperature = self._temperature(ranks, tuning)
            if evaluated.violations is not None:
                # Where no sample keeps all constraints, the ranks are violations, which
                # have other units than costs. Only the smallest of them get a weight.
                sharp = temperature_for(ranks, jnp.asarray(FEW_SAMPLES))
                temperature = jnp.where(any_kept, temperature, sharp)
            weights, usable = softmin(ranks, temperature)
            # Average the perturbations that the limits allowed, not the samples.
            allowed = replace_nonfinite(evaluated.perturbations, 0.0)
            mean = jnp.einsum("m,tmc->tc", weights, allowed)
            if self.shrinkage:
                # The noise of earlier steps ends where the law alone is as good.
                best = jnp.where(ranks[1] <= ranks[0], allowed[:, 1], allowed[:, 0])
                mean = shrunk(mean, best, weights, allowed)
            if self.smoothing_window:
                mean = smoothed(mean, self.smoothing_window)
            return mean, SearchResult(
                plan=mean,
                usable=usable,
                cost=jnp.min(replace_nonfinite(evaluated.costs, jnp.inf)),
                effective_samples=effective_sample_size(weights),
                best=allowed[:, jnp.argmin(ranks)],
            )

        return iterate(improve, plan, key, self.iterations)

    def _temperature(self, ranks: Float[Array, " sample"], tuning: Tuning) -> Scalar:
        """Return λ; with a target of `effective_samples` it scales with the costs.

        That is robust where costs vary by orders of magnitude between steps.
        """
        if self.effective_samples:
            return temperature_for(ranks, tuning.effective_samples)
        return tuning.temperature


mppi = factory(Mppi, Mppi.controller)
"""(task, settings of `Mppi`) -> `Controller`."""


def softmin(
    costs: Float[Array, " sample"], temperature: Scalar
) -> tuple[Float[Array, " sample"], Bool[Array, ""]]:
    """Return weights ∝ exp(−J/λ) over the finite costs, and whether they are usable.

    The weights are not usable if no cost is finite, or if λ is not positive.
    """
    finite = jnp.isfinite(costs)
    positive = temperature > 0
    usable = jnp.any(finite) & positive
    # Both branches must be finite, or their derivatives would be NaN.
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

    for each control. s² estimates the variance of ν̄.
    """
    squares = (samples - mean[:, None]) ** 2
    variance = jnp.sum(jnp.einsum("m,tmc->tc", weights**2, squares), axis=0)
    moved = mean - plan
    # The small number keeps the quotient finite where the mean did not move.
    share = 1.0 - variance / (jnp.sum(moved**2, axis=0) + 1e-12)
    return plan + jnp.maximum(share, 0.0) * moved


def effective_sample_size(weights: Float[Array, " sample"]) -> Scalar:
    """Return Kish's 1 / Σ w²: M for M equal weights, 1 if one sample has all weight."""
    return 1.0 / jnp.sum(weights**2)


def temperature_for(costs: Float[Array, " sample"], target: Scalar) -> Scalar:
    """Return λ at which `effective_sample_size` is `target`, by bisection of log λ.

    The bracket scales with the range of the finite costs, so λ scales with the costs.
    If no λ gives `target`, the result is an end of the bracket. λ counts as a constant
    in derivatives.
    """
    costs = jax.lax.stop_gradient(costs)
    finite = jnp.isfinite(costs)
    lowest = jnp.min(jnp.where(finite, costs, jnp.inf))
    cost_range = jnp.max(jnp.where(finite, costs, -jnp.inf)) - lowest
    # If all costs are equal, or none is finite, any positive scale will do.
    usable = jnp.isfinite(cost_range) & (cost_range > 0)
    cost_range = jnp.where(usable, cost_range, 1.0)
    # Scaled costs lie in [0, 1], whatever the units of cost.
    scaled = jnp.where(finite, (costs - lowest) / cost_range, jnp.inf)

    def narrow(_: Any, bracket: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bracket
        middle = 0.5 * (low + high)
        weights, _ = softmin(scaled, jnp.exp(middle))
        too_few = effective_sample_size(weights) < target
        return jnp.where(too_few, middle, low), jnp.where(too_few, high, middle)

    # A fixed number of steps has a fixed cost, and compiles to a loop.
    ends = jnp.log(10.0) * jnp.asarray(DECADES)
    low, high = jax.lax.fori_loop(0, BISECTIONS, narrow, (ends[0], ends[1]))
    return cost_range * jnp.exp(0.5 * (low + high))


def smoothed(plan: Plan, window: int) -> Plan:
    """Return a plan smoothed by `savitzky_golay` with a window of this many steps."""
    weights = savitzky_golay(plan.shape[0], window)
    return jnp.matmul(
        jnp.asarray(weights, dtype=float),
        plan,
        precision=jax.lax.Precision.HIGHEST,
    )


def savitzky_golay(horizon: int, window: int) -> Float[np.ndarray, "horizon horizon"]:
    """Return the weights of the steps of a plan in its smoothed plan.

    The smoothed plan is, at every step, a quadratic that is fitted to the window around
    that step. The first half window has the quadratic of the first window, the last
    half window that of the last one.

    Source: Savitzky and Golay (1964); for plans, Williams et al. (2018).
    """
    half = window // 2
    # The projection onto quadratics; on [-1, 1], where it is well conditioned.
    basis, _ = np.linalg.qr(np.vander(np.arange(-half, half + 1) / half, 3))
    projection = basis @ basis.T
    weights = np.zeros((horizon, horizon))
    for step in range(horizon):
        first = int(np.clip(step - half, 0, horizon - window))
        weights[step, first : first + window] = projection[step - first]
    return weights
