"""The cross-entropy method over any task."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax.control.planners._noise import sampler
from sfkd_jax.control.planners._planner import planner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Found,
    PlannerState,
    drawn_around,
    finite_or_dear,
    finite_or_zero,
    weighted,
)
from sfkd_jax.control.tasks._task import Task
from sfkd_jax.types import Controller, Key


def cem(
    task: Task,
    *,
    horizon: int = 20,
    num_samples: int = 500,
    elites: int = 50,
    iterations: int = 3,
    smallest_scale: float = 0.05,
    noise: str = "ar1",
    noise_correlation: float = 0.8,
    noise_exponent: float = 2.0,
    noise_knots: int = 5,
    halton: bool = False,
    **options: Any,
) -> Controller:
    """Draw plans, keep the elites, fit mean and spread to them, draw again.

        ν ← mean of the elites,   σ_k ← max(their standard deviation at step k, σ_min)

    Sample 0 of each iteration is the present mean, so nothing found is lost; a bad
    rollout is no elite.

    Args:
        task: what is planned.
        horizon: T.
        num_samples: per iteration.
        elites: kept.
        iterations: per control step.
        smallest_scale: σ_min, against noise_std; σ starts anew at noise_std at every
            control step.
        noise, noise_correlation, noise_exponent, noise_knots, halton: course of the
            noise over time, see `sampler`.
        options: of `planner`.

    Raises:
        ValueError: settings that cannot be meant.

    Source: Rubinstein (1999); correlated noise as in Pinneri et al. (2020), iCEM.
    """
    if not 1 <= elites <= num_samples or iterations < 1:
        raise ValueError(
            f"elites must lie in [1, num_samples], got {elites} of {num_samples}, {iterations} iterations"
        )
    shape = {
        "correlation": noise_correlation,
        "exponent": noise_exponent,
        "knots": noise_knots,
        "halton": halton,
    }
    draw = sampler(noise, horizon=horizon, **shape)

    def search(key: Key, state: PlannerState, evaluate: Evaluate) -> Found:
        def improve(
            carry: tuple[Array, Array], key: Key
        ) -> tuple[tuple[Array, Array], Found]:
            plan, scale = carry
            noise = draw(key, num_samples, state.tuning.noise_std) * scale[:, None]
            costs, effective = evaluate(drawn_around(plan, noise, state))
            lowest, chosen = jax.lax.top_k(-finite_or_dear(costs), elites)
            counts = jnp.isfinite(lowest).astype(float)
            weights = counts / jnp.maximum(jnp.sum(counts), 1.0)
            mean, spread = weighted(weights, finite_or_zero(effective)[:, chosen])
            scale = jnp.maximum(spread / state.tuning.noise_std, smallest_scale)
            return (mean, scale), Found(
                mean, jnp.any(counts > 0), -lowest[0], jnp.sum(counts)
            )

        start = (state.plan, jnp.ones_like(state.plan))
        _, founds = jax.lax.scan(improve, start, jax.random.split(key, iterations))
        return jax.tree.map(lambda leaf: leaf[-1], founds)

    return planner(task, search, horizon=horizon, **options)
