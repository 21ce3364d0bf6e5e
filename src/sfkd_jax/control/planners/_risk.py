"""Risk measures: one cost for a plan that is rolled out in several environments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

RISKS = ("mean", "worst", "cvar")

RiskMeasure: TypeAlias = Callable[
    [Float[Array, "particle sample"]], Float[Array, " sample"]
]


def risk_measure(name: str, level: float) -> RiskMeasure:
    """Return the function that reduces the costs of whole trajectories to one per plan.

        mean_p J_p,   max_p J_p,   CVaR = mean of the ⌈level · P⌉ largest J_p

    The measure applies to whole trajectories, so one environment is the worst case
    over the entire horizon.

    Args:
        name: "mean", "worst" or "cvar".
        level: fraction of the largest costs that CVaR averages, in (0, 1].

    Raises:
        ValueError: the name is unknown, or the level is outside (0, 1].
    """
    if name not in RISKS:
        raise ValueError(f"risk must be one of {', '.join(RISKS)}, got {name!r}")
    if not 0 < level <= 1:
        raise ValueError(f"risk_level must lie in (0, 1], got {level}")

    def cvar(costs: Float[Array, "particle sample"]) -> Float[Array, " sample"]:
        count = math.ceil(level * costs.shape[0])
        return jnp.mean(jax.lax.top_k(costs.T, count)[0], axis=1)

    return {
        "mean": lambda costs: jnp.mean(costs, axis=0),
        "worst": lambda costs: jnp.max(costs, axis=0),
        "cvar": cvar,
    }[name]
