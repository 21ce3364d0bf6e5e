"""Measured bounds on the distance between outputs of the car and its nominal copy."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._output_metrics import OUTPUTS, OutputMetric
from sfkd_jax.geometry import HEADING, LATERAL
from sfkd_jax.rollout import defects, in_batches
from sfkd_jax.types import BODY, Model, Params, Trajectory

BATCH = 50
"""Drives in a batch."""


class Residuals(NamedTuple):
    """One-step prediction errors of every step of a drive, (drive, time, …).

    Attributes:
        gaps: d_k in latent coordinates.
        outputs: |y_{k+1} − C F(z_k)| of e_y [m] and e_ψ [rad].
    """

    gaps: Float[np.ndarray, "drive time rank"]
    outputs: Float[np.ndarray, "drive time output"]


class Radii(NamedTuple):
    """Bounds on |y_k − ŷ_k| over a whole drive, (drive,).

    Attributes:
        for_ever: L α max|d|_P / (1 − α) + max ε, from the largest disturbance alone.
        followed: max_k (L α R_{k−1} + ε_k) with R_k = α R_{k−1} + |d_k|_P, from the
            sequence of all disturbances.
        largest: max |d|_P.
    """

    for_ever: Float[np.ndarray, " drive"]
    followed: Float[np.ndarray, " drive"]
    largest: Float[np.ndarray, " drive"]


def residuals(model: Model, params: Params, drives: Trajectory) -> Residuals:
    """Measure the error of every step from its true state, including switches of e.

    Args:
        model: a model along a path.
        params: folded parameters.
        drives: a batch of trajectories.
    """
    gaps, outputs = _residuals(model, params, drives)
    return Residuals(
        np.asarray(gaps, dtype=np.float64), np.asarray(outputs, dtype=np.float64)
    )


@partial(jax.jit, static_argnums=0)
def _residuals(model: Model, params: Params, drives: Trajectory) -> tuple[Array, Array]:
    """`residuals` on the device."""

    def one(drive: Trajectory) -> tuple[Array, Array]:
        gap, predicted = defects(model, params, drive)
        miss = (predicted - drive.states[1:])[:, BODY]
        return gap, jnp.abs(miss[:, jnp.asarray([LATERAL, HEADING])])

    return in_batches(one, drives, size=BATCH)


def radii(
    measured: Residuals,
    name: str,
    claim: OutputMetric,
    initial: Float[np.ndarray, " drive"] | float = 0.0,
) -> Radii:
    """Return the bounds of one output for each drive.

    With |z_k − ẑ_k|_P ≤ R_k,

        |y_k − ŷ_k| ≤ |C (F(z_{k−1}) − F(ẑ_{k−1}))| + ε_k ≤ L α R_{k−1} + ε_k.

    Args:
        measured: residuals of the drives.
        name: one of `OUTPUTS`.
        claim: its proved metric.
        initial: |z_0 − ẑ_0|_P; 0 if the copy starts at the state of the car.
    """
    sizes = np.linalg.norm(measured.gaps @ np.linalg.cholesky(claim.metric), axis=-1)
    misses = measured.outputs[..., OUTPUTS.index(name)]
    radius = np.broadcast_to(np.asarray(initial, dtype=np.float64), sizes.shape[:1])
    followed = np.zeros(len(sizes))
    for step in range(sizes.shape[1]):
        distance = claim.lipschitz * claim.alpha * radius + misses[:, step]
        followed = np.maximum(followed, distance)
        radius = claim.alpha * radius + sizes[:, step]
    largest = np.max(sizes, axis=1)
    ultimate = np.maximum(initial, largest / (1.0 - claim.alpha))
    for_ever = claim.lipschitz * claim.alpha * ultimate + np.max(misses, axis=1)
    return Radii(for_ever, followed, largest)


def worst_gaps(
    measured: Residuals, count: int
) -> Float[np.ndarray, "drive worst rank"]:
    """Return d of the `count` steps of every drive with the largest |d|."""
    sizes = np.linalg.norm(measured.gaps, axis=-1)
    order = np.argsort(sizes, axis=1)[:, -count:]
    return np.take_along_axis(measured.gaps, order[..., None], axis=1)
