"""Perturbations for sampling planners: unit variance at every step, whatever their course over the horizon."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.types import Control, Key

Noise: TypeAlias = Float[Array, "horizon sample control"]
Sampler: TypeAlias = Callable[[Key, int, Control], Noise]
"""(key, number of samples, standard deviation per control) -> perturbations, shape
(horizon, sample, control).
"""

KINDS = ("ar1", "white", "coloured", "rbf", "spline")


def correlated_noise(
    key: Key,
    *,
    num_samples: int,
    horizon: int,
    std: Float[Array, " control"],
    correlation: float,
) -> Noise:
    """Stationary AR(1) noise, ε_{k+1} = ρ ε_k + √(1 − ρ²) w_k, so that every step has the same spread.

    Args:
        key: consumed.
        num_samples, horizon: how many, how long.
        std: per control channel, in control units.
        correlation: ρ in [0, 1).
    """
    white = jax.random.normal(key, (horizon, num_samples, std.shape[0])) * std
    fresh = jnp.sqrt(1.0 - correlation**2)

    def step(before: Array, new: Array) -> tuple[Array, Array]:
        now = correlation * before + fresh * new
        return now, now

    _, rest = jax.lax.scan(step, white[0], white[1:])
    return jnp.concatenate([white[:1], rest])


def sampler(
    kind: str = "ar1",
    *,
    horizon: int,
    correlation: float = 0.8,
    exponent: float = 2.0,
    knots: int = 5,
    halton: bool = False,
) -> Sampler:
    """ε = L w, w independent and standard normal, every row of L of unit length.

        ar1       ε_{k+1} = ρ ε_k + √(1 − ρ²) w_k
        white     L = I
        coloured  power ∝ 1 / f^exponent; L a Cholesky factor of its Toeplitz covariance
        rbf       bumps at `knots` places over the horizon, each as wide as their distance
        spline    cubic Lagrange interpolation between `knots` equidistant values

    Args:
        kind: see above.
        horizon: T.
        correlation: ρ.
        exponent: ≥ 0; 0 is white, 1 pink, 2 brown.
        knots: ≥ 2.
        halton: draw w from a Halton sequence, shifted at random each time, in place of
            independent numbers; best with few knots, since its points fill a space of
            knots x controls dimensions.

    Raises:
        ValueError: unknown kind, or settings that kind cannot have.
    """
    factor = _factor(kind, horizon, correlation, exponent, knots)

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
        # Full precision: accelerators otherwise round the factors of float32 products
        # to ten bits.
        return (
            jnp.einsum("tk,kmc->tmc", factor, w, precision=jax.lax.Precision.HIGHEST)
            * std
        )

    return draw


def _factor(
    kind: str, horizon: int, correlation: float, exponent: float, knots: int
) -> Float[Array, "horizon k"]:
    """L, see `sampler`."""
    if kind not in KINDS:
        raise ValueError(f"noise must be one of {', '.join(KINDS)}, got {kind!r}")
    if not 0 <= correlation <= 1:
        raise ValueError(f"noise_correlation must lie in [0, 1], got {correlation}")
    if exponent < 0:
        raise ValueError(f"noise_exponent must be at least 0, got {exponent}")
    if kind in ("rbf", "spline") and not 2 <= knots <= horizon:
        raise ValueError(f"noise_knots must lie in [2, {horizon}], got {knots}")
    steps = jnp.arange(horizon)
    if kind == "white":
        return jnp.eye(horizon)
    if kind == "ar1":
        lag = steps[:, None] - steps
        fresh = jnp.where(steps == 0, 1.0, math.sqrt(1.0 - correlation**2))
        return jnp.where(lag >= 0, correlation ** jnp.maximum(lag, 0), 0.0) * fresh
    if kind == "coloured":
        return _coloured(horizon, exponent)
    places = jnp.linspace(0.0, horizon - 1.0, knots)
    if kind == "rbf":
        factor = jnp.exp(
            -0.5 * ((steps[:, None] - places) / (places[1] - places[0])) ** 2
        )
    else:
        factor = _spline(steps / (places[1] - places[0]), knots)
    return factor / jnp.linalg.norm(factor, axis=1, keepdims=True)


def _coloured(horizon: int, exponent: float) -> Float[Array, "horizon horizon"]:
    """Cholesky factor of the covariance whose spectrum is 1 / f^exponent down to a period of four horizons.

    A window of a longer stationary process, not a period of its own: the end of a plan
    is not tied to its beginning.
    """
    period = 4 * horizon
    frequency = jnp.arange(1, period // 2 + 1) / period
    power = frequency**-exponent
    lags = jnp.arange(horizon)
    covariance = jnp.cos(2 * jnp.pi * lags[:, None] * frequency) @ (
        power / jnp.sum(power)
    )
    table = covariance[jnp.abs(lags[:, None] - lags)]
    factor = jnp.linalg.cholesky(table + 1e-5 * jnp.eye(horizon))
    return factor / jnp.linalg.norm(factor, axis=1, keepdims=True)


def _spline(
    times: Float[Array, " horizon"], knots: int
) -> Float[Array, "horizon knots"]:
    """Weights of the cubic (or lower, with fewer knots) through the knots around each time, in knot distances."""
    order = min(4, knots)
    left = jnp.clip(jnp.floor(times).astype(int) - (order - 1) // 2, 0, knots - order)
    columns = []
    for knot in range(knots):
        place = knot - left
        weight = jnp.ones_like(times)
        for other in range(order):
            gap = jnp.where(place == other, 1.0, place - other)
            weight = weight * jnp.where(
                place == other, 1.0, (times - left - other) / gap
            )
        columns.append(jnp.where((place >= 0) & (place < order), weight, 0.0))
    return jnp.stack(columns, axis=1)


def _halton_normal(
    key: Key, num_samples: int, shape: tuple[int, int]
) -> Float[Array, "k sample control"]:
    """Standard normal points of a Halton sequence, moved by one random shift around the unit cube.

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
    """The digits of an index in a base, mirrored at the point: 6 = 110 in base 2 becomes 0.011."""
    total, scale = jnp.zeros(index.shape), 1.0 / base
    for _ in range(math.ceil(math.log(largest + 1, base))):
        total, index, scale = (
            total + scale * (index % base),
            index // base,
            scale / base,
        )
    return total


def _primes(count: int) -> list[int]:
    """The first primes."""
    found: list[int] = []
    candidate = 2
    while len(found) < count:
        if all(candidate % prime for prime in found):
            found.append(candidate)
        candidate += 1
    return found
