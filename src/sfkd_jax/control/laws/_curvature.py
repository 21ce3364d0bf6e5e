"""Noise shaped by the problem: wide where the cost of a plan is flat, narrow where it is steep."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.planners._plans import Plan, Plans
from sfkd_jax.types import Control, Scalar

FLATTEST = 1e-4
"""Smallest curvature against the largest: no direction is drawn more than ten times as
wide as another.
"""

Factor: TypeAlias = Float[Array, "horizon control horizon control"]


def curvature_factor(
    cost: Callable[[Plan], Scalar], plan: Plan, std: Control
) -> Factor:
    """F with F Fᵀ ∝ H^(−1/2), H the curvature of the cost of a plan in units of the standard deviations.

        H = S ∇²J(ν) S,  S = diag(std);   F = S V (D / D̄)^(−1/4) Vᵀ,  H = V D Vᵀ,  D̄ the geometric mean of D

    So the volume of the noise stays what `std` makes it. For a linear model and a
    quadratic cost this is the closed form G'QG + R of its matrices. Directions of
    negative curvature count as flat ones; where nothing is finite or curved at all, F =
    S.

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
    values = jnp.maximum(values / jnp.max(jnp.abs(values)), FLATTEST)
    widths = jnp.exp(-0.25 * (jnp.log(values) - jnp.mean(jnp.log(values))))
    factor = scale[:, None] * (vectors * widths) @ vectors.T
    return factor.reshape(*plan.shape, *plan.shape)


def shaped(factor: Factor, noise: Plans) -> Plans:
    """F n for every sample."""
    return jnp.einsum(
        "tcsd,smd->tmc", factor, noise, precision=jax.lax.Precision.HIGHEST
    )
