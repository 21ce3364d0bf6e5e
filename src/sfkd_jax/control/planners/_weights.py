"""Sample weights of MPPI, and the temperature for a given effective sample size."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.types import Scalar

BISECTIONS = 24
DECADES = (-12.0, 4.0)
"""The temperature is searched between 10^-12 and 10^4 times the range of the costs. The
lower end is that small because a single outlier widens the range.
"""


def softmin(
    costs: Float[Array, " sample"], temperature: Scalar
) -> tuple[Float[Array, " sample"], Bool[Array, ""]]:
    """Return weights ∝ exp(−J/λ) over the finite costs, and whether any is finite."""
    finite = jnp.isfinite(costs)
    usable = jnp.any(finite)
    scores = jnp.where(finite, -costs / temperature, -jnp.inf)
    weights = jax.nn.softmax(jnp.where(usable, scores, 0.0))
    return weights, usable


def effective_sample_size(weights: Float[Array, " sample"]) -> Scalar:
    """Return Kish's 1 / Σ w²: M for M equal weights, 1 if one sample has all weight."""
    return 1.0 / jnp.sum(weights**2)


def temperature_for_sample_size(
    costs: Float[Array, " sample"], wanted: Scalar
) -> Scalar:
    """Return λ at which `effective_sample_size` is `wanted`, by bisection of log λ.

    The bracket scales with the range of the finite costs, so λ scales with the costs.
    If `wanted` exceeds the number of finite costs, or is less than the number of
    samples that share the lowest cost, the result is an end of the bracket.

    Args:
        costs: may contain values that are not finite.
        wanted: in [1, number of samples]; the effective sample size grows with λ.
    """
    finite = jnp.isfinite(costs)
    lowest = jnp.min(jnp.where(finite, costs, jnp.inf))
    highest = jnp.max(jnp.where(finite, costs, -jnp.inf))
    spread = highest - lowest
    spread = jnp.where(jnp.isfinite(spread) & (spread > 0), spread, 1.0)
    # In [0, 1], whatever the units of cost.
    scaled = jnp.where(finite, (costs - lowest) / spread, jnp.inf)

    def narrow(_: Any, bracket: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bracket
        middle = 0.5 * (low + high)
        few = effective_sample_size(softmin(scaled, jnp.exp(middle))[0]) < wanted
        return jnp.where(few, middle, low), jnp.where(few, high, middle)

    ends = jnp.log(10.0) * jnp.asarray(DECADES)
    low, high = jax.lax.fori_loop(0, BISECTIONS, narrow, (ends[0], ends[1]))
    return spread * jnp.exp(0.5 * (low + high))
