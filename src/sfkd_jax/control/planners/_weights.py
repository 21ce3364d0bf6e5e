"""From costs to weights, and the temperature at which as many samples count as are wanted."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.types import Scalar

BISECTIONS = 24
DECADES = (-12.0, 4.0)
"""Temperatures are looked for between 10^-12 and 10^4 times the spread of the costs:
one far off stretches it.
"""


def softmin(
    costs: Float[Array, " sample"], temperature: Scalar
) -> tuple[Float[Array, " sample"], Bool[Array, ""]]:
    """Weights ∝ exp(−J/λ) over the finite costs, and whether there is any."""
    finite = jnp.isfinite(costs)
    usable = jnp.any(finite)
    scores = jnp.where(finite, -costs / temperature, -jnp.inf)
    weights = jax.nn.softmax(jnp.where(usable, scores, 0.0))
    return weights, usable


def count_effective(weights: Float[Array, " sample"]) -> Scalar:
    """1 / Σ w²: M for equal weights, 1 for a single one (Kish)."""
    return 1.0 / jnp.sum(weights**2)


def temperature_for(costs: Float[Array, " sample"], wanted: Scalar) -> Scalar:
    """λ at which `count_effective` is `wanted`, by bisection of log λ; it grows with λ.

    The bracket scales with the spread of the finite costs, so the answer scales with
    the costs. More samples than are finite, or fewer than share the lowest cost, cannot
    be had: the end of the bracket is then returned.

    Args:
        costs: not all need be finite.
        wanted: in [1, sample].
    """
    finite = jnp.isfinite(costs)
    lowest = jnp.min(jnp.where(finite, costs, jnp.inf))
    highest = jnp.max(jnp.where(finite, costs, -jnp.inf))
    spread = highest - lowest
    spread = jnp.where(jnp.isfinite(spread) & (spread > 0), spread, 1.0)
    above = jnp.where(
        finite, (costs - lowest) / spread, jnp.inf
    )  # at scale 1, whatever the units of cost

    def narrow(_: Any, bracket: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = bracket
        middle = 0.5 * (low + high)
        few = count_effective(softmin(above, jnp.exp(middle))[0]) < wanted
        return jnp.where(few, middle, low), jnp.where(few, high, middle)

    ends = jnp.log(10.0) * jnp.asarray(DECADES)
    low, high = jax.lax.fori_loop(0, BISECTIONS, narrow, (ends[0], ends[1]))
    return spread * jnp.exp(0.5 * (low + high))
