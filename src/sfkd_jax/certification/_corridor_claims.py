"""Calibrated corridor of the closed loop: the nominal copy and the tube around it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.certification._calibration import (
    conformal_quantile,
    coverage_interval,
    supports,
)
from sfkd_jax.certification._claims import Refuted
from sfkd_jax.certification._fixed_points import require_fixed_points
from sfkd_jax.certification._output_metrics import OUTPUTS, OutputMetric
from sfkd_jax.certification._radii import Residuals, radii

MEASURED = (
    *(f"{form}_{name}" for form in ("followed", "for_ever") for name in OUTPUTS),
    "nominal",
)
"""Quantities calibrated on whole drives: two bounds on |y − ŷ| of every output, and the
largest |ê_y| of the nominal copy.
"""
JOINT = (*(f"followed_{name}" for name in OUTPUTS), "nominal")
"""Quantities whose bounds hold jointly at the level; the others hold one by one."""


class DriveScores(NamedTuple):
    """Scores of whole drives, (drive,), for each quantity in `MEASURED`."""

    followed_position: Float[np.ndarray, " drive"]
    followed_yaw: Float[np.ndarray, " drive"]
    for_ever_position: Float[np.ndarray, " drive"]
    for_ever_yaw: Float[np.ndarray, " drive"]
    nominal: Float[np.ndarray, " drive"]


def drive_scores(
    measured: Residuals,
    claims: Mapping[str, OutputMetric],
    nominal: Float[np.ndarray, " drive"],
    initial: Mapping[str, Float[np.ndarray, " drive"]] | None = None,
) -> DriveScores:
    """Return the smallest bounds that would have held on each drive.

    Args:
        measured: residuals of the drives.
        claims: proved metric of every output.
        nominal: largest |ê_y| of the nominal copy [m].
        initial: |z_0 − ẑ_0|_P in the metric of every output; None if the copy starts at
            the state of the car.
    """
    starts = dict.fromkeys(OUTPUTS, 0.0) if initial is None else initial
    position, yaw = (
        radii(measured, name, claims[name], starts[name]) for name in OUTPUTS
    )
    return DriveScores(
        followed_position=position.followed,
        followed_yaw=yaw.followed,
        for_ever_position=position.for_ever,
        for_ever_yaw=yaw.for_ever,
        nominal=np.asarray(nominal, dtype=np.float64),
    )


def calibrate_corridor(
    reference: DriveScores, scores: DriveScores, *, level: float
) -> dict[str, float]:
    """Return split-conformal bounds for a new drive, by name.

    The bounds in `JOINT` hold together with probability at least `level`, the others
    one by one. The units make the lateral tube decide the joint score: heading and
    nominal corridor exceed their units a tenth as often.

    Args:
        reference: scores of the drives that fix the units.
        scores: scores of the calibration drives.
        level: 1 − δ.

    Raises:
        ValueError: too few drives for the level, or scores that are not finite.
    """
    rarely = 1.0 - 0.1 * (1.0 - level)
    shares = {name: level if name == JOINT[0] else rarely for name in JOINT}
    units = {
        name: float(np.quantile(getattr(reference, name), share))
        for name, share in shares.items()
    }
    joint = np.max([getattr(scores, name) / units[name] for name in JOINT], axis=0)
    factor = conformal_quantile(joint, level)
    alone = {
        name: conformal_quantile(getattr(scores, name), level)
        for name in MEASURED
        if name not in JOINT
    }
    return {name: units[name] * factor for name in JOINT} | alone


def corridor_coverage(
    bounds: Mapping[str, float], scores: DriveScores
) -> dict[str, Any]:
    """Return the share of drives on which all bounds in `JOINT` held.

    Args:
        bounds: from `calibrate_corridor`.
        scores: scores of independent drives.
    """
    inside = np.all([getattr(scores, name) <= bounds[name] for name in JOINT], axis=0)
    count, share = len(inside), float(np.mean(inside))
    return {
        "coverage": share,
        "coverage_ci95": coverage_interval(share, count),
        "coverage_trajectories": count,
        "coverage_drives": count,
    }


def require_corridor(corridor: Mapping[str, Any], output: Mapping[str, Any]) -> None:
    """Check sums, levels and counts of the document's corridor.

    Args:
        corridor: that part of the document.
        output: the part about e_y, whose constants have been checked.

    Raises:
        Refuted: names the first value that does not follow.
    """
    bounds = corridor["bounds"]
    values = np.asarray(list(bounds.values()), dtype=np.float64)
    positive = np.all(np.isfinite(values)) and np.all(values > 0)
    if set(bounds) != set(MEASURED) or not positive:
        raise Refuted(
            "corridor.bounds must be positive numbers, one for each measured quantity"
        )
    expected = bounds["nominal"] + bounds["followed_position"]
    if not np.isclose(corridor["corridor_m"], expected, rtol=1e-9, atol=0.0):
        raise Refuted("corridor.corridor_m is not nominal + followed_position")
    drives, level = corridor["drives"], corridor["level"]
    if not (isinstance(drives, int) and 0 < level < 1 and supports(drives, level)):
        raise Refuted(
            f"corridor.level = {level!r} is not possible with {drives!r} drives"
        )
    if not corridor["attack"]["over_tube"] <= 1.0:
        raise Refuted(
            "corridor.attack left the tube with disturbances within their bound"
        )
    for name, part in {"corridor": corridor, **corridor["by_scenario"]}.items():
        count, share = part["coverage_trajectories"], part["coverage"]
        inside = round(share * count)
        exact = 0 <= inside <= count and np.isclose(share, inside / count, rtol=1e-9)
        fits = exact and np.allclose(
            part["coverage_ci95"], coverage_interval(share, part["coverage_drives"])
        )
        if not fits:
            raise Refuted(f"{name}: coverage does not fit {count!r} drives")
    require_fixed_points(corridor["fixed_points"], output, bounds["for_ever_position"])
