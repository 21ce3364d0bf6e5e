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

Tube = Mapping[str, Sequence[float]]


class Predictions(NamedTuple):
    """Open-loop predictions along segments, from every `STRIDE`-th true state.

    Attributes:
        errors: position [m], |yaw| [rad], body state (2-norm).
        latent_errors: |e_k|, k = 1 … horizon.
        defects: |d_j| of the step that leads to each of them.
    """

    errors: Float[Array, "segment window horizon 3"]
    latent_errors: Float[Array, "segment window horizon"]
    defects: Float[Array, "segment window horizon"]


class ClaimedBounds(NamedTuple):
    """Claims about the predictions of a model; None where there is no claim.

    Attributes:
        certified: tube of a certificate, radii by `KINDS`, each (horizon,).
        level: 1 − δ.
        latent: R_1 … R_T of a certificate.
        d_bar: the one-step bound that the certificate assumes.
        threshold: δ*, one position error for all models [m].
    """

    certified: Tube | None = None
    level: float | None = None
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
        length: of a segment, that of a calibration trajectory.
        horizon: steps.

    Raises:
        ValueError: runs shorter than a segment, or segments shorter than the horizon.
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


def tube_violations(
    errors: Float[np.ndarray, "segment window horizon 3"], tube: Tube
) -> float:
    """Return V1: the part of the segments that leave the tube anywhere."""
    radii = np.stack([np.asarray(tube[kind]) for kind in KINDS], axis=1)
    # Negated, so that NaN counts as outside.
    return float(np.mean(~np.all(np.asarray(errors) <= radii, axis=(1, 2, 3))))


def theorem_violations(
    latent_errors: Float[np.ndarray, "segment window horizon"],
    defects: Float[np.ndarray, "segment window horizon"],
    latent: Float[np.ndarray, " horizon"],
    d_bar: float,
) -> tuple[float | None, list[float | None]]:
    """Return V0 and the largest |e_k| / R_k of every k, where |d_1| … |d_k| ≤ d̄.

    V0 is the part of these steps with |e_k| > R_k, which the theorem excludes. It is 0
    for any bound that is loose enough; the ratio, at most 1, shows how tight the bound
    is, so it changes when α, d̄ or the model is not as claimed. Both are None where no
    step has such small defects.
    """
    # The theorem speaks of the steps before the first defect above d̄ only.
    applies = np.logical_and.accumulate(np.asarray(defects) <= d_bar, axis=2)
    latent_errors, latent = np.asarray(latent_errors), np.asarray(latent)
    relative, absolute = ROUNDING
    # Negated, so that NaN counts as beyond.
    beyond = ~(latent_errors <= latent * (1 + relative) + absolute)
    count = int(np.sum(applies))
    rate = int(np.sum(applies & beyond)) / count if count else None
    ratios = np.where(applies, latent_errors / latent, -np.inf).max(axis=(0, 1))
    return rate, [float(ratio) if np.isfinite(ratio) else None for ratio in ratios]


def threshold_violations(
    errors: Float[np.ndarray, "segment window horizon 3"], threshold: float
) -> float:
    """Return V2: the part of the windows with a position error above δ*."""
    return float(np.mean(~np.all(np.asarray(errors)[..., 0] <= threshold, axis=2)))


def violations(predicted: Predictions | None, claims: ClaimedBounds) -> dict[str, Any]:
    """Return the violation rates V0, V1, V2 and tube radii as results.json has them.

    A rate without a claim is null.
    """
    tube = claims.certified
    v0, ratios, v1, v2, error = None, None, None, None, None
    if predicted is not None:
        errors = np.asarray(predicted.errors)
        v1 = tube_violations(errors, tube) if tube else None
        if claims.latent is not None and claims.d_bar is not None:
            seen, gaps = map(np.asarray, (predicted.latent_errors, predicted.defects))
            v0, ratios = theorem_violations(seen, gaps, claims.latent, claims.d_bar)
        if claims.threshold is not None:
            v2 = threshold_violations(errors, claims.threshold)
        worst = np.max(errors[..., 0], axis=2)
        p95 = float(np.quantile(worst, 0.95))
        error = {"median": float(np.median(worst)), "p95": p95}
    return {
        "v0": v0,
        "v0_reach": ratios,
        "v1": v1,
        "v1_radius_m": float(np.mean(tube["position_m"])) if tube else None,
        "v1_level": claims.level,
        "v2": v2,
        "v2_threshold_m": claims.threshold,
        "window_error_m": error,
        "segments": predicted and len(predicted.errors),
    }
