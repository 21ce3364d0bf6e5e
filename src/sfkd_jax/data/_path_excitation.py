"""Draw the inputs of a drive along a path: curvature, speed and perturbation ν."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Key, Scalar


def profile(
    key: Key,
    *,
    steps: int,
    dt: float,
    speed: tuple[float | Scalar, float | Scalar],
    peak: float,
    wavelengths: tuple[float, float],
    most: float,
) -> tuple[Float[Array, " time"], Float[Array, " time"]]:
    """Draw v_ref [m/s] and κ [1/m] at every step."""
    level_key, swing_key, wave_key, phase_key, size_key, kind_key, circle_key = (
        jax.random.split(key, 7)
    )
    level = jax.random.uniform(level_key, (), minval=speed[0], maxval=speed[1])
    swing, period, begins = jax.random.uniform(swing_key, (3,))
    time = jnp.arange(steps) * dt
    speeds = level + 0.8 * swing * jnp.sin(
        2 * jnp.pi * (time / (5.0 + 15.0 * period) + begins)
    )
    speeds = jnp.clip(speeds, *speed)
    waves = jax.random.uniform(
        wave_key, (3, 1), minval=wavelengths[0], maxval=wavelengths[1]
    )
    phases = jax.random.uniform(phase_key, (3, 1), maxval=2 * jnp.pi)
    along = jnp.cumsum(speeds) * dt
    bends = jnp.mean(jnp.sin(2 * jnp.pi * along / waves + phases), axis=0)
    # Three sinusoids seldom peak together: twice their mean, clipped, stays at the
    # extremes for a while as well.
    bends = jnp.sqrt(jax.random.uniform(size_key)) * jnp.clip(2.0 * bends, -1.0, 1.0)
    circle = jnp.clip(
        jax.random.uniform(circle_key, minval=-1.5, maxval=1.5), -1.0, 1.0
    )
    wanted = peak * jnp.where(jax.random.uniform(kind_key) < 1.0 / 3.0, circle, bends)
    tightest = jnp.minimum(peak, most / speeds**2)
    return speeds, jnp.clip(wanted, -tightest, tightest)


def perturbations(
    key: Key, *, steps: int, spread: Float[Array, "2 2"]
) -> Float[Array, "time 2"]:
    """Draw ν: an AR(1) process or its sign, its spread log-uniform per channel."""
    spread_key, white_key, kind_key = jax.random.split(key, 3)
    logs = jnp.log(spread)
    size = jnp.exp(
        jax.random.uniform(spread_key, (2,), minval=logs[:, 0], maxval=logs[:, 1])
    )
    white = jax.random.normal(white_key, (steps, 2))

    def follow(noise: Array, fresh: Array) -> tuple[Array, Array]:
        noise = 0.85 * noise + jnp.sqrt(1.0 - 0.85**2) * fresh
        return noise, noise

    noise = jax.lax.scan(follow, white[0], white)[1]
    bang = jax.random.uniform(kind_key) < 0.25
    return size * jnp.where(bang, jnp.sign(noise), noise)
