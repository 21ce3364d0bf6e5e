"""Sample weights of MPPI, and the temperature for a given effective sample size."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control.planners._plans import Tuning
from sfkd_jax.types import Scalar

BISECTIONS = 24
DECADES = (-12.0, 4.0)
"""The temperature is searched between 10^-12 and 10^4 times the range of the costs. The
lower end is that small because a single outlier widens the range.
"""
FEW = 10.0
"""Effective samples where every sample violates a constraint."""


class Weighted(NamedTuple):
    """Weights of samples.

    Attributes:
        weights: that sum to 1.
        usable: whether any cost is finite.
        temperature: λ by which the weights follow from the costs; infinite where they
            follow from violations.
        size: effective number of samples.
        best: index of the best sample.
    """

    weights: Float[Array, " sample"]
    usable: Bool[Array, ""]
    temperature: Scalar
    size: Scalar
    best: Int[Array, ""]


def weigh(
    costs: Float[Array, " sample"],
    violations: Float[Array, " sample"] | None,
    tuning: Tuning,
    *,
    solve: bool,
) -> Weighted:
    """Weigh samples by their costs, under constraints by `keep_constraints`.

    Args:
        costs: of the samples.
        violations: of the constraints; None without any.
        tuning: λ and the wanted number of effective samples.
        solve: whether λ follows from that number.
    """
    temperature, any_kept = tuning.temperature, None
    if violations is not None:
        costs, any_kept = keep_constraints(costs, violations)
    # λ on the cost scale of this very step: robust where costs vary by decades.
    if solve:
        temperature = temperature_for_sample_size(costs, tuning.effective_samples)
    scale = temperature
    if any_kept is not None:  # violations are in other units than costs
        # No sample keeps all: average the least violated ones, sharply.
        few = temperature_for_sample_size(costs, jnp.asarray(FEW))
        scale = jnp.where(any_kept, temperature, few)
        temperature = jnp.where(any_kept, temperature, jnp.inf)
    weights, usable = softmin(costs, scale)
    size = effective_sample_size(weights)
    return Weighted(weights, usable, temperature, size, jnp.argmin(costs))


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


def keep_constraints(
    costs: Float[Array, " sample"],
    violations: Float[Array, " sample"],
) -> tuple[Float[Array, " sample"], Bool[Array, ""]]:
    """Return costs in lexicographic order, and whether a sample keeps all constraints.

    The cost of a sample that violates one is infinite then; otherwise the costs are the
    violations.

    Args:
        costs: of the samples.
        violations: largest of each sample, not below 0.
    """
    # A rollout that is not finite keeps nothing, whatever its violation says.
    kept = (violations <= 0.0) & jnp.isfinite(costs)
    any_kept = jnp.any(kept)
    violations = jnp.where(jnp.isfinite(costs), violations, jnp.inf)
    return jnp.where(any_kept, jnp.where(kept, costs, jnp.inf), violations), any_kept


def effective_sample_size(weights: Float[Array, " sample"]) -> Scalar:
    """Return Kish's 1 / Σ w²: M for M equal weights, 1 if one sample has all weight."""
    return 1.0 / jnp.sum(weights**2)


@jax.custom_jvp
def temperature_for_sample_size(
    costs: Float[Array, " sample"], wanted: Scalar
) -> Scalar:
    """Return λ at which `effective_sample_size` is `wanted`, by bisection of log λ.

    The bracket scales with the range of the finite costs, so λ scales with the costs.
    If `wanted` exceeds the number of finite costs, or is less than the number of
    samples that share the lowest cost, the result is an end of the bracket, and its
    derivative is 0. Elsewhere that is −(∂N/∂J dJ − dN) / (∂N/∂λ), N the effective
    sample size (implicit function theorem).

    Args:
        costs: may contain values that are not finite.
        wanted: in [1, number of samples]; the effective sample size grows with λ.
    """
    finite = jnp.isfinite(costs)
    lowest = jnp.min(jnp.where(finite, costs, jnp.inf))
    highest = jnp.max(jnp.where(finite, costs, -jnp.inf))
    spread = highest - lowest
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


@temperature_for_sample_size.defjvp
def _(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Scalar, Scalar]:
    costs, wanted = primals
    temperature = temperature_for_sample_size(costs, wanted)

    def size(costs: Array, temperature: Array) -> Scalar:
        return effective_sample_size(softmin(costs, temperature)[0])

    unchanged = jnp.zeros_like(temperature)
    reached, by_costs = jax.jvp(size, (costs, temperature), (tangents[0], unchanged))
    _, slope = jax.jvp(
        size, (costs, temperature), (jnp.zeros_like(costs), unchanged + 1.0)
    )
    # At an end of the bracket the equation does not hold: no derivative.
    inside = (jnp.abs(reached - wanted) < 1e-2 * wanted) & (slope > 0)
    change = (tangents[1] - by_costs) / jnp.where(inside, slope, 1.0)
    return temperature, jnp.where(inside, change, 0.0)
