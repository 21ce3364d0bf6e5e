"""Savitzky-Golay smoothing of a plan together with the controls applied before it."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Plan: TypeAlias = Float[Array, "horizon control"]
Past: TypeAlias = Float[Array, "past control"]
Smoother: TypeAlias = Callable[[Past, Plan], Plan]


def savitzky_golay_weights(*, window: int, order: int) -> list[list[Fraction]]:
    """Return the weights of the least-squares polynomial at each point of a window.

        H_ij = Σ_n q_n(i) q_n(j) / |q_n|²
        q_{n+1}(i) = i q_n(i) − (|q_n|² / |q_{n−1}|²) q_{n−1}(i),   q_0 = 1

    The q_n are the polynomials orthogonal over i = −h … h, h = (window − 1)/2. They are
    computed in exact rationals.

    Args:
        window: odd, at least 3.
        order: of the polynomial.

    Returns:
        H, window x window; row h is the filter, the rows after it are the one-sided
        fits at the end of the window.

    Raises:
        ValueError: the window is even or too short, or the order is negative or so
            high that the fit smooths nothing.

    Source: Savitzky and Golay (1964); the recurrence is Gram's.
    """
    if window < 3 or window % 2 == 0:
        raise ValueError(
            f"smoothing_window must be 0 (off) or odd and at least 3, got {window}"
        )
    if not 0 <= order <= window - 2:
        raise ValueError(
            f"smoothing_order must lie in [0, {window - 2}] for a window of {window}, "
            f"got {order}"
        )
    points = range(-(window // 2), window // 2 + 1)
    before, size_before = [Fraction(0)] * window, Fraction(1)
    now, basis = [Fraction(1)] * window, []
    for _ in range(order + 1):
        size = sum((value**2 for value in now), Fraction(0))
        basis.append((now, size))
        after = [
            i * a - size / size_before * b
            for i, a, b in zip(points, now, before, strict=True)
        ]
        before, size_before, now = now, size, after
    entries = range(window)
    return [
        [sum((q[i] * q[j] / size for q, size in basis), Fraction(0)) for j in entries]
        for i in entries
    ]


def plan_smoother(*, horizon: int, window: int, order: int) -> Smoother:
    """Return the function (past, plan) -> smoothed plan, ν̄_t = Σ_i H_hi ν_{t+i}.

    The past holds ν_{−h} … ν_{−1}. The last h steps, which have fewer than h steps
    after them, are those of the polynomial fitted to the last window. A plan that
    continues the past as a polynomial of degree `order` is therefore not changed.

    Args:
        horizon: T, more than h = (window − 1)/2.
        window: odd, or 0 to return plans unchanged.
        order: of the polynomial.

    Raises:
        ValueError: as `savitzky_golay_weights`, or the horizon is too short for the
            window.

    Source: Williams et al. (2018), Information-Theoretic Model Predictive Control, T-RO
    34(6).
    """
    if window == 0:
        return lambda past, plan: plan
    weights = savitzky_golay_weights(window=window, order=order)
    half = window // 2
    if horizon <= half:
        raise ValueError(
            f"smoothing_window {window} needs a horizon of at least {half + 1}, "
            f"got {horizon}"
        )
    rows = []
    for step in range(horizon):
        late = max(0, step + half - (horizon - 1))
        start = step - late
        rows.append(
            [0.0] * start
            + [float(w) for w in weights[half + late]]
            + [0.0] * (horizon - 1 - half - start)
        )
    matrix = jnp.asarray(rows)

    def smooth(past: Past, plan: Plan) -> Plan:
        # Full precision: accelerators otherwise round float32 factors to ten bits.
        return jnp.matmul(
            matrix, jnp.concatenate([past, plan]), precision=jax.lax.Precision.HIGHEST
        )

    return smooth
