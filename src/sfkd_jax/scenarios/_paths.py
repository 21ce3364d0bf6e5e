"""Random roads: smooth ones, and lane changes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.paths import SPACING, Path, path_from_curvature
from sfkd_jax.types import Key

RUN_UP = 20.0
"""Over which the curvature of a path is blended in [m]."""
LANE = 3.5
"""Offset of a lane change [m]."""
SECTIONS = (30.0, 25.0, 25.0)
"""Lengths of the change, the other lane and the change back [m], as in ISO 3888-1."""
LANE_CHANGE_SPACING = 150.0
"""From one lane change to the next [m]."""


def smooth_path(
    key: Key,
    *,
    length: float,
    peak_curvature: float = 0.02,
    wavelengths: tuple[float, float] = (50.0, 160.0),
) -> Path:
    """Draw a path whose curvature is a sum of three sinusoids.

        κ(s) = Σᵢ aᵢ sin(2π s/λᵢ + φᵢ),   max |κ| = κ_max

    The curvature is blended in over the first metres, so that an episode starts on the
    path.

    Args:
        key: consumed.
        length: smallest length [m].
        peak_curvature: κ_max [1/m].
        wavelengths: range of λᵢ [m].
    """
    amplitude_key, wavelength_key, phase_key = jax.random.split(key, 3)
    s = jnp.arange(int(length / SPACING) + 2) * SPACING
    # At least 0.3, or one sinusoid could be left alone.
    amplitudes = jax.random.uniform(amplitude_key, (3, 1), minval=0.3, maxval=1.0)
    waves = jax.random.uniform(
        wavelength_key, (3, 1), minval=wavelengths[0], maxval=wavelengths[1]
    )
    phases = jax.random.uniform(phase_key, (3, 1), maxval=2 * jnp.pi)
    curvature = jnp.sum(amplitudes * jnp.sin(2 * jnp.pi * s / waves + phases), axis=0)
    blend = jnp.clip(s / RUN_UP, 0.0, 1.0)
    # Smoothstep: the curvature and its slope start at 0, as does the steering.
    curvature = curvature * blend**2 * (3.0 - 2.0 * blend)
    # After the blend, so that the peak is reached on the path that is driven.
    curvature = curvature * peak_curvature / jnp.max(jnp.abs(curvature))
    return path_from_curvature(curvature, spacing=SPACING)


def double_lane_change(key: Key, length: float) -> Path:
    """Change to the lane at a random side and back, once a period (ISO 3888-1).

    The heading of a change over ℓ is θ sin²(π s/ℓ), whose offset is close to θ ℓ / 2.
    The path is at least `length` long [m].
    """
    first, middle, last = SECTIONS
    start_key, side_key = jax.random.split(key)
    start = jax.random.uniform(start_key, (), minval=20.0, maxval=50.0)
    s = jnp.arange(int(length / SPACING) + 2) * SPACING - start
    s = jnp.where(s > 0, s % LANE_CHANGE_SPACING, s)  # straight until the first change

    def change(begin: float, over: float, towards: float) -> Float[Array, " point"]:
        share = jnp.clip((s - begin) / over, 0.0, 1.0)
        largest = 2.0 * LANE / over
        # Derivative of θ sin²(π s/ℓ): curvature is the slope of the heading.
        return towards * largest * jnp.pi / over * jnp.sin(2.0 * jnp.pi * share)

    # The change back is the mirror image, so that the car returns to its lane.
    curvature = change(0.0, first, 1.0) + change(first + middle, last, -1.0)
    side = jax.random.rademacher(side_key, (), dtype=float)
    return path_from_curvature(side * curvature, spacing=SPACING)
