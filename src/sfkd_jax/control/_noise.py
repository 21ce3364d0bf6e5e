"""Perturbations for sampling planners."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Key


def correlated_noise(
    key: Key,
    *,
    num_samples: int,
    horizon: int,
    std: Float[Array, " control"],
    correlation: float,
) -> Float[Array, "horizon sample control"]:
    """Stationary AR(1) noise, ε_{k+1} = ρ ε_k + √(1 − ρ²) w_k, so that every step has the same spread.

    Args:
        key: consumed.
        num_samples, horizon: how many, how long.
        std: per control channel, in control units. correlation: ρ in [0, 1).
    """
    white = jax.random.normal(key, (horizon, num_samples, std.shape[0])) * std
    fresh = jnp.sqrt(1.0 - correlation**2)

    def step(before: Array, new: Array) -> tuple[Array, Array]:
        now = correlation * before + fresh * new
        return now, now

    _, rest = jax.lax.scan(step, white[0], white[1:])
    return jnp.concatenate([white[:1], rest])
