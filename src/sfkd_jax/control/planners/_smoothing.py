"""Savitzky-Golay smoothing of a plan together with the controls applied before it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Plan: TypeAlias = Float[Array, "horizon control"]
Past: TypeAlias = Float[Array, "past control"]
Smoother: TypeAlias = Callable[[Past, Plan], Plan]


def plan_smoother(*, horizon: int, window: int, order: int) -> Smoother:
    """Return the function (past, plan) -> smoothed plan, ν̄_t = Σ_i H_hi ν_{t+i}.

    H projects a window onto polynomials by least squares. The past holds ν_{−h} …
    ν_{−1}. The last h steps, which have fewer than h steps after them, are those of the
    polynomial fitted to the last window. A plan that continues the past as a polynomial
    of degree `order` is therefore not changed.

    Args:
        horizon: T, more than h = (window − 1)/2.
        window: odd, or 0 to return plans unchanged.
        order: of the polynomial.

    Raises:
        ValueError: the window is even, too short, or too long for the horizon, or the
            order is negative or so high that the fit smooths nothing.

    Source: Savitzky and Golay (1964); for plans, Williams et al. (2018).
    """
    if window == 0:
        return lambda past, plan: plan
    if window < 3 or window % 2 == 0:
        raise ValueError(
            f"smoothing_window must be 0 (off) or odd and at least 3, got {window}"
        )
    if not 0 <= order <= window - 2:
        raise ValueError(
            f"smoothing_order must lie in [0, {window - 2}] for a window of {window}, "
            f"got {order}"
        )
    half = window // 2
    if horizon <= half:
        raise ValueError(
            f"smoothing_window {window} needs a horizon of at least {half + 1}, "
            f"got {horizon}"
        )
    # Scaled to [-1, 1]: powers of large integers would be ill-conditioned.
    basis, _ = np.linalg.qr(np.vander(np.arange(-half, half + 1) / half, order + 1))
    # A projection: polynomials up to the order pass unchanged.
    fit = basis @ basis.T
    rows = np.zeros((horizon, half + horizon))
    for step in range(horizon):
        # Where the window would end after the plan, it stays: a one-sided fit.
        late = max(0, step + half - (horizon - 1))
        rows[step, step - late : step - late + window] = fit[half + late]
    matrix = jnp.asarray(rows, dtype=float)

    def smooth(past: Past, plan: Plan) -> Plan:
        # Full precision: accelerators otherwise round float32 factors to ten bits.
        return jnp.matmul(
            matrix, jnp.concatenate([past, plan]), precision=jax.lax.Precision.HIGHEST
        )

    return smooth
