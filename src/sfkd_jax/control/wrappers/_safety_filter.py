"""Safety filter: the share of a request that keeps a nominal copy in its corridor."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.geometry import LATERAL
from sfkd_jax.types import BODY, Control, Latent, Model, Scalar

FILTER_SCALES = (1.0, 0.875, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125, 0.0)
"""Scales of a request that are tried, largest first; 0 is the law alone."""


class FilterResult(NamedTuple):
    """The outcome of `safety_filter`.

    Attributes:
        nu: the perturbation of the law to apply, (2,).
        latent: of the nominal copy one step later.
        scale: s, of the request clipped to its limit; 0 while steering back.
        margin: width − max |ê_y| over the predicted steps [m]; −inf if not finite.
        feasible: whether the margin is at least 0.
    """

    nu: Control
    latent: Latent
    scale: Scalar
    margin: Scalar
    feasible: Bool[Array, ""]


def safety_filter(
    model: Model,
    fiber: Any,
    latent: Latent,
    request: Control,
    preview: Float[Array, "preview 2"],
    limit: Control,
    *,
    width: float,
) -> FilterResult:
    """Scale a request so that the law alone then keeps the copy in its corridor.

        ẑ_1 = F(ẑ_0; (s ν, κ_0, v_0), e),   ẑ_{k+1} = F(ẑ_k; (0, κ_k, v_k), e)
        margin(s) = width − max_k |ê_y,k|
        s = the largest of `FILTER_SCALES` with margin(s) ≥ 0

    The environment is constant over the prediction. One scale applies to both
    channels, so the control lies between the law, which is the backup, and the
    request, at the planner's ratio of steering to drive. If no scale passes, the
    result is the best margin of the law alone and of the largest steering to either
    side, so the predicted deviation never exceeds that of the law alone.

    Args:
        model: of the closed loop along a path.
        fiber: of e.
        latent: ẑ_0, of the nominal copy now.
        request: ν [rad, control unit]; a request that is not finite counts as 0.
        preview: κ_k [1/m] and v_k [m/s] over the next steps.
        limit: largest |ν|, entry by entry; the request is clipped to it.
        width: of the nominal corridor to each side [m].

    Returns:
        `FilterResult`; if no prediction is finite, the law alone with margin −inf.
    """
    clipped = jnp.clip(jnp.where(all_finite(request), request, 0.0), -limit, limit)
    steering_back = limit * jnp.asarray([[1.0, 0.0], [-1.0, 0.0]])
    scales = jnp.asarray((*FILTER_SCALES, 0.0, 0.0), dtype=float)
    scaled = scales[: len(FILTER_SCALES), None] * clipped
    candidates = jnp.concatenate([scaled, steering_back])

    def advance(
        latent: Latent, nu: Control, road: Float[Array, " 2"]
    ) -> tuple[Latent, Scalar]:
        after = model.step(fiber, latent, jnp.concatenate([nu, road]))
        return after, model.decode(fiber, after)[BODY][LATERAL]

    def law_alone(
        latents: Latent, road: Float[Array, " 2"]
    ) -> tuple[Latent, Float[Array, " candidate"]]:
        return jax.vmap(lambda latent: advance(latent, jnp.zeros(2), road))(latents)

    first, lateral = jax.vmap(lambda nu: advance(latent, nu, preview[0]))(candidates)
    _, later = jax.lax.scan(law_alone, first, preview[1:])
    deviations = jnp.max(jnp.abs(jnp.concatenate([lateral[None], later])), axis=0)
    margins = jnp.where(jnp.isfinite(deviations), width - deviations, -jnp.inf)

    passing = margins[: len(FILTER_SCALES)] >= 0.0
    law_index = len(FILTER_SCALES) - 1
    # In a tie argmax takes the first of the backups, which is the law.
    backup = law_index + jnp.argmax(margins[law_index:])
    chosen = jnp.where(jnp.any(passing), jnp.argmax(passing), backup)
    return FilterResult(
        nu=candidates[chosen],
        latent=jax.tree.map(lambda leaf: leaf[chosen], first),
        scale=scales[chosen],
        margin=margins[chosen],
        feasible=margins[chosen] >= 0.0,
    )
