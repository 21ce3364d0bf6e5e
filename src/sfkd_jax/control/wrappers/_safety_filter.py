"""How much of a request next to a path-following law keeps a nominal copy in its corridor."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.core.path_frame import LATERAL
from sfkd_jax.types import BODY, Control, Latent, Model, Scalar

FILTER_SCALES = (1.0, 0.875, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125, 0.0)
"""Shares of a request that are tried, largest first; the last one is the law alone."""


class FilterResult(NamedTuple):
    """What is let through of a request.

    Attributes:
        nu: the perturbation of the law to apply, (2,).
        latent: of the nominal copy one step later.
        share: s, of the request within its limits; 0 while steering back.
        margin: width − max |ê_y| over the predicted steps [m]; −inf if not finite.
        feasible: whether that margin is at least 0.
    """

    nu: Control
    latent: Latent
    share: Scalar
    margin: Scalar
    feasible: Bool[Array, ""]


def safety_filter(
    model: Model,
    fiber: Any,
    latent: Latent,
    wanted: Control,
    ahead: Float[Array, "preview 2"],
    limit: Control,
    *,
    width: float,
) -> FilterResult:
    """The largest share of a request after which the law alone keeps the copy in its corridor.

        ẑ_1 = F(ẑ_0; (s ν, κ_0, v_0), e),   ẑ_{k+1} = F(ẑ_k; (0, κ_k, v_k), e),
        margin(s) = width − max_k |ê_y,k|,   s = the largest of `SHARES` with margin(s) ≥ 0

    e is held. Both channels are scaled by one s: what is applied then lies between the
    law, which is the backup, and the request, at the planner's ratio of steering to
    drive. If no share passes, the law alone competes with the largest steering to
    either side and the largest margin wins, so the predicted deviation never exceeds
    that of the law alone.

    Args:
        model: of the closed loop along a path.
        fiber: of e.
        latent: ẑ_0, of the nominal copy now.
        wanted: ν asked for [rad, control unit]; 0 is taken for one that is not finite.
        ahead: κ_k [1/m] and v_k [m/s] over the next steps.
        limit: largest |ν|, entry by entry; the request is clipped to it.
        width: of the nominal corridor to each side [m].

    Returns:
        `Admitted`; if no prediction is finite, the law alone with margin −inf.
    """
    asked = jnp.clip(jnp.where(all_finite(wanted), wanted, 0.0), -limit, limit)
    aside = limit * jnp.asarray([[1.0, 0.0], [-1.0, 0.0]])
    shares = jnp.asarray((*FILTER_SCALES, 0.0, 0.0), dtype=float)
    tried = jnp.concatenate([shares[: len(FILTER_SCALES), None] * asked, aside])

    def advance(
        latent: Latent, nu: Control, road: Float[Array, " 2"]
    ) -> tuple[Latent, Scalar]:
        after = model.step(fiber, latent, jnp.concatenate([nu, road]))
        return after, model.decode(fiber, after)[BODY][LATERAL]

    def alone(
        latents: Latent, road: Float[Array, " 2"]
    ) -> tuple[Latent, Float[Array, " tried"]]:
        return jax.vmap(lambda latent: advance(latent, jnp.zeros(2), road))(latents)

    first, beside = jax.vmap(lambda nu: advance(latent, nu, ahead[0]))(tried)
    _, later = jax.lax.scan(alone, first, ahead[1:])
    deviations = jnp.max(jnp.abs(jnp.concatenate([beside[None], later])), axis=0)
    margins = jnp.where(jnp.isfinite(deviations), width - deviations, -jnp.inf)

    passing = margins[: len(FILTER_SCALES)] >= 0.0
    backup = (
        len(FILTER_SCALES) - 1 + jnp.argmax(margins[len(FILTER_SCALES) - 1 :])
    )  # the law wins a tie
    chosen = jnp.where(jnp.any(passing), jnp.argmax(passing), backup)
    return FilterResult(
        nu=tried[chosen],
        latent=jax.tree.map(lambda leaf: leaf[chosen], first),
        share=shares[chosen],
        margin=margins[chosen],
        feasible=margins[chosen] >= 0.0,
    )
