"""The predictive safety filter of a shield: how much of a request may pass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._finite import all_finite
from sfkd_jax.types import Control, Fiber, Latent, Model, Scalar

FILTER_SCALES = (1.0, 0.875, 0.75, 0.625, 0.5, 0.375, 0.25, 0.125, 0.0)
"""Scales of a request that are tried, largest first; 0 is the law alone."""
ROUNDING = 1e-5
"""Share by which a request at its limit may exceed it."""
Rows: TypeAlias = Sequence[int]
"""Entries of a state that are an output."""


class FilterResult(NamedTuple):
    """The outcome of `safety_filter`.

    Attributes:
        nu: the perturbation of the law to apply, (control,).
        latent: of the nominal model one step later.
        scale: smallest share of an entry of the request that passes: s, or less where
            the limit clips the request; 0 for a backup.
        margin: smallest width − max |ŷ| of an output over the predicted steps, in its
            unit; −inf if not finite.
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
    inputs: Float[Array, "preview inputs"],
    limit: Control,
    *,
    outputs: Sequence[Rows],
    widths: Sequence[float],
    backups: Float[Array, "backup control"],
) -> FilterResult:
    """Scale a request so that the law alone then keeps the nominal model inside.

        ẑ_1 = F(ẑ_0; (s ν, ρ_0), e),   ẑ_{k+1} = F(ẑ_k; (0, ρ_k), e)
        margin(s) = min_i (width_i − max_k |ŷ_i,k|)
        s = the largest of `FILTER_SCALES` with margin(s) ≥ 0

    The environment is constant over the prediction. One scale applies to all controls,
    so the result lies between the law, which is the first backup, and the request. If
    no scale passes, the result is the candidate with the best margin among the law
    alone and the other backups. The predicted deviation therefore never exceeds that of
    the law alone.

    Args:
        model: of the closed loop.
        fiber: of e.
        latent: ẑ_0, of the nominal model now.
        request: ν; a request that is not finite counts as 0.
        inputs: ρ_k of the next steps.
        limit: largest |ν|, entry by entry; the request is clipped to it.
        outputs: entries of a state that are each output; |ŷ| is their 2-norm.
        widths: largest |ŷ| of each output, in its unit.
        backups: further ν that are tried where no scale passes.

    Returns:
        `FilterResult`; if no prediction is finite, the law alone with margin −inf.

    Source: Wabersich and Zeilinger (2021), Automatica 129, 109597.
    """
    finite = jnp.where(all_finite(request), request, 0.0)
    clipped = jnp.clip(finite, -limit, limit)
    size = jnp.abs(finite)
    # A planner at its limit asks for no more than that, but for rounding.
    is_clipped = size > (1.0 + ROUNDING) * limit
    share = jnp.min(jnp.where(is_clipped, limit / size, 1.0))
    # The candidates are the request at every scale and, with scale 0, the backups. The
    # law alone is the last of the scaled requests.
    zeros = (0.0,) * len(backups)
    scales = jnp.asarray((*FILTER_SCALES, *zeros), dtype=float)
    scaled = scales[: len(FILTER_SCALES), None] * clipped
    candidates = jnp.concatenate([scaled, backups])
    law_index = len(FILTER_SCALES) - 1

    def advance(
        latent: Latent, nu: Control, inputs: Float[Array, " inputs"]
    ) -> tuple[Latent, Float[Array, " output"]]:
        after = model.step(fiber, latent, jnp.concatenate([nu, inputs]))
        state = model.decode(fiber, after)
        return after, jnp.stack([size_of(state, rows) for rows in outputs])

    def law_alone(
        latents: Latent, inputs: Float[Array, " inputs"]
    ) -> tuple[Latent, Float[Array, "candidate output"]]:
        advance_all = jax.vmap(advance, in_axes=(0, None, None))
        return advance_all(latents, jnp.zeros_like(limit), inputs)

    apply_all = jax.vmap(advance, in_axes=(None, 0, None))
    first, sizes = apply_all(latent, candidates, inputs[0])
    _, later = jax.lax.scan(law_alone, first, inputs[1:])
    deviations = jnp.max(jnp.concatenate([sizes[None], later]), axis=0)
    room = jnp.min(jnp.asarray(widths, dtype=float) - deviations, axis=1)
    is_finite = jnp.all(jnp.isfinite(deviations), axis=1)
    margins = jnp.where(is_finite, room, -jnp.inf)

    passing = margins[: len(FILTER_SCALES)] >= 0.0
    # In a tie argmax takes the first of the backups, which is the law.
    backup = law_index + jnp.argmax(margins[law_index:])
    chosen = jnp.where(jnp.any(passing), jnp.argmax(passing), backup)
    return FilterResult(
        nu=candidates[chosen],
        latent=jax.tree.map(lambda leaf: leaf[chosen], first),
        scale=share * scales[chosen],
        margin=margins[chosen],
        feasible=margins[chosen] >= 0.0,
    )


def size_of(state: Float[Array, " state"], rows: Rows) -> Scalar:
    """Return |y| of an output, the 2-norm of its entries of a state."""
    if len(rows) == 1:
        return jnp.abs(state[rows[0]])
    return jnp.linalg.norm(state[jnp.asarray(rows)])
