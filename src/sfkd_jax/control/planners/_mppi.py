"""Model predictive path integral control over any task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._curvature import curvature_factor, shaped
from sfkd_jax.control.planners._noise import sampler
from sfkd_jax.control.planners._planner import planner
from sfkd_jax.control.planners._plans import (
    Evaluate,
    Found,
    Plan,
    PlannerState,
    Plans,
    drawn_around,
    finite_or_dear,
    finite_or_zero,
    weighted,
)
from sfkd_jax.control.planners._weights import count_effective, softmin, temperature_for
from sfkd_jax.control.tasks._task import Task
from sfkd_jax.types import Controller, Key

SMALLEST_SCALE = 0.05
"""Of adapted noise, against what it starts as: a spread of zero would never grow again."""


def mppi(
    task: Task,
    *,
    horizon: int = 20,
    num_samples: int = 1500,
    iterations: int = 1,
    effective_samples: float = 0.0,
    noise: str = "ar1",
    noise_correlation: float = 0.8,
    noise_exponent: float = 2.0,
    noise_knots: int = 5,
    halton: bool = False,
    curvature: bool = False,
    adapt: float = 0.0,
    control_cost: float = 0.0,
    **options: Any,
) -> Controller:
    """Information-theoretic MPPI; each iteration draws M plans around the present one and rolls all out in one scan.

        ν ← Σ_m w_m ν^m,   w_m ∝ exp(−(J^m + γ Σ_k ν_k' Σ⁻¹ (ν_k^m − ν_k)) / λ)

    ν^m is the perturbation that was effective after clipping. Sample 0 is the shifted
    plan itself; proposals in the planner's state come beside the drawn ones. A bad
    rollout gets weight zero.

    Args:
        task: what is planned.
        horizon: T.
        num_samples: M.
        iterations: of drawing and weighing, per control step.
        effective_samples: choose λ anew each time so that 1 / Σ w² is this; 0 keeps λ
            at `temperature`. The number and λ itself are data of the state, see
            `Tuning`.
        noise, noise_correlation, noise_exponent, noise_knots, halton: see `sampler`.
        curvature: shape the noise by the second derivative of the plan's own cost, see
            `curvature_factor`; the task must be differentiable, and white noise is the
            natural choice then.
        adapt: share in [0, 1] by which the noise's spread, per step and control, moves
            to that of the weighted samples after each iteration; it starts anew at
            every control step.
        control_cost: γ, in units of cost; Williams et al. have λ (1 − α).
        options: of `planner`: temperature, noise_std, smoothing, risk, chunk, sharding,
            environment box.

    Raises:
        ValueError: settings that cannot be meant.

    Source: Williams et al. (2018), Information-Theoretic Model Predictive Control, T-RO
    34(6).
    """
    _check(num_samples, iterations, effective_samples, adapt)
    if curvature and control_cost:
        raise ValueError(
            "curvature and control_cost exclude each other: the latter wants independent noise"
        )
    shape = {
        "correlation": noise_correlation,
        "exponent": noise_exponent,
        "knots": noise_knots,
        "halton": halton,
    }
    draw = sampler(noise, horizon=horizon, **shape)

    def around(state: PlannerState, evaluate: Evaluate) -> Callable[[Key], Plans]:
        """The noise of this control step."""
        std = state.tuning.noise_std
        if not curvature:
            return lambda key: draw(key, num_samples, std)
        factor = curvature_factor(
            lambda plan: evaluate(plan[:, None])[0][0], state.plan, std
        )
        return lambda key: shaped(factor, draw(key, num_samples, jnp.ones_like(std)))

    def search(key: Key, state: PlannerState, evaluate: Evaluate) -> Found:
        std = state.tuning.noise_std
        noise_of = around(state, evaluate)

        def improve(
            carry: tuple[Plan, Plan], key: Key
        ) -> tuple[tuple[Plan, Plan], Found]:
            plan, scale = carry
            plans = drawn_around(plan, noise_of(key) * scale[:, None], state)
            costs, effective = evaluate(plans)
            charged = costs
            if control_cost:
                charged = costs + control_cost * _work(plan, plans, std)
            wanted = state.tuning.effective_samples
            temperature = (
                temperature_for(charged, wanted)
                if effective_samples
                else state.tuning.temperature
            )
            weights, usable = softmin(charged, temperature)
            better, spread = weighted(weights, finite_or_zero(effective))
            if adapt:
                scale = jnp.maximum(
                    (1 - adapt) * scale + adapt * spread / std, SMALLEST_SCALE
                )
            best = jnp.min(finite_or_dear(costs))
            return (better, scale), Found(
                better, usable, best, count_effective(weights)
            )

        start = (state.plan, jnp.ones_like(state.plan))
        if iterations == 1:
            return improve(start, key)[1]
        _, founds = jax.lax.scan(improve, start, jax.random.split(key, iterations))
        return jax.tree.map(lambda leaf: leaf[-1], founds)

    return planner(
        task, search, horizon=horizon, effective_samples=effective_samples, **options
    )


def _work(plan: Array, plans: Plans, std: Array) -> Float[Array, " sample"]:
    """Σ_k ν_k' Σ⁻¹ (ν_k^m − ν_k)."""
    return jnp.einsum("tc,tmc->m", plan / std**2, plans - plan[:, None])


def _check(
    num_samples: int, iterations: int, effective_samples: float, adapt: float
) -> None:
    """Refuse settings that cannot be meant, naming them."""
    if num_samples < 1 or iterations < 1:
        raise ValueError(
            f"num_samples and iterations must be at least 1, got {num_samples} and {iterations}"
        )
    if effective_samples and not 1 <= effective_samples <= num_samples:
        raise ValueError(
            f"effective_samples must be 0 or lie in [1, {num_samples}], got {effective_samples}"
        )
    if not 0 <= adapt <= 1:
        raise ValueError(f"adapt must lie in [0, 1], got {adapt}")
