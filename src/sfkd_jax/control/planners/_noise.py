"""Noise for sampling planners, with the same variance at every step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.types import Control, Key

Noise: TypeAlias = Float[Array, "horizon sample control"]
NoiseSampler: TypeAlias = Callable[[Key, int, Control], Noise]
"""(key, number of samples, standard deviation per control) -> perturbations."""

KINDS = ("ar1", "white", "coloured", "rbf", "spline")


def noise_sampler(
    kind: str = "ar1",
    *,
    horizon: int,
    correlation: float = 0.8,
    exponent: float = 2.0,
    knots: int = 5,
) -> NoiseSampler:
    """Return a sampler of ε = L w, w standard normal, every row of L of unit length.

        ar1       ε_{k+1} = ρ ε_k + √(1 − ρ²) w_k
        white     L = I
        coloured  power ∝ 1 / f^exponent; L a Cholesky factor of its Toeplitz covariance
        rbf       Gaussian bumps at `knots` times, each as wide as their distance
        spline    cubic Lagrange interpolation between `knots` equidistant values

    Args:
        kind: see above.
        horizon: number of steps.
        correlation: ρ.
        exponent: ≥ 0; 0 is white, 1 pink, 2 brown.
        knots: ≥ 2.

    Raises:
        ValueError: the kind is unknown, or a setting is out of its range.
    """
    if kind not in KINDS:
        raise ValueError(f"noise must be one of {', '.join(KINDS)}, got {kind!r}")
    if not 0 <= correlation <= 1:
        raise ValueError(f"noise_correlation must lie in [0, 1], got {correlation}")
    if exponent < 0:
        raise ValueError(f"noise_exponent must be at least 0, got {exponent}")
    if kind in ("rbf", "spline") and not 2 <= knots <= horizon:
        raise ValueError(f"noise_knots must lie in [2, {horizon}], got {knots}")
    # Its recursion needs no T x T factor.
    if kind == "ar1":
        return partial(_autoregressive, horizon, correlation)
    if kind == "white":
        return partial(_white, horizon)
    factor = _coloured(horizon, exponent) if kind == "coloured" else None
    if factor is None:
        factor = _bumps(horizon, knots) if kind == "rbf" else _spline(horizon, knots)
    # Rows of unit length: the same spread at every step.
    return partial(_correlated, factor / np.linalg.norm(factor, axis=1, keepdims=True))


def _white(steps: int, key: Key, num_samples: int, std: Control) -> Noise:
    """Independent noise."""
    return jax.random.normal(key, (steps, num_samples, std.shape[0])) * std[None, None]


def _autoregressive(
    horizon: int, correlation: float, key: Key, num_samples: int, std: Control
) -> Noise:
    """AR(1) noise that is stationary from its first step on."""
    white = _white(horizon, key, num_samples, std)
    fresh = jnp.sqrt(1.0 - correlation**2)

    def step(before: Array, new: Array) -> tuple[Array, Array]:
        now = correlation * before + fresh * new
        return now, now

    # From the first white value: it has the stationary variance already.
    _, rest = jax.lax.scan(step, white[0], white[1:])
    return jnp.concatenate([white[:1], rest])


def _correlated(
    factor: Float[np.ndarray, "horizon k"], key: Key, num_samples: int, std: Control
) -> Noise:
    """L w, times the standard deviation."""
    white = _white(factor.shape[1], key, num_samples, jnp.ones_like(std))
    # Full precision: accelerators otherwise round float32 factors to ten bits.
    shaped = jnp.einsum(
        "tk,kmc->tmc",
        jnp.asarray(factor, dtype=float),
        white,
        precision=jax.lax.Precision.HIGHEST,
    )
    return shaped * std[None, None]


def _bumps(horizon: int, knots: int) -> Float[np.ndarray, "horizon knots"]:
    """Gaussian bumps around equidistant times."""
    centres = np.linspace(0.0, horizon - 1.0, knots)
    steps = np.arange(horizon)[:, None]
    return np.exp(-0.5 * ((steps - centres[None]) / (centres[1] - centres[0])) ** 2)


def _coloured(horizon: int, exponent: float) -> Float[np.ndarray, "horizon horizon"]:
    """Cholesky factor of the covariance with spectrum 1 / f^exponent.

    The longest period is four horizons: a plan is a window of a longer stationary
    process, so its end is not correlated with its beginning as in a periodic one.
    """
    period = 4 * horizon
    frequency = np.arange(1, period // 2 + 1) / period
    power = frequency**-exponent
    lags = np.arange(horizon)
    covariance = np.cos(2 * np.pi * lags[:, None] * frequency[None]) @ (
        power / np.sum(power)
    )
    table = covariance[np.abs(lags[:, None] - lags[None])]
    # The spectrum is truncated, so the covariance may be singular by rounding.
    return np.linalg.cholesky(table + 1e-5 * np.eye(horizon))


def _spline(horizon: int, knots: int) -> Float[np.ndarray, "horizon knots"]:
    """Weights of cubic interpolation at each step between equidistant knots.

    With fewer than four knots, the order is lower.
    """
    times = np.arange(horizon) * (knots - 1.0) / (horizon - 1.0)
    order = min(4, knots)
    # The four knots around a time; at the ends, the first or last four.
    left = np.clip(np.floor(times).astype(int) - (order - 1) // 2, 0, knots - order)
    factor = np.zeros((horizon, knots))
    for step, (time, first) in enumerate(zip(times, left, strict=True)):
        near = first + np.arange(order)
        for knot in near:
            others = near[near != knot]
            factor[step, knot] = np.prod((time - others) / (knot - others))
    return factor
