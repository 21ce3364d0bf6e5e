"""Noise for sampling planners, with the same variance at every step."""

from __future__ import annotations

import math
from collections.abc import Callable
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


def correlated_noise(
    key: Key,
    *,
    num_samples: int,
    horizon: int,
    std: Float[Array, " control"],
    correlation: float,
) -> Noise:
    """Return stationary AR(1) noise, which has the same variance at every step.

        ε_{k+1} = ρ ε_k + √(1 − ρ²) w_k

    Args:
        key: consumed.
        num_samples: number of samples.
        horizon: number of steps.
        std: standard deviation per control, in control units.
        correlation: ρ in [0, 1).
    """
    white = (
        jax.random.normal(key, (horizon, num_samples, std.shape[0])) * std[None, None]
    )
    fresh = jnp.sqrt(1.0 - correlation**2)

    def step(before: Array, new: Array) -> tuple[Array, Array]:
        now = correlation * before + fresh * new
        return now, now

    _, rest = jax.lax.scan(step, white[0], white[1:])
    return jnp.concatenate([white[:1], rest])


def noise_sampler(
    kind: str = "ar1",
    *,
    horizon: int,
    correlation: float = 0.8,
    exponent: float = 2.0,
    knots: int = 5,
    halton: bool = False,
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
        halton: draw w from a randomly shifted Halton sequence instead of independent
            numbers. Best with few knots, since the sequence fills a space of knots x
            controls dimensions.

    Raises:
        ValueError: the kind is unknown, or a setting is out of its range.
    """
    factor = jnp.asarray(
        _factor(kind, horizon, correlation, exponent, knots), dtype=float
    )

    def draw(key: Key, num_samples: int, std: Control) -> Noise:
        if halton:
            w = _halton_normal(key, num_samples, (factor.shape[1], std.shape[0]))
        elif kind == "ar1":
            return correlated_noise(
                key,
                num_samples=num_samples,
                horizon=horizon,
                std=std,
                correlation=correlation,
            )
        else:
            w = jax.random.normal(key, (factor.shape[1], num_samples, std.shape[0]))
        # Full precision: accelerators otherwise round float32 factors to ten bits.
        return (
            jnp.einsum("tk,kmc->tmc", factor, w, precision=jax.lax.Precision.HIGHEST)
            * std[None, None]
        )

    return draw


def _factor(
    kind: str, horizon: int, correlation: float, exponent: float, knots: int
) -> Float[np.ndarray, "horizon k"]:
    """L of `noise_sampler`."""
    if kind not in KINDS:
        raise ValueError(f"noise must be one of {', '.join(KINDS)}, got {kind!r}")
    if not 0 <= correlation <= 1:
        raise ValueError(f"noise_correlation must lie in [0, 1], got {correlation}")
    if exponent < 0:
        raise ValueError(f"noise_exponent must be at least 0, got {exponent}")
    if kind in ("rbf", "spline") and not 2 <= knots <= horizon:
        raise ValueError(f"noise_knots must lie in [2, {horizon}], got {knots}")
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    steps = np.arange(horizon)
    if kind == "white":
        return np.eye(horizon)
    if kind == "ar1":
        lag = steps[:, None] - steps[None]
        fresh = np.where(steps == 0, 1.0, math.sqrt(1.0 - correlation**2))
        return np.where(lag >= 0, correlation ** np.maximum(lag, 0), 0.0) * fresh[None]
    if kind == "coloured":
        return _coloured(horizon, exponent)
    centres = np.linspace(0.0, horizon - 1.0, knots)
    width = centres[1] - centres[0]
    if kind == "rbf":
        factor = np.exp(-0.5 * ((steps[:, None] - centres[None]) / width) ** 2)
    else:
        factor = _spline(steps / width, knots)
    return factor / np.linalg.norm(factor, axis=1, keepdims=True)


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
    factor = np.linalg.cholesky(table + 1e-5 * np.eye(horizon))
    return factor / np.linalg.norm(factor, axis=1, keepdims=True)


def _spline(
    times: Float[np.ndarray, " horizon"], knots: int
) -> Float[np.ndarray, "horizon knots"]:
    """Weights of cubic interpolation at each time, in units of the knot distance.

    With fewer than four knots, the order is lower.
    """
    order = min(4, knots)
    left = np.clip(np.floor(times).astype(int) - (order - 1) // 2, 0, knots - order)
    columns = []
    for knot in range(knots):
        offset = knot - left
        weight = np.ones_like(times)
        for other in range(order):
            gap = np.where(offset == other, 1.0, offset - other)
            weight = weight * np.where(
                offset == other, 1.0, (times - left - other) / gap
            )
        columns.append(np.where((offset >= 0) & (offset < order), weight, 0.0))
    return np.stack(columns, axis=1)


def _halton_normal(
    key: Key, num_samples: int, shape: tuple[int, int]
) -> Float[Array, "k sample control"]:
    """Standard normal points of a Halton sequence with one random shift modulo 1.

    Source: Halton (1960); the shift is that of Cranley and Patterson (1976).
    """
    count = shape[0] * shape[1]
    index = jnp.arange(1, num_samples + 1)
    points = jnp.stack(
        [_radical_inverse(index, base, num_samples) for base in _primes(count)]
    )
    shifted = (points + jax.random.uniform(key, (count, 1))) % 1.0
    tiny = 1e-6
    return (
        jax.scipy.special.ndtri(jnp.clip(shifted, tiny, 1 - tiny))
        .reshape(*shape, num_samples)
        .swapaxes(1, 2)
    )


def _radical_inverse(index: Array, base: int, largest: int) -> Float[Array, " sample"]:
    """Mirror the digits of an index at the point: 6 = 110 in base 2 becomes 0.011."""
    total, scale = jnp.zeros(index.shape), 1.0 / base
    for _ in range(math.ceil(math.log(largest + 1, base))):
        total, index, scale = (
            total + scale * (index % base).astype(float),
            index // base,
            scale / base,
        )
    return total


def _primes(count: int) -> list[int]:
    """The first primes."""
    primes: list[int] = []
    candidate = 2
    while len(primes) < count:
        if all(candidate % prime for prime in primes):
            primes.append(candidate)
        candidate += 1
    return primes
