"""Count how often predictions along closed-loop runs violate a certificate."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.rollout import (
    defects,
    in_batches,
    rollout,
    sliding_windows,
    state_errors,
)
from sfkd_jax.types import Model, Params, Scalar, Trajectory

STRIDE = 5
"""Steps from the start of one window to that of the next."""
ROUNDING = (1e-5, 1e-5)
"""Relative and absolute tolerance of latent errors: float32 rounds latents of size 10
to 1e-6, and 20 steps add up.
"""


class ClaimedBounds(NamedTuple):
    """Claims of a certificate about k = 1 … horizon steps ahead.

    Attributes:
        radii: of the tube, of position [m], yaw [rad] and body state.
        latent: R_k.
        d_bar: the one-step bound that R_k assumes.
    """

    radii: Float[Array, "horizon 3"]
    latent: Float[Array, " horizon"]
    d_bar: Scalar | float


def violations(
    model: Model,
    params: Params,
    runs: Trajectory,
    claims: ClaimedBounds,
    *,
    length: int,
) -> dict[str, Scalar]:
    """Return how often predictions from every `STRIDE`-th true state violate claims.

    Args:
        model: any model.
        params: of the model.
        runs: a batch; the environments are those that the model observes.
        claims: about the model.
        length: of a calibration trajectory; runs are cut into segments as long [steps].

    Returns:
        `v0`: the part of the steps before the first defect above d̄ with |e_k| > R_k,
        which the theorem excludes; NaN without such steps. `v1`: the part of the
        segments that leave the tube anywhere.
    """
    # V1 counts segments, because calibration did.
    segments = sliding_windows(runs, length=length, stride=length)

    def one(segment: Trajectory) -> tuple[Array, ...]:
        alone = jax.tree.map(lambda leaf: leaf[None], segment)
        horizon = len(claims.latent)
        windows = sliding_windows(alone, length=horizon, stride=STRIDE)
        each = jax.vmap(partial(_along_window, model, params, claims))
        inside, beyond, applies = each(windows)
        return jnp.all(inside), jnp.sum(beyond), jnp.sum(applies)

    inside, beyond, asked = in_batches(one, segments, size=16)
    shares = jnp.sum(beyond) / jnp.sum(asked), 1.0 - jnp.mean(inside)
    return dict(zip(("v0", "v1"), shares, strict=True))


def _along_window(
    model: Model, params: Params, claims: ClaimedBounds, window: Trajectory
) -> tuple[Array, Array, Array]:
    """Whether it stays in its tube; steps with |e_k| > R_k; steps of the theorem."""
    predicted, latents, along = rollout(model, params, window)
    gaps, _ = defects(model, params, window, along)
    seen = jax.vmap(model.observe)(along[1], latents, window.states[1:])
    # The true latent is read at the true state, as the theorem has it.
    gone = jax.vmap(model.vector)(seen) - jax.vmap(model.vector)(latents)
    # The theorem speaks of the steps before the first defect above d̄ only.
    small = jnp.linalg.norm(gaps, axis=1) <= claims.d_bar
    applies = jnp.cumprod(small).astype(bool)
    relative, absolute = ROUNDING
    bound = claims.latent * (1 + relative) + absolute
    # Negated, so that NaN counts as beyond.
    beyond = applies & ~(jnp.linalg.norm(gone, axis=1) <= bound)
    errors = state_errors(predicted, window.states[1:])
    # The pose of a path state is 0 throughout and would count as a perfect prediction.
    errors = errors[:, 3:] if model.along_path else errors
    edges = (1, 2) if model.along_path else (2, 3)
    kinds = jnp.split(errors, edges, axis=1)
    sizes = jnp.stack([jnp.linalg.norm(kind, axis=1) for kind in kinds], axis=1)
    return jnp.all(sizes <= claims.radii), beyond, applies
