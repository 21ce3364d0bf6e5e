"""Model predictive path integral control of any task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._noise import NoiseSampler, noise_sampler
from sfkd_jax.control.planners._planner import planner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Plan,
    PlannerState,
    Plans,
    Samples,
    SearchResult,
    candidate_plans,
    replace_nonfinite,
    weighted_mean_and_std,
)
from sfkd_jax.control.planners._shaped_noise import curvature_factor, shape_noise
from sfkd_jax.control.planners._weights import weigh
from sfkd_jax.control.tasks._task import Task
from sfkd_jax.ranges import AtLeastTwo, NonNegativeInt, UnitInterval
from sfkd_jax.types import Controller, Key

MIN_NOISE_SCALE = 0.05
"""Floor of adapted noise, relative to its initial spread: zero could never grow."""


def mppi(
    task: Task,
    *,
    horizon: AtLeastTwo = 20,
    num_samples: int = 1500,
    iterations: int = 1,
    effective_samples: float = 0.0,
    noise: str = "ar1",
    noise_correlation: UnitInterval = 0.8,
    noise_exponent: float = 2.0,
    noise_knots: AtLeastTwo = 5,
    halton: bool = False,
    curvature: bool = False,
    adapt: UnitInterval = 0.0,
    control_cost: float = 0.0,
    info_level: str = "plan",
    gain_samples: NonNegativeInt = 0,
    **options: Any,
) -> Controller:
    """Return the information-theoretic MPPI controller of a task.

        ν ← Σ_m w_m ν^m,   w_m ∝ exp(−(J^m + γ Σ_k ν_k' Σ⁻¹ (ν_k^m − ν_k)) / λ)

    Each iteration samples M plans around the current one and rolls all of them out in
    one scan. ν^m is the perturbation that the limits allowed. Sample 0 is the shifted
    plan itself; proposals in the planner's state are added to the samples. A rollout
    that is not finite has weight zero.

    Args:
        task: the planning problem.
        horizon: T, number of steps.
        num_samples: M.
        iterations: of sampling and weighting per control step.
        effective_samples: if not 0, λ is chosen at every iteration such that 1 / Σ w²
            has this value; 0 keeps λ at `temperature`. Both are data, see `Tuning`.
        noise: kind of noise, see `noise_sampler`.
        noise_correlation: see `noise_sampler`.
        noise_exponent: see `noise_sampler`.
        noise_knots: see `noise_sampler`.
        halton: see `noise_sampler`.
        curvature: shape the noise by the Hessian of the plan's own cost, see
            `curvature_factor`. The task must be differentiable; best with white noise.
        adapt: fraction in [0, 1] by which the standard deviation of the noise, per step
            and control, moves to that of the weighted samples after each iteration. It
            is reset at every control step.
        control_cost: γ, in units of cost; Williams et al. have λ (1 − α).
        info_level: see `planner`.
        gain_samples: see `planner`.
        options: of `planner`: temperature, noise_std, smoothing, risk, chunk, unroll,
            sharding, environment box.

    Raises:
        ValueError: a setting is out of its range, or two settings exclude each other.

    Source: Williams et al. (2018), Information-Theoretic Model Predictive Control, T-RO
    34(6).
    """
    _check(num_samples, iterations, effective_samples, adapt)
    _check_independent(curvature, control_cost)
    draw = noise_sampler(
        noise,
        horizon=horizon,
        correlation=noise_correlation,
        exponent=noise_exponent,
        knots=noise_knots,
        halton=halton,
    )

    def search(key: Key, state: PlannerState, evaluate: Evaluate) -> SearchResult:
        std = state.tuning.noise_std
        sample = _sampler(draw, num_samples, curvature, state, evaluate)

        def improve(
            carry: tuple[Plan, Plan], key: Key
        ) -> tuple[tuple[Plan, Plan], SearchResult]:
            plan, scale = carry
            plans = candidate_plans(plan, sample(key) * scale[:, None], state)
            evaluated = evaluate(plans)
            total = costs = evaluated.costs
            if control_cost:
                total = costs + control_cost * _control_cost(plan, plans, std)
            solve = effective_samples != 0.0
            chosen = weigh(total, evaluated.violations, state.tuning, solve=solve)
            allowed, weights = evaluated.perturbations, chosen.weights
            mean, spread = weighted_mean_and_std(
                weights, replace_nonfinite(allowed, 0.0)
            )
            if adapt:
                scale = (1 - adapt) * scale + adapt * spread / std[None]
                scale = jnp.maximum(scale, MIN_NOISE_SCALE)
            lowest = jnp.min(replace_nonfinite(costs, jnp.inf))
            samples = best = None
            if info_level == "samples" or gain_samples:
                samples = Samples(evaluated, weights, chosen.temperature)
            if evaluated.violations is not None:
                best = allowed[:, chosen.best]
            return (mean, scale), SearchResult(
                mean, chosen.usable, lowest, chosen.size, samples, best
            )

        start = (state.plan, jnp.ones_like(state.plan))
        if iterations == 1:
            return improve(start, key)[1]
        _, results = jax.lax.scan(improve, start, jax.random.split(key, iterations))
        return jax.tree.map(lambda leaf: leaf[-1], results)

    return planner(
        task,
        search,
        horizon=horizon,
        effective_samples=effective_samples,
        info_level=info_level,
        gain_samples=gain_samples,
        **options,
    )


def _sampler(
    draw: NoiseSampler,
    num_samples: int,
    curvature: bool,
    state: PlannerState,
    evaluate: Evaluate,
) -> Callable[[Key], Plans]:
    """The noise of this control step, shaped by the cost of the plan on request."""
    std = state.tuning.noise_std
    if not curvature:
        return lambda key: draw(key, num_samples, std)
    factor = curvature_factor(
        lambda plan: evaluate(plan[:, None]).costs[0], state.plan, std
    )
    return lambda key: shape_noise(factor, draw(key, num_samples, jnp.ones_like(std)))


def _control_cost(plan: Array, plans: Plans, std: Array) -> Float[Array, " sample"]:
    """Σ_k ν_k' Σ⁻¹ (ν_k^m − ν_k)."""
    return jnp.einsum("tc,tmc->m", plan / std[None] ** 2, plans - plan[:, None])


def _check(
    num_samples: int, iterations: int, effective_samples: float, adapt: float
) -> None:
    """Raise a ValueError that names a setting out of its range."""
    if num_samples < 1 or iterations < 1:
        raise ValueError(
            "num_samples and iterations must be at least 1, "
            f"got {num_samples} and {iterations}"
        )
    if effective_samples and not 1 <= effective_samples <= num_samples:
        raise ValueError(
            f"effective_samples must be 0 or lie in [1, {num_samples}], "
            f"got {effective_samples}"
        )
    if not 0 <= adapt <= 1:
        raise ValueError(f"adapt must lie in [0, 1], got {adapt}")


def _check_independent(curvature: bool, control_cost: float) -> None:
    """Raise a ValueError if the noise is not independent but has to be."""
    if curvature and control_cost:
        raise ValueError(
            "curvature and control_cost exclude each other: "
            "the latter needs independent noise"
        )
