"""Bounds of a corridor from the scores of whole runs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from sfkd_jax.certificate import Coverage
from sfkd_jax.certification import conformal_bounds, conformal_quantile, coverage
from sfkd_jax.driving.certificate import Bounds

JOINT = ("vehicle_to_nominal_position", "vehicle_to_nominal_yaw", "nominal")
"""Measured bounds of a corridor that hold together at the level: the distances between
vehicle and nominal model in e_y [m] and e_ψ [rad], and |ê_y| of the nominal model [m].
"""
ALONE = ("asymptotic_position", "asymptotic_yaw")
"""Bounds from the largest disturbance alone. Each of them holds at the level."""


def calibrate_corridor(
    reference: Float[np.ndarray, "other 5"],
    scores: Float[np.ndarray, "run 5"],
    *,
    level: float,
) -> Bounds:
    """Return split-conformal bounds for a new run.

    The bounds in `JOINT` hold together with probability at least `level`, those in
    `ALONE` one by one. The joint score is mostly that of the lateral tube, since
    heading and nominal corridor exceed their units a tenth as often.

    Args:
        reference: scores of the runs that fix the units.
        scores: of the runs that set the bounds, in the order of `JOINT` and `ALONE`.
        level: 1 − δ.
    """
    joint_count = len(JOINT)
    joint = conformal_bounds(
        reference[:, :joint_count], scores[:, :joint_count], level=level
    )
    alone = [conformal_quantile(column, level) for column in scores[:, joint_count:].T]
    return Bounds(**dict(zip((*JOINT, *ALONE), [*joint.tolist(), *alone], strict=True)))


def corridor_coverage(bounds: Bounds, scores: Float[np.ndarray, "run 5"]) -> Coverage:
    """Return the share of runs on which all bounds in `JOINT` held."""
    limits = np.asarray([getattr(bounds, name) for name in JOINT])
    return coverage(limits, scores[:, : len(JOINT)])
