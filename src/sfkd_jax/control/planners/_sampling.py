"""Planners that sample: their noise, MPPI, and the cross-entropy method."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._factory import factory
from sfkd_jax.control.planners._planner import (
    Evaluate,
    Plan,
    Planner,
    PlannerState,
    Plans,
    SearchResult,
    Tuning,
    iterate,
    replace_nonfinite,
    tuned,
)
from sfkd_jax.ranges import (
    AtLeastOne,
    AtLeastTwo,
    NonNegativeInt,
    Positive,
    UnitInterval,
    check_choice,
)
from sfkd_jax.types import Control, Key, Scalar

DEVICES = "samples"
"""Axis of a mesh of devices."""
KINDS = ("ar1", "white", "spline")
BISECTIONS = 24
"""Steps of the search for a temperature."""
DECADES = (-12.0, 4.0)
"""The temperature is searched between 10^-12 and 10^4 times the range of the costs. The
lower end is that small because a single outlier widens the range.
"""
FEW = 10.0
"""Effective samples where every sample violates a constraint."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SamplingPlanner(Planner):
    """A planner that perturbs a plan with noise out of standard normal numbers w.

        ar1     ε_{k+1} = ρ ε_k + √(1 − ρ²) w_k
        white   ε_k = w_k
        spline  cubic Lagrange interpolation between w at equidistant knots

    Attributes:
        num_samples: M, plans that are sampled and rolled out per iteration.
        iterations: of sampling and choosing per control step.
        noise: "ar1", "white" or "spline".
        noise_correlation: ρ.
        noise_knots: number of knots, at most one a step.
    """

    num_samples: AtLeastOne = 1500
    iterations: AtLeastOne = 1
    noise: str = "ar1"
    noise_correlation: UnitInterval = 0.8
    noise_knots: AtLeastTwo = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("noise", self.noise, KINDS)
        if self.noise == "spline" and self.noise_knots > self.horizon:
            raise ValueError(
                f"noise_knots must lie in [2, {self.horizon}], got {self.noise_knots}"
            )

    def draw(self, key: Key, std: Control) -> Plans:
        """Return noise of a standard deviation for each control."""
        knots = self.noise_knots if self.noise == "spline" else self.horizon
        shape = (knots, self.num_samples, std.shape[0])
        white = spread(jax.random.normal(key, shape))
        if self.noise == "spline":
            factor = spline(self.horizon, self.noise_knots)
            # Rows of unit length: the same spread at every step.
            factor = factor / np.linalg.norm(factor, axis=1, keepdims=True)
        else:
            rho = self.noise_correlation if self.noise == "ar1" else 0.0
            factor = autoregression(self.horizon, rho)
        # A product for white noise too: without one, XLA draws numbers one by one where
        # they are scaled. In full precision: accelerators round factors to ten bits.
        table = jnp.asarray(factor, dtype=float)
        exact = jax.lax.Precision.HIGHEST
        noise = jnp.einsum("tk,kmc->tmc", table, white, precision=exact)
        return noise * std[None, None]


def spread(noise: Plans) -> Plans:
    """Return noise whose samples are spread over devices, and so are its rollouts.

    If the program is traced under `jax.set_mesh` of a mesh with an axis `DEVICES`.
    """
    mesh = jax.sharding.get_abstract_mesh()
    kinds = dict(zip(mesh.axis_names, mesh.axis_types, strict=True))
    if DEVICES not in kinds:
        return noise
    if kinds[DEVICES] != jax.sharding.AxisType.Auto:
        raise ValueError(f"the mesh's axis {DEVICES!r} must be of type AxisType.Auto")
    axes = jax.sharding.PartitionSpec(None, DEVICES)
    return jax.lax.with_sharding_constraint(noise, axes)


def autoregression(horizon: int, rho: float) -> Float[np.ndarray, "horizon horizon"]:
    """Weights of w in ε; ε_0 = w_0, which has the stationary variance already."""
    steps = np.arange(horizon)
    factor = np.tril(rho ** np.abs(steps[:, None] - steps))
    factor[:, 1:] *= np.sqrt(1.0 - rho**2)
    return factor


def spline(horizon: int, knots: int) -> Float[np.ndarray, "horizon knots"]:
    """Weights of cubic interpolation at each step between equidistant knots.

    With fewer than four knots, the order is lower.
    """
    times = np.arange(horizon)[:, None] * (knots - 1.0) / (horizon - 1.0)
    order = min(4, knots)
    # The four knots around a time; at the ends, the first or last four.
    first = np.clip(np.floor(times) - (order - 1) // 2, 0, knots - order)
    near = (first + np.arange(order)).astype(int)
    # Weights that reproduce the polynomials 1, t, …, around each time.
    powers = (near - times)[:, None] ** np.arange(order)[:, None]
    factor = np.zeros((horizon, knots))
    weights = np.linalg.solve(powers, np.eye(order)[:, :1])
    np.put_along_axis(factor, near, weights[..., 0], axis=1)
    return factor


def savitzky_golay(horizon: int, window: int) -> Float[np.ndarray, "horizon horizon"]:
    """Weights of a plan in its smoothed plan, a quadratic fitted around every step.

    In the first and last half of a window, the quadratic of the first and last window.

    Source: Savitzky and Golay (1964); of plans, Williams et al. (2018).
    """
    half = window // 2
    # The projection onto quadratics; scaled to [-1, 1], so that it is well conditioned.
    basis, _ = np.linalg.qr(np.vander(np.arange(-half, half + 1) / half, 3))
    fit = basis @ basis.T
    table = np.zeros((horizon, horizon))
    for step in range(horizon):
        first = int(np.clip(step - half, 0, horizon - window))
        table[step, first : first + window] = fit[step - first]
    return table


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
        smoothing_window: steps of the window of `savitzky_golay`, which the mean passes
            through; 0 for none.

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
            if self.smoothing_window:
                table = savitzky_golay(self.horizon, self.smoothing_window)
                mean = jnp.matmul(
                    jnp.asarray(table, dtype=float),
                    mean,
                    precision=jax.lax.Precision.HIGHEST,
                )
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Cem(SamplingPlanner):
    """The cross-entropy method.

        ν ← mean of the elites,   σ_k ← max(their standard deviation at step k, σ_min)

    Each iteration samples plans, keeps the elites and fits mean and standard deviation
    to them. A rollout that is not finite is never an elite.

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
            # Narrower with every iteration, per step and control.
            noise = self.draw(key, tuning.noise_std) * scale[:, None]
            # Sample 0 is the mean itself: the best cost never increases.
            evaluated = evaluate(plan[:, None] + noise.at[:, 0].set(0.0))
            ranks, _ = evaluated.ranked()
            negated, chosen = jax.lax.top_k(-ranks, self.elites)
            # Fewer finite rollouts than elites: only those count.
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
