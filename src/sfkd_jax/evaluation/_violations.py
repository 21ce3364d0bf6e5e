"""Count how often predictions along closed-loop runs violate claimed bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.rollout import (
    defects,
    in_batches,
    prediction_errors,
    rollout,
    sliding_windows,
)
from sfkd_jax.types import Model, Params, Trajectory

STRIDE = 5
"""Steps from the start of one window to that of the next."""
KINDS = ("position_m", "yaw_rad", "body")
ROUNDING = (1e-5, 1e-5)
"""Relative and absolute tolerance of latent errors: float32 rounds latents of size 10
to 1e-6, and 20 steps add up.
"""


class Predictions(NamedTuple):
    """Open-loop predictions along segments, from every `STRIDE`-th true state.

    Errors of position [m], |yaw| [rad] and body state (2-norm); |e_k|, k = 1 … horizon;
    |d_j| of the step that leads to each of them.
    """

    errors: Float[Array, "segment window horizon 3"]
    latent_errors: Float[Array, "segment window horizon"]
    defects: Float[Array, "segment window horizon"]


class ClaimedBounds(NamedTuple):
    """Claims about the predictions of a model; None where there is no claim.

    Attributes:
        certified: tube of a certificate, radii by `KINDS`, each (horizon,).
        latent: R_1 … R_T of a certificate.
        d_bar: the one-step bound that the certificate assumes.
        threshold: δ*, one position error for all models [m].
    """

    certified: Mapping[str, Sequence[float]] | None = None
    latent: Float[np.ndarray, " horizon"] | None = None
    d_bar: float | None = None
    threshold: float | None = None


def predictions(
    model: Model, params: Params, runs: Trajectory, *, length: int, horizon: int
) -> Predictions:
    """Predict along runs, cut into segments as long as calibration trajectories.

    Args:
        model: any model.
        params: of the model.
        runs: a batch; the environments are those that the model observes.
        length: of a segment [steps].
        horizon: of a prediction [steps].
    """
    cut = jax.vmap(partial(sliding_windows, horizon=length, stride=length))
    # V1 counts segments, because calibration did.
    segments = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), cut(runs))

    def one(segment: Trajectory) -> Predictions:
        windows = sliding_windows(segment, horizon=horizon, stride=STRIDE)
        return jax.vmap(partial(_along_window, model, params))(windows)

    return in_batches(one, segments, size=16)


def _along_window(model: Model, params: Params, window: Trajectory) -> Predictions:
    """Predictions of one window; |e_k| = |z_k − ẑ_k| against the true latent z_k."""
    predicted, latents, along = rollout(model, params, window)
    gaps, _ = defects(model, params, window, along)
    seen = jax.vmap(model.observe)(along[1], latents, window.states[1:])
    # The true latent is read at the true state, as the theorem has it.
    gone = jax.vmap(model.vector)(seen) - jax.vmap(model.vector)(latents)
    return Predictions(
        errors=prediction_errors(predicted, window, along_path=model.along_path),
        latent_errors=jnp.linalg.norm(gone, axis=1),
        defects=jnp.linalg.norm(gaps, axis=1),
    )


def violations(predicted: Predictions | None, claims: ClaimedBounds) -> dict[str, Any]:
    """Return how often predictions, None of too short runs, violate claims.

    Returns:
        `v0`: the part of the steps before the first defect above d̄ with |e_k| > R_k,
        which the theorem excludes. `v0_ratio`: the largest |e_k| / R_k of these steps.
        `v1`: the part of the segments that leave the tube anywhere; `v1_radius_m`: its
        mean position radius. `v2`: the part of the windows with a position error above
        δ*. A rate without a claim is None.
    """
    tube, found = claims.certified, dict.fromkeys(("v0", "v0_ratio", "v1", "v2"))
    radius = float(np.mean(tube["position_m"])) if tube else None
    if predicted is None:
        return found | {"v1_radius_m": radius}
    errors, latent_errors, gaps = map(np.asarray, predicted)
    if claims.latent is not None and claims.d_bar is not None:
        # The theorem speaks of the steps before the first defect above d̄ only.
        applies = np.logical_and.accumulate(gaps <= claims.d_bar, axis=2)
        relative, absolute = ROUNDING
        bound = np.asarray(claims.latent) * (1 + relative) + absolute
        # Negated, here and below, so that NaN counts as beyond.
        beyond = ~(latent_errors <= bound)[applies]
        ratios = (latent_errors / np.asarray(claims.latent))[applies]
        if beyond.size:
            largest = float(np.max(ratios))
            found["v0"] = float(np.mean(beyond))
            found["v0_ratio"] = largest if np.isfinite(largest) else None
    if tube:
        radii = np.stack([np.asarray(tube[kind]) for kind in KINDS], axis=1)
        found["v1"] = float(np.mean(~np.all(errors <= radii, axis=(1, 2, 3))))
    if claims.threshold is not None:
        inside = np.all(errors[..., 0] <= claims.threshold, axis=2)
        found["v2"] = float(np.mean(~inside))
    return found | {"v1_radius_m": radius}
