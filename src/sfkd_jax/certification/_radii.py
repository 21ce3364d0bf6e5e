"""How far an output of the true state was from that of a nominal copy, at most: measured, drive by drive."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._output_metrics import OUTPUTS, OutputMetric
from sfkd_jax.core.path_frame import HEADING, LATERAL
from sfkd_jax.core.rollouts import defects, in_batches
from sfkd_jax.types import BODY, Model, Params, Trajectory

BATCH = 50
"""Drives measured at once."""


class Residuals(NamedTuple):
    """What every step of a drive differed from the model, (drive, time, …).

    Attributes:
        gaps: d_k, in coordinates of the latent.
        outputs: |y_{k+1} − C F(z_k)| of e_y [m] and e_ψ [rad].
    """

    gaps: Float[np.ndarray, "drive time rank"]
    outputs: Float[np.ndarray, "drive time output"]


class Radii(NamedTuple):
    """Bounds on |y_k − ŷ_k| over a whole drive, for any copy that starts where the car does, (drive,).

    Attributes:
        for_ever: L α max|d|_P / (1 − α) + max ε: what follows from the largest
            disturbance alone.
        followed: max_k (L α R_{k−1} + ε_k), R_k = α R_{k−1} + |d_k|_P: what follows
            from all of them in turn.
        largest: max |d|_P.
    """

    for_ever: Float[np.ndarray, " drive"]
    followed: Float[np.ndarray, " drive"]
    largest: Float[np.ndarray, " drive"]


def residuals(model: Model, params: Params, drives: Trajectory) -> Residuals:
    """Of every step from its true state, switches included.

    Args:
        model: along a path.
        params: folded.
        drives: a batch of trajectories.
    """
    gaps, outputs = _residuals(model, params, drives)
    return Residuals(
        np.asarray(gaps, dtype=np.float64), np.asarray(outputs, dtype=np.float64)
    )


@partial(jax.jit, static_argnums=0)
def _residuals(model: Model, params: Params, drives: Trajectory) -> tuple[Array, Array]:
    def one(drive: Trajectory) -> tuple[Array, Array]:
        gap, predicted = defects(model, params, drive)
        miss = (predicted - drive.states[1:])[:, BODY]
        return gap, jnp.abs(miss[:, jnp.asarray([LATERAL, HEADING])])

    return in_batches(one, drives, size=BATCH)


def radii(
    found: Residuals,
    name: str,
    claim: OutputMetric,
    initial: Float[np.ndarray, " drive"] | float = 0.0,
) -> Radii:
    """Both bounds for one output, by drive.

        |z_k − ẑ_k|_P ≤ R_k,  so  |y_k − ŷ_k| ≤ |C (F(z_{k−1}) − F(ẑ_{k−1}))| + ε_k ≤ L α R_{k−1} + ε_k

    Args:
        found: of the drives.
        name: of `OUTPUTS`.
        claim: proved of it.
        initial: |z_0 − ẑ_0|_P.
    """
    sizes = np.linalg.norm(found.gaps @ np.linalg.cholesky(claim.metric), axis=-1)
    misses = found.outputs[..., OUTPUTS.index(name)]
    radius = np.broadcast_to(np.asarray(initial, dtype=np.float64), sizes.shape[:1])
    followed = np.zeros(len(sizes))
    for step in range(sizes.shape[1]):
        followed = np.maximum(
            followed, claim.lipschitz * claim.alpha * radius + misses[:, step]
        )
        radius = claim.alpha * radius + sizes[:, step]
    largest = np.max(sizes, axis=1)
    ultimate = np.maximum(initial, largest / (1.0 - claim.alpha))
    for_ever = claim.lipschitz * claim.alpha * ultimate + np.max(misses, axis=1)
    return Radii(for_ever, followed, largest)


def worst_gaps(found: Residuals, count: int) -> Float[np.ndarray, "drive worst rank"]:
    """The steps of every drive with the largest |d|: what a metric is chosen for."""
    sizes = np.linalg.norm(found.gaps, axis=-1)
    order = np.argsort(sizes, axis=1)[:, -count:]
    return np.take_along_axis(found.gaps, order[..., None], axis=1)


def metrics_document(
    claims: Mapping[str, OutputMetric],
) -> dict[str, dict[str, object]]:
    """As JSON has them."""
    return {name: claim.document() for name, claim in claims.items()}
