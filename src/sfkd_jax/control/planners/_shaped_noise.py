"""Sampling noise shaped by the cost: wide where it is flat, narrow where steep."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._plans import Plan, Plans
from sfkd_jax.types import Control, Scalar

MIN_CURVATURE = 1e-4
"""Floor of the curvature relative to the largest: the widths of two directions differ
by at most a factor of ten.
"""

Factor: TypeAlias = Float[Array, "horizon control horizon control"]


def curvature_factor(
    cost: Callable[[Plan], Scalar], plan: Plan, std: Control
) -> Factor:
    """Return F with F Fᵀ ∝ H^(−1/2), H the scaled Hessian of the cost of a plan.

        H = S ∇²J(ν) S,   S = diag(std)
        F = S V (D / D̄)^(−1/4) Vᵀ,   H = V D Vᵀ,   D̄ the geometric mean of D

    The volume of the noise is therefore that of `std`. For a linear model and a
    quadratic cost, H is the closed form G'QG + R. Directions of negative curvature
    count as flat. If the Hessian is not finite or zero, F = S.

    Args:
        cost: of a plan; twice differentiable.
        plan: ν.
        std: standard deviation per control.

    Source: Yi et al. (2024), CoVO-MPC: Theoretical Analysis of Sampling-based MPC and
    Optimal Covariance Design.
    """
    size = plan.size
    scale = jnp.broadcast_to(std, plan.shape).ravel()
    hessian = jax.hessian(lambda flat: cost(plan + flat.reshape(plan.shape)))(
        jnp.zeros(size)
    )
    hessian = scale[:, None] * 0.5 * (hessian + hessian.T) * scale
    usable = jnp.all(jnp.isfinite(hessian)) & jnp.any(hessian != 0)
    values, vectors = jnp.linalg.eigh(jnp.where(usable, hessian, jnp.eye(size)))
    values = jnp.maximum(values / jnp.max(jnp.abs(values)), MIN_CURVATURE)
    widths = jnp.exp(-0.25 * (jnp.log(values) - jnp.mean(jnp.log(values))))
    factor = scale[:, None] * (vectors * widths) @ vectors.T
    return factor.reshape(*plan.shape, *plan.shape)


def shape_noise(factor: Factor, noise: Plans) -> Plans:
    """Return F n for every sample n."""
    return jnp.einsum(
        "tcsd,smd->tmc", factor, noise, precision=jax.lax.Precision.HIGHEST
    )
