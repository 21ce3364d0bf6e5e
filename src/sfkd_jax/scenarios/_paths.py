"""Random smooth roads."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sfkd_jax.paths import SPACING, Path, path_from_curvature
from sfkd_jax.types import Key

RUN_UP = 20.0
"""Over which the curvature of a path is blended in [m]."""


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
