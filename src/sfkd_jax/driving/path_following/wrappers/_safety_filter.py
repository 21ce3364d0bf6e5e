"""The predictive safety filter of the shield: how much of a request may pass."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control import all_finite
from sfkd_jax.driving.path_coordinates import LATERAL
from sfkd_jax.types import BODY, Control, Fiber, Latent, Model, Scalar

FILTER_SCALES = (1.0, 0.875, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125, 0.0)
"""Scales of a request that are tried, largest first; 0 is the law alone."""


class FilterResult(NamedTuple):
    """The outcome of `safety_filter`.

    Attributes:
        nu: the perturbation of the law to apply, (2,).
        latent: of the nominal model one step later.
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
    fiber: Fiber,
    latent: Latent,
    request: Control,
    preview: Float[Array, "preview 2"],
    limit: Control,
    *,
    width: float,
) -> FilterResult:
    """Scale a request so that the law alone then keeps the nominal model inside.

        ẑ_1 = F(ẑ_0; (s ν, κ_0, v_0), e),   ẑ_{k+1} = F(ẑ_k; (0, κ_k, v_k), e)
        margin(s) = width − max_k |ê_y,k|
        s = the largest of `FILTER_SCALES` with margin(s) ≥ 0

    The environment is constant over the prediction. One scale applies to both controls,
    so the result lies between the law, which is the backup, and the request, and has
    the planner's ratio of steering to drive. If no scale passes, the result is the
    candidate with the best margin among the law alone and the largest steering to
    either side. The predicted deviation therefore never exceeds that of the law alone.

    Args:
        model: of the closed loop along a path.
        fiber: of e.
        latent: ẑ_0, of the nominal model now.
        request: ν [rad, control unit]; a request that is not finite counts as 0.
        preview: κ_k [1/m] and v_k [m/s] over the next steps.
        limit: largest |ν|, entry by entry; the request is clipped to it.
        width: of the nominal corridor to each side [m].

    Returns:
        `FilterResult`; if no prediction is finite, the law alone with margin −inf.
    """
    clipped = jnp.clip(jnp.where(all_finite(request), request, 0.0), -limit, limit)
    steering_back = limit * jnp.asarray([[1.0, 0.0], [-1.0, 0.0]])
    # The candidates are the request at every scale and, with scale 0, the steering to
    # either side. The law alone is the last of the scaled requests.
    scales = jnp.asarray((*FILTER_SCALES, 0.0, 0.0), dtype=float)
    scaled = scales[: len(FILTER_SCALES), None] * clipped
    candidates = jnp.concatenate([scaled, steering_back])
    law_index = len(FILTER_SCALES) - 1

    def advance(
        latent: Latent, nu: Control, road: Float[Array, " 2"]
    ) -> tuple[Latent, Scalar]:
        after = model.step(fiber, latent, jnp.concatenate([nu, road]))
        return after, model.decode(fiber, after)[BODY][LATERAL]

    def law_alone(
        latents: Latent, road: Float[Array, " 2"]
    ) -> tuple[Latent, Float[Array, " candidate"]]:
        advance_all = jax.vmap(advance, in_axes=(0, None, None))
        return advance_all(latents, jnp.zeros(2), road)

    apply_all = jax.vmap(advance, in_axes=(None, 0, None))
    first, lateral = apply_all(latent, candidates, preview[0])
    _, later = jax.lax.scan(law_alone, first, preview[1:])
    deviations = jnp.max(jnp.abs(jnp.concatenate([lateral[None], later])), axis=0)
    margins = jnp.where(jnp.isfinite(deviations), width - deviations, -jnp.inf)

    passing = margins[: len(FILTER_SCALES)] >= 0.0
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
