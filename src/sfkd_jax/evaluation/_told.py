"""What a controller is told about the environment, where that is not what the plant meets."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Key

HEARD = 3
"""Folded into an episode's key; 0 and 1 belong to planner and sensors, 2 to side
forces.
"""


def told(
    envs: Float[Array, "time 2"],
    key: Key,
    *,
    dt: float,
    delay_s: float = 0.0,
    noise: tuple[float, float] = (0.0, 0.0),
    bias: tuple[float, float] = (0.0, 0.0),
) -> Float[Array, "time 2"]:
    """The environment as it is measured: late, with a constant error, with white noise; ê_k = e_{k−d} + b + n_k.

    Before the first late value arrives, the first one of the episode is told. Friction
    is told as at least 0.05.

    Args:
        envs: as met.
        key: of the episode, not consumed: its other streams stay what they are.
        dt: sampling period [s].
        delay_s: d in seconds.
        noise: standard deviations of friction [-] and wind [m/s].
        bias: of the same.
    """
    steps = round(delay_s / dt)
    late = jnp.concatenate([jnp.tile(envs[:1], (steps, 1)), envs])[: envs.shape[0]]
    spread = jnp.asarray(noise) * jax.random.normal(
        jax.random.fold_in(key, HEARD), envs.shape
    )
    heard = late + jnp.asarray(bias) + spread
    return heard.at[:, 0].max(0.05) if steps or any(noise) or any(bias) else envs
