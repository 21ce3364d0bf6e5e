"""What a plan is worth that may meet several environments."""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

RISKS = ("mean", "worst", "cvar")


def risk_measure(
    name: str, level: float
) -> Callable[[Float[Array, "particle sample"]], Float[Array, " sample"]]:
    """Costs of whole trajectories -> one number a plan; of trajectories, so that no worst case changes sides midway.

        mean_p J_p,   max_p J_p,   CVaR = mean of the ⌈level · P⌉ largest J_p

    Args:
        name: "mean", "worst" or "cvar".
        level: share of the worst, in (0, 1].

    Raises:
        ValueError: unknown name or level outside (0, 1].
    """
    if name not in RISKS:
        raise ValueError(f"risk must be one of {', '.join(RISKS)}, got {name!r}")
    if not 0 < level <= 1:
        raise ValueError(f"risk_level must lie in (0, 1], got {level}")

    def tail(costs: Float[Array, "particle sample"]) -> Float[Array, " sample"]:
        count = math.ceil(level * costs.shape[0])
        return jnp.mean(jax.lax.top_k(costs.T, count)[0], axis=1)

    return {
        "mean": lambda costs: jnp.mean(costs, axis=0),
        "worst": lambda costs: jnp.max(costs, axis=0),
        "cvar": tail,
    }[name]
