"""Feedback gains of a plan: how its first control depends on the observation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._plans import SearchResult
from sfkd_jax.control.planners._rollouts import Rollouts
from sfkd_jax.control.tasks._task import StepIndex
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.types import Control, Scalar

Gains = Float[Array, "control state"]


def feedback_gains(
    rollouts: Rollouts,
    start_of: Callable[[Array], Any],
    observation: Float[Array, " state"],
    result: SearchResult,
    count: int,
) -> Gains:
    """Return du/dx of the first control of a weighted plan.

        dν/dx = −1/λ Σ_m w_m (ν_0^m − ν_0) dJ^m/dx,   du/dx = ∂u/∂x + ∂u/∂ν dν/dx

    u(x, ν) is the control that the limits allow, feedback law included. λ and the
    samples are held fixed.

    Args:
        rollouts: of this control step.
        start_of: observation -> start of the rollouts; differentiated forwards, because
            tasks prepare a step with loops that have no reverse derivative.
        observation: x.
        result: the chosen plan ν, and the samples of the last iteration.
        count: number of samples whose costs are differentiated, those with the largest
            weights.

    Raises:
        ValueError: the search weights its samples without a temperature.

    Source: F-MPPI, Belvedere et al., RA-L 2026.
    """
    samples = result.samples
    if samples is None or samples.temperature is None:
        raise ValueError("gain_samples needs a search with a temperature, see `mppi`")
    kept = min(count, samples.weights.shape[0])
    weights, chosen = jax.lax.top_k(samples.weights, kept)
    # The heaviest samples stand for all: renormalise.
    weights = weights / jnp.maximum(jnp.sum(weights), jnp.finfo(weights.dtype).tiny)
    plans = samples.evaluated.perturbations[:, chosen]
    away = plans[0] - weights @ plans[0]
    setup, tuning = rollouts.setup, rollouts.tuning

    def costs_from(start: Any) -> Float[Array, " sample"]:
        # A few samples are not worth spreading over devices.
        moved = replace(rollouts, setup=setup._replace(start=start), sharding=None)
        return moved(plans).costs

    def control_of(start: Any, perturbation: Control) -> Control:
        context, targets = setup.context, setup.targets
        if rollouts.risk is not None:  # the first of several environments
            context, start, targets = jax.tree.map(
                lambda leaf: leaf[0], (context, start, targets)
            )
        target = jax.tree.map(lambda leaf: leaf[0], targets)
        at = StepIndex(jnp.zeros((), int), jnp.zeros(()))
        step = rollouts.task.step
        return step(tuning.cost, context, start, perturbation, target, at).control

    start = start_of(observation)
    by_start = jax.jacfwd(start_of)(observation)
    # Reverse mode: one pass for each control, however many numbers the start has.
    _, pull_back = jax.vjp(costs_from, start)
    seeds = -(weights[:, None] * away / samples.temperature).T
    by_search = jax.vmap(lambda seed: _along(pull_back(seed)[0], by_start))(seeds)
    direct = jax.jacrev(control_of, argnums=(0, 1))(start, result.plan[0])
    by_law = jax.vmap(lambda row: _along(row, by_start))(direct[0])
    return by_law + direct[1] @ by_search


def _along(gradient: Any, by_start: Any) -> Float[Array, " state"]:
    """A gradient by the start of the rollouts, as one by the observation."""
    parts = jax.tree.map(
        lambda slope, by: jnp.tensordot(slope, by, axes=slope.ndim), gradient, by_start
    )
    return sum(jax.tree.leaves(parts), jnp.zeros(()))


def between_plans(
    control: Control,
    gains: Gains,
    planned_from: Float[Array, " state"],
    predicted: Float[Array, " state"],
    observation: Float[Array, " state"],
    *,
    fraction: Scalar | float,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    angles: tuple[int, ...] = (),
) -> Control:
    """Return the control between two plans, u + K (x − x̂).

    x̂ lies on the line from the state that was planned from to the predicted one.

    Args:
        control: u, of the last plan.
        gains: K, `info["gains"]` of the last plan.
        planned_from: the observation of the last plan.
        predicted: the state one period later, `info["predicted_states"][0]`.
        observation: x, now.
        fraction: of the period that has passed, in [0, 1].
        control_low: lower control limits.
        control_high: upper control limits.
        angles: entries of the state that are angles; differences are wrapped.
    """
    which = jnp.asarray(list(angles), dtype=int)

    def difference(one: Array, other: Array) -> Array:
        gap = one - other
        return gap.at[which].set(wrap_angle(gap[which]))

    moved = difference(observation, planned_from)
    expected = fraction * difference(predicted, planned_from)
    wanted = control + gains @ difference(moved, expected)
    # A reading that is not finite leaves the planned control.
    usable = jnp.where(jnp.all(jnp.isfinite(wanted)), wanted, control)
    return jnp.clip(usable, jnp.asarray(control_low), jnp.asarray(control_high))
