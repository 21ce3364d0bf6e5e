"""The conditions of a certificate: boxes of the environment, the state and the road."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.path_coordinates import LATERAL, PathState, is_valid
from sfkd_jax.types import Environment

Box: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
"""Lower and upper limits."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Where a certificate applies; None means that there is no limit.

    Attributes:
        env: box of e.
        state: box of ξ.
        road: box of (κ, v_ref).
    """

    env: Box | None = None
    state: Box | None = None
    road: Box | None = None

    def nearest(self, env: Environment) -> Environment:
        """Return e, clipped to its box."""
        if self.env is None:
            return env
        low, high = map(jnp.asarray, self.env)
        return jnp.clip(env, low, high)

    def hold(self, xi: PathState, road: Float[Array, " 2"]) -> Bool[Array, ""]:
        """Return whether ξ, κ and v_ref are inside; False for NaN."""
        inside = is_valid(xi[LATERAL], road[0])
        for box, point in ((self.state, xi), (self.road, road)):
            if box is not None:
                low, high = map(jnp.asarray, box)
                inside &= jnp.all((low <= point) & (point <= high))
        return inside


ANYWHERE = Conditions()
"""No limits."""


def check_box(name: str, box: Box | None, size: int) -> None:
    """Raise a ValueError if a box has the wrong size or is empty."""
    if box is None:
        return
    low, high = box
    sized = len(low) == len(high) == size
    if not sized or not all(a <= b for a, b in zip(low, high, strict=True)):
        raise ValueError(
            f"the box of {name} needs {size} lower limits below {size} upper ones, "
            f"got {low} and {high}"
        )
