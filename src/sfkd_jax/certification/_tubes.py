"""Error tubes from a contraction factor and disturbance bounds (corrected thm:ISS)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._calibration import conformal_quantile, coverage_interval
from sfkd_jax.certification._claims import (
    OUTPUTS,
    LyapunovClaim,
    OutputMetric,
    Refuted,
    keeps_metrics,
    readouts,
)
from sfkd_jax.certification._metrics import propose_metric
from sfkd_jax.certification._weights import Exported, one_thread
from sfkd_jax.geometry import HEADING, LATERAL
from sfkd_jax.rollout import defects, in_batches
from sfkd_jax.types import BODY, Model, Params, Trajectory

BATCH = 50
"""Runs in a batch."""
WORST = 5
"""Steps of every validation run that a metric is optimised for."""
FORMS = ("asymptotic", "vehicle_to_nominal")
"""Bounds on |y − ŷ| of an output, from the largest disturbance alone, and from the
sequence of all disturbances of a run.
"""


def latent_tube(
    alpha: float, d_bar: float, horizon: int, *, initial: float = 0.0
) -> Float[np.ndarray, " horizon"]:
    """Return R_1 … R_T with |z_k − ẑ_k| ≤ R_k as long as all |d_j| ≤ d̄.

        R_k = α^k |e_0| + d̄ (1 − α^k)/(1 − α)

    Args:
        alpha: α.
        d_bar: d̄.
        horizon: T [steps].
        initial: |e_0|.
    """
    radii, radius = [], initial
    # The recursion instead of the closed form, which divides by 1 − α.
    for _ in range(horizon):
        radius = alpha * radius + d_bar
        radii.append(radius)
    return np.asarray(radii)


def path_tube(
    latent: Float[np.ndarray, " horizon"],
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    residual: Mapping[str, float],
) -> dict[str, list[float]]:
    """Return radii of e_y [m], e_ψ [rad] and body state along a path for an exact z_0.

        |e_i,k| ≤ L_i α R_{k−1} + ε_i,   k = 1 … T

    Position and heading are decoded from z, so no error accumulates over the horizon.

    Args:
        latent: R_1 … R_T.
        alpha: contraction factor.
        lipschitz: L of the outputs, by "position", "yaw", "body".
        residual: ε, one-step errors of the outputs at the true latent, by the same
            names.
    """
    # R_0 = 0: a prediction starts at the observed state.
    before = np.concatenate([[0.0], latent[:-1]])
    kinds = {"position_m": "position", "yaw_rad": "yaw", "body": "body"}
    return {
        name: (lipschitz[kind] * alpha * before + residual[kind]).tolist()
        for name, kind in kinds.items()
    }


def ultimate_tube(
    ultimate: float,
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    residual: Mapping[str, float],
) -> dict[str, float]:
    """Return the radii of `path_tube` for an infinite horizon.

    Args:
        ultimate: d̄/(1 − α), the limit of R_k.
        alpha: contraction factor.
        lipschitz: L of the outputs, by "position", "yaw", "body".
        residual: ε, one-step errors of the outputs at the true latent, by the same
            names.
    """
    # Two entries: `path_tube` reads the one before, and both are the limit.
    limits = np.asarray([ultimate, ultimate])
    radii = path_tube(limits, alpha=alpha, lipschitz=lipschitz, residual=residual)
    return {name: values[-1] for name, values in radii.items()}


def physical_tube(
    latent: Float[np.ndarray, " horizon"],
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    residual: Mapping[str, float],
    largest_increment: float,
) -> dict[str, list[float]]:
    """Return radii of position [m], yaw [rad] and body state for an exact z_0.

    The pose is a sum of increments on SE(2), so its error is bounded by finite sums and
    not by a contraction. For k = 1 … T and sums over j = 0 … k − 1,

        |e_yaw,k| ≤ Σ_j (L_yaw R_j + ε_yaw)
        |e_p,k|   ≤ Σ_j (L_p R_j + ε_p + |dp| |e_yaw,j|)
        |e_s,k|   ≤ L_s α R_{k−1} + ε_s

    Args:
        latent: R_1 … R_T.
        alpha: contraction factor.
        lipschitz: L of the decoder's outputs, by "position", "yaw", "body".
        residual: ε, one-step errors of the decoder at the true latent, by the same
            names.
        largest_increment: |dp|, the longest step [m].
    """
    before = np.concatenate([[0.0], latent[:-1]])
    yaw = np.cumsum(lipschitz["yaw"] * before + residual["yaw"])
    # An error of yaw moves only the increments that come after it.
    turned = np.concatenate([[0.0], yaw[:-1]])
    increments = lipschitz["position"] * before + residual["position"]
    position = np.cumsum(increments + largest_increment * turned)
    body = lipschitz["body"] * alpha * before + residual["body"]
    return {
        "position_m": position.tolist(),
        "yaw_rad": yaw.tolist(),
        "body": body.tolist(),
    }


class Residuals(NamedTuple):
    """One-step prediction errors of every step of a run, (run, time, …).

    Attributes:
        gaps: d_k in latent coordinates.
        outputs: |y_{k+1} − C F(z_k)| of e_y [m] and e_ψ [rad].
    """

    gaps: Float[np.ndarray, "run time rank"]
    outputs: Float[np.ndarray, "run time output"]


class Radii(NamedTuple):
    """Bounds on |y_k − ŷ_k| of vehicle and nominal model over a whole run, (run,).

    Attributes:
        asymptotic: L α max|d|_P / (1 − α) + max ε, from the largest disturbance alone.
        vehicle_to_nominal: max_k (L α R_{k−1} + ε_k) with R_k = α R_{k−1} + |d_k|_P,
            from the sequence of all disturbances.
    """

    asymptotic: Float[np.ndarray, " run"]
    vehicle_to_nominal: Float[np.ndarray, " run"]


def residuals(model: Model, params: Params, runs: Trajectory) -> Residuals:
    """Measure the error of every step from its true state, including switches of e.

    Args:
        model: a model along a path.
        params: folded parameters.
        runs: a batch of trajectories.
    """
    gaps, outputs = _residuals(model, params, runs)
    return Residuals(
        np.asarray(gaps, dtype=np.float64), np.asarray(outputs, dtype=np.float64)
    )


@partial(jax.jit, static_argnums=0)
def _residuals(model: Model, params: Params, runs: Trajectory) -> tuple[Array, Array]:
    """`residuals` on the device."""

    def one(run: Trajectory) -> tuple[Array, Array]:
        gap, predicted = defects(model, params, run)
        # Path states have their outputs in the body, without a pose.
        miss = (predicted - run.states[1:])[:, BODY]
        return gap, jnp.abs(miss[:, jnp.asarray([LATERAL, HEADING])])

    return in_batches(one, runs, size=BATCH)


def radii(
    measured: Residuals,
    name: str,
    claim: OutputMetric,
    initial: Float[np.ndarray, " run"] | float = 0.0,
) -> Radii:
    """Return the bounds of one output for each run.

    With |z_k − ẑ_k|_P ≤ R_k,

        |y_k − ŷ_k| ≤ |C (F(z_{k−1}) − F(ẑ_{k−1}))| + ε_k ≤ L α R_{k−1} + ε_k.

    Args:
        measured: residuals of the runs.
        name: one of `OUTPUTS`.
        claim: its proved metric.
        initial: |z_0 − ẑ_0|_P; 0 if the nominal model starts at the state of the car.
    """
    # |d|_P is the 2-norm of d'L with P = L L'.
    sizes = np.linalg.norm(measured.gaps @ np.linalg.cholesky(claim.metric), axis=-1)
    misses = measured.outputs[..., OUTPUTS.index(name)]
    radius = np.broadcast_to(np.asarray(initial, dtype=np.float64), sizes.shape[:1])
    farthest = np.zeros(len(sizes))
    # The output error is read before the radius takes in this step's disturbance.
    for step in range(sizes.shape[1]):
        distance = claim.lipschitz * claim.alpha * radius + misses[:, step]
        farthest = np.maximum(farthest, distance)
        radius = claim.alpha * radius + sizes[:, step]
    # A start outside the limit shrinks towards it: the larger of both bounds all k.
    ultimate = np.maximum(initial, np.max(sizes, axis=1) / (1.0 - claim.alpha))
    asymptotic = claim.lipschitz * claim.alpha * ultimate + np.max(misses, axis=1)
    return Radii(asymptotic, farthest)


def output_tubes(
    model: Model,
    params: Params,
    weights: Exported,
    *,
    validation: Trajectory,
    calibration: Trajectory,
    test: Trajectory,
    level: float,
    lyapunov: LyapunovClaim | None = None,
) -> dict[str, dict[str, Any]]:
    """Prove a metric for each of `OUTPUTS` and calibrate a bound on |y − ŷ| with it.

    Args:
        model: any model.
        params: folded parameters.
        weights: explicit weights of the same model.
        validation: runs that the metric is optimised for.
        calibration: runs that set the bounds.
        test: runs on which coverage is counted.
        level: of each bound, for a whole new run.
        lyapunov: common Lyapunov function of the operators, to start from.

    Returns:
        α, L, their witness and the tube by output; empty if the model has no metrics.
    """
    if not (model.along_path and keeps_metrics(weights)):
        return {}
    # Three splits: the metric is chosen on one, or its bound would be optimistic.
    reference, measured, unseen = (
        residuals(model, params, part) for part in (validation, calibration, test)
    )
    worst = _worst_gaps(reference, WORST)
    documents = {}
    for name in OUTPUTS:
        try:
            with one_thread():
                claim = propose_metric(
                    weights,
                    readouts(weights)[name],
                    worst,
                    weights.residual_multipliers,
                    lyapunov and lyapunov.metric,
                )
        # Both outputs or none: a corridor needs position and heading.
        except Refuted:
            return {}
        calibrated, held_out = (
            radii(part, name, claim)._asdict() for part in (measured, unseen)
        )
        bounds = {form: conformal_quantile(calibrated[form], level) for form in FORMS}
        shares = {
            form: float(np.mean(held_out[form] <= bounds[form])) for form in FORMS
        }
        count = len(unseen.gaps)
        documents[name] = claim.document() | {
            "tube": bounds,
            "coverage": shares,
            "coverage_ci95": {
                form: coverage_interval(shares[form], count) for form in FORMS
            },
            "coverage_runs": count,
        }
    return documents


def _worst_gaps(measured: Residuals, count: int) -> Float[np.ndarray, "run worst rank"]:
    """Return d of the `count` steps of every run with the largest |d|."""
    sizes = np.linalg.norm(measured.gaps, axis=-1)
    # The worst steps alone decide the radius, and the search takes few of them.
    order = np.argsort(sizes, axis=1)[:, -count:]
    return np.take_along_axis(measured.gaps, order[..., None], axis=1)
