"""The safety filter of the shield along a path: it keeps |ê_y| inside the corridor."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control import FilterResult, safety_filter
from sfkd_jax.driving.path_coordinates import LATERAL
from sfkd_jax.types import BODY, Control, Fiber, Latent, Model


def corridor_filter(
    model: Model,
    fiber: Fiber,
    latent: Latent,
    request: Control,
    preview: Float[Array, "preview 2"],
    limit: Control,
    *,
    width: float,
) -> FilterResult:
    """Apply `safety_filter` to e_y; the backups are the largest steering to each side.

    Args:
        model: of the closed loop along a path.
        fiber: of e.
        latent: ẑ_0, of the nominal model now.
        request: ν [rad, control unit]; a request that is not finite counts as 0.
        preview: κ_k [1/m] and v_k [m/s] over the next steps.
        limit: largest |ν|, entry by entry; the request is clipped to it.
        width: of the nominal corridor to each side [m].
    """
    return safety_filter(
        model,
        fiber,
        latent,
        request,
        preview,
        limit,
        outputs=((BODY.start + LATERAL,),),
        widths=(width,),
        backups=limit * jnp.asarray([[1.0, 0.0], [-1.0, 0.0]]),
    )
