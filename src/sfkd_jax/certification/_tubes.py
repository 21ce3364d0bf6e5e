"""Error tubes from a contraction factor and disturbance bounds (corrected thm:ISS)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import Any

import numpy as np
from jaxtyping import Float

from sfkd_jax.certification._claims import OUTPUTS, OutputMetric, readouts
from sfkd_jax.certification._measured import (
    Residuals,
    conformal_bounds,
    conformal_quantile,
    coverage,
    coverage_interval,
)
from sfkd_jax.certification._metrics import propose_metric
from sfkd_jax.certification._weights import CertificationRefused, Exported

WORST = 5
"""Steps of every validation run that a metric is optimised for."""
OUTPUT_KINDS = {"position_m": "position", "yaw_rad": "yaw", "body": "body"}
"""Radii in a document, and the errors that they bound."""


def latent_tube(
    alpha: float, d_bar: float, horizon: int
) -> Float[np.ndarray, " horizon"]:
    """Return R_1 … R_T with |z_k − ẑ_k| ≤ R_k as long as all |d_j| ≤ d̄, for ẑ_0 = z_0.

    R_k = d̄ (1 − α^k)/(1 − α) = α R_{k−1} + d̄, T the horizon [steps].
    """
    # The recursion instead of the closed form, which divides by 1 − α.
    steps = accumulate([d_bar] * horizon, lambda radius, d: alpha * radius + d)
    return np.asarray([*steps])


def tubes(
    *,
    alpha: float,
    lipschitz: Mapping[str, float],
    one_step: Mapping[str, float],
    horizon: int,
    largest_increment: float | None,
) -> dict[str, Any]:
    """Return the tubes of a document, for an exact z_0: R_1 … R_T, outputs, limits.

    Along a path all outputs are decoded from z, so that no error accumulates:

        |e_i,k| ≤ L_i α R_{k−1} + ε_i,   k = 1 … T

    Otherwise the pose is a sum of increments on SE(2), and its error is bounded by
    finite sums over j = 0 … k − 1 instead:

        |e_yaw,k| ≤ Σ_j (L_yaw R_j + ε_yaw)
        |e_p,k|   ≤ Σ_j (L_p R_j + ε_p + |dp| |e_yaw,j|)

    Args:
        alpha: contraction factor.
        lipschitz: L of the outputs, by "position", "yaw", "body".
        one_step: measured d̄ ("latent") and ε by the same names, at the true latent.
        horizon: T [steps].
        largest_increment: |dp|, the longest step [m]; None along a path.
    """
    latent = latent_tube(alpha, one_step["latent"], horizon)
    # R_k → d̄ / (1 − α), the fixed point of R ↦ α R + d̄.
    ultimate = one_step["latent"] / (1 - alpha)
    limit = None
    # R_0 = 0: a prediction starts at the observed state.
    before = np.concatenate([[0.0], latent[:-1], [ultimate]])
    radii = {
        name: lipschitz[kind] * alpha * before + one_step[kind]
        for name, kind in OUTPUT_KINDS.items()
    }
    # With increments the pose drifts; without them there is a limit of every radius.
    if largest_increment is None:
        limit = {name: float(radius[-1]) for name, radius in radii.items()}
    else:
        yaw = np.cumsum(lipschitz["yaw"] * before + one_step["yaw"])
        # An error of yaw moves only the increments that come after it.
        turned = np.concatenate([[0.0], yaw[:-1]])
        increments = lipschitz["position"] * before + one_step["position"]
        position = np.cumsum(increments + largest_increment * turned)
        radii |= {"position_m": position, "yaw_rad": yaw}
    return {
        "latent": latent.tolist(),
        "physical": {name: radius[:-1].tolist() for name, radius in radii.items()},
        "ultimate": ultimate,
        "asymptotic": limit,
        "largest_increment_m": largest_increment,
    }


FORMS = ("asymptotic", "vehicle_to_nominal")
"""Bounds on |y_k − ŷ_k| of vehicle and nominal model over a whole run: from the largest
disturbance alone, and from the sequence of all disturbances.
"""


def radii(
    measured: Residuals,
    name: str,
    claim: OutputMetric,
    start: Float[np.ndarray, "run rank"] | None = None,
) -> dict[str, Float[np.ndarray, " run"]]:
    """Return the bounds of one output for each run, by `FORMS`.

    With |z_k − ẑ_k|_P ≤ R_k and R_k = α R_{k−1} + |d_k|_P,

        |y_k − ŷ_k| ≤ |C (F(z_{k−1}) − F(ẑ_{k−1}))| + ε_k ≤ L α R_{k−1} + ε_k
                    ≤ L α max|d|_P / (1 − α) + max ε.

    `start` is z_0 − ẑ_0; None if the nominal model starts at the state of the car.
    """
    # |d|_P is the 2-norm of d'L with P = L L'.
    factor = np.linalg.cholesky(claim.metric)
    sizes = np.linalg.norm(measured.gaps @ factor, axis=-1)
    misses = measured.outputs[..., OUTPUTS.index(name)]
    farthest = radius = initial = np.zeros(len(sizes))
    if start is not None:
        radius = initial = np.linalg.norm(start @ factor, axis=1)
    # The output error is read before the radius takes in this step's disturbance.
    for step in range(sizes.shape[1]):
        distance = claim.lipschitz * claim.alpha * radius + misses[:, step]
        farthest = np.maximum(farthest, distance)
        radius = claim.alpha * radius + sizes[:, step]
    # A start outside the limit shrinks towards it: the larger of both bounds all k.
    ultimate = np.maximum(initial, np.max(sizes, axis=1) / (1.0 - claim.alpha))
    asymptotic = claim.lipschitz * claim.alpha * ultimate + np.max(misses, axis=1)
    return dict(zip(FORMS, (asymptotic, farthest), strict=True))


def output_tubes(
    weights: Exported,
    validation: Residuals,
    calibration: Residuals,
    test: Residuals,
    *,
    level: float,
    start: np.ndarray | None = None,
) -> dict[str, dict[str, Any]]:
    """Prove a metric for each of `OUTPUTS` and calibrate a bound on |y − ŷ| with it.

    The metric is optimised for the validation runs, from `start`, a common Lyapunov
    matrix of the operators. Each bound holds at `level` for a whole new run. Empty if
    there is no metric for one of the outputs.
    """
    documents = {}
    for name in OUTPUTS:
        rows = readouts(weights)[name]
        gaps = worst_gaps(validation)
        try:
            claim = propose_metric(weights, rows, gaps, start)
        # Both outputs or none: a corridor needs position and heading.
        except CertificationRefused:
            return {}
        scores, unseen = (radii(part, name, claim) for part in (calibration, test))
        part: dict[str, Any] = {"tube": {}, "coverage": {}, "coverage_ci95": {}}
        documents[name] = claim.document() | {"coverage_runs": len(test.gaps)} | part
        for form in FORMS:
            bound = part["tube"][form] = conformal_quantile(scores[form], level)
            share = part["coverage"][form] = float(np.mean(unseen[form] <= bound))
            part["coverage_ci95"][form] = coverage_interval(share, len(test.gaps))
    return documents


def worst_gaps(measured: Residuals) -> Float[np.ndarray, "run worst rank"]:
    """Return d of the `WORST` steps of every run with the largest |d|."""
    sizes = np.linalg.norm(measured.gaps, axis=-1)
    # The worst steps alone decide the radius, and the search takes few of them.
    order = np.argsort(sizes, axis=1)[:, -WORST:]
    return np.take_along_axis(measured.gaps, order[..., None], axis=1)


JOINT = ("vehicle_to_nominal_position", "vehicle_to_nominal_yaw", "nominal")
"""Measured bounds of a corridor that hold jointly at the level: distances of vehicle
and nominal model in e_y [m] and e_ψ [rad], and |ê_y| of the nominal model [m].
"""
ALONE = ("asymptotic_position", "asymptotic_yaw")
"""Bounds from the largest disturbance alone, which hold one by one."""


def calibrate_corridor(
    reference: Float[np.ndarray, "other 5"],
    scores: Float[np.ndarray, "run 5"],
    *,
    level: float,
) -> dict[str, float]:
    """Return split-conformal bounds for a new run, by name.

    The bounds in `JOINT` hold together with probability at least `level`, the others
    one by one. The lateral tube decides the joint score: heading and nominal corridor
    exceed their units a tenth as often. `reference` are the runs that fix the units.
    """
    together = len(JOINT)
    joint = conformal_bounds(reference[:, :together], scores[:, :together], level=level)
    alone = [conformal_quantile(column, level) for column in scores[:, together:].T]
    return dict(zip((*JOINT, *ALONE), [*joint.tolist(), *alone], strict=True))


def corridor_coverage(
    bounds: Mapping[str, float], scores: Float[np.ndarray, "run 5"]
) -> dict[str, Any]:
    """Return the share of runs on which all bounds in `JOINT` held."""
    limits = np.asarray([bounds[name] for name in JOINT])
    return coverage(limits, scores[:, : len(JOINT)])
