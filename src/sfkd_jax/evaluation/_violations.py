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
        conformal: tube of calibration runs, in the same form.
        level: 1 − δ of both.
        latent: R_1 … R_T of a certificate.
        d_bar: the one-step bound that the certificate assumes.
        threshold: δ*, one position error for all models [m].
    """

    certified: Tube | None = None
    conformal: Tube | None = None
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
    gone = jax.vmap(model.vector)(seen) - jax.vmap(model.vector)(latents)
    return Predictions(
        errors=prediction_errors(predicted, window, along_path=model.along_path),
        latent_errors=jnp.linalg.norm(gone, axis=1),
        defects=jnp.linalg.norm(gaps, axis=1),
    )


def tube_violations(
    errors: Float[np.ndarray, "segment window horizon 3"], tube: Tube
) -> tuple[int, int]:
    """Return V1: the number of segments that leave the tube anywhere, and their total.

    NaN counts as outside.
    """
    radii = np.stack([np.asarray(tube[kind]) for kind in KINDS], axis=1)
    # NaN compares false, so it counts as outside.
    inside = np.all(np.asarray(errors) <= radii, axis=(1, 2, 3))
    return int(np.sum(~inside)), len(inside)


def theorem_violations(
    latent_errors: Float[np.ndarray, "segment window horizon"],
    defects: Float[np.ndarray, "segment window horizon"],
    latent: Float[np.ndarray, " horizon"],
    d_bar: float,
) -> tuple[int, int]:
    """Return V0: steps with |e_k| > R_k though |d_1| … |d_k| ≤ d̄, and the total.

    The theorem excludes such steps.
    """
    # The theorem speaks of the steps before the first defect above d̄ only.
    applies = np.logical_and.accumulate(np.asarray(defects) <= d_bar, axis=2)
    relative, absolute = ROUNDING
    # Negated, so that NaN counts as beyond.
    beyond = ~(
        np.asarray(latent_errors) <= np.asarray(latent) * (1 + relative) + absolute
    )
    return int(np.sum(applies & beyond)), int(np.sum(applies))


def theorem_reach(
    latent_errors: Float[np.ndarray, "segment window horizon"],
    defects: Float[np.ndarray, "segment window horizon"],
    latent: Float[np.ndarray, " horizon"],
    d_bar: float,
) -> list[float | None]:
    """Return the largest |e_k| / R_k of every k where |d_1| … |d_k| ≤ d̄, else None.

    At most 1 by the theorem. V0 is 0 for any bound that is loose enough; this ratio
    shows how tight the bound is, so it changes when α, d̄ or the model is not as
    claimed.
    """
    applies = np.logical_and.accumulate(np.asarray(defects) <= d_bar, axis=2)
    shares = np.where(
        applies, np.asarray(latent_errors) / np.asarray(latent), -np.inf
    ).max(axis=(0, 1))
    return [float(share) if np.isfinite(share) else None for share in shares]


def threshold_violations(
    errors: Float[np.ndarray, "segment window horizon 3"], threshold: float
) -> tuple[int, int]:
    """Return V2: the number of windows with an error above δ*, and their total."""
    inside = np.all(np.asarray(errors)[..., 0] <= threshold, axis=2)
    return int(np.sum(~inside)), inside.size


def violations(predicted: Predictions | None, claims: ClaimedBounds) -> dict[str, Any]:
    """Return the violation rates V0, V1, V2 and tube radii as results.json has them.

    A rate without a claim is null. V1 is of the certified tube if there is one, else of
    the conformal tube (`v1_tube` names it).
    """
    tubes = {"certified": claims.certified, "conformal": claims.conformal}
    shares = {
        name: _share(tube_violations, predicted and predicted.errors, tube)
        for name, tube in tubes.items()
    }
    radii = {
        name: tube and float(np.mean(tube["position_m"]))
        for name, tube in tubes.items()
    }
    # A proved tube comes first; a measured one stands in where there is none.
    kind = next((name for name, tube in tubes.items() if tube), None)
    claimed = (
        predicted and predicted.latent_errors,
        predicted and predicted.defects,
        claims.latent,
        claims.d_bar,
    )
    return {
        "v0": _share(theorem_violations, *claimed),
        "v0_reach": _unless_missing(theorem_reach, *claimed),
        "v1": shares[kind] if kind else None,
        "v1_tube": kind,
        "v1_radius_m": radii[kind] if kind else None,
        "v1_conformal": shares["conformal"],
        "v1_conformal_radius_m": radii["conformal"],
        "v1_level": claims.level,
        "v2": _share(
            threshold_violations, predicted and predicted.errors, claims.threshold
        ),
        "v2_threshold_m": claims.threshold,
        "window_error_m": predicted
        and _quantiles(np.max(predicted.errors[..., 0], axis=2)),
        "segments": predicted and len(predicted.errors),
    }


def _share(count: Any, *inputs: Any) -> float | None:
    """A count over its total; None if an input is missing or the total is 0."""
    counted = _unless_missing(count, *inputs)
    return counted[0] / counted[1] if counted and counted[1] else None


def _unless_missing(measure: Any, *inputs: Any) -> Any:
    """A measure, or None if any input is missing."""
    return None if any(value is None for value in inputs) else measure(*inputs)


def _quantiles(errors: Float[np.ndarray, "segment window"]) -> dict[str, float]:
    """Median and 95 % quantile."""
    return {"median": float(np.median(errors)), "p95": float(np.quantile(errors, 0.95))}
