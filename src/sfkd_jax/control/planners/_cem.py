"""The cross-entropy method for any task."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax.control.planners._noise import noise_sampler
from sfkd_jax.control.planners._planner import planner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Plan,
    PlannerState,
    Samples,
    SearchResult,
    candidate_plans,
    replace_nonfinite,
    weighted_mean_and_std,
)
from sfkd_jax.control.planners._weights import keep_constraints
from sfkd_jax.control.tasks._task import Task
from sfkd_jax.ranges import AtLeastTwo, UnitInterval
from sfkd_jax.types import Controller, Key


def cem(
    task: Task,
    *,
    horizon: AtLeastTwo = 20,
    num_samples: int = 500,
    elites: int = 50,
    iterations: int = 3,
    smallest_scale: float = 0.05,
    noise: str = "ar1",
    noise_correlation: UnitInterval = 0.8,
    noise_exponent: float = 2.0,
    noise_knots: AtLeastTwo = 5,
    halton: bool = False,
    info_level: str = "plan",
    **options: Any,
) -> Controller:
    """Return the cross-entropy controller of a task.

        ν ← mean of the elites,   σ_k ← max(their standard deviation at step k, σ_min)

    Each iteration samples plans, keeps the elites and fits mean and standard deviation
    to them. Sample 0 is the current mean, so the best cost never increases between
    iterations. A rollout that is not finite is never an elite.

    Args:
        task: the planning problem.
        horizon: T, number of steps.
        num_samples: per iteration.
        elites: number of samples kept.
        iterations: per control step.
        smallest_scale: σ_min relative to noise_std; σ is reset to noise_std at every
            control step.
        noise: kind of noise, see `noise_sampler`.
        noise_correlation: see `noise_sampler`.
        noise_exponent: see `noise_sampler`.
        noise_knots: see `noise_sampler`.
        halton: see `noise_sampler`.
        info_level: see `planner`.
        options: of `planner`.

    Raises:
        ValueError: a setting is out of its range.

    Source: Rubinstein (1999); correlated noise as in Pinneri et al. (2020), iCEM.
    """
    if not 1 <= elites <= num_samples or iterations < 1:
        raise ValueError(
            "elites must lie in [1, num_samples], "
            f"got {elites} of {num_samples}, {iterations} iterations"
        )
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

        def improve(
            carry: tuple[Plan, Plan], key: Key
        ) -> tuple[tuple[Plan, Plan], SearchResult]:
            plan, scale = carry
            noise = draw(key, num_samples, std) * scale[:, None]
            evaluated = evaluate(candidate_plans(plan, noise, state))
            costs, best = replace_nonfinite(evaluated.costs, jnp.inf), None
            if evaluated.violations is not None:
                costs, _ = keep_constraints(costs, evaluated.violations)
                best = evaluated.perturbations[:, jnp.argmin(costs)]
            negated, chosen = jax.lax.top_k(-costs, elites)
            counts = jnp.isfinite(negated).astype(float)
            weights = counts / jnp.maximum(jnp.sum(counts), 1.0)
            mean, spread = weighted_mean_and_std(
                weights, replace_nonfinite(evaluated.perturbations, 0.0)[:, chosen]
            )
            scale = jnp.maximum(spread / std[None], smallest_scale)
            usable, size = jnp.any(counts > 0), jnp.sum(counts)
            samples = None
            if info_level == "samples":
                kept = jnp.zeros_like(costs).at[chosen].set(weights)
                samples = Samples(evaluated, kept)
            result = SearchResult(mean, usable, -negated[0], size, samples, best)
            return (mean, scale), result

        start = (state.plan, jnp.ones_like(state.plan))
        _, results = jax.lax.scan(improve, start, jax.random.split(key, iterations))
        return jax.tree.map(lambda leaf: leaf[-1], results)

    return planner(task, search, horizon=horizon, info_level=info_level, **options)
