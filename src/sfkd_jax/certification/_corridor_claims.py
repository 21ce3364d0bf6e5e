"""The corridor: a nominal part that a shield keeps, and the tube of the car around it; measured, not proved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.certification._calibration import conformal_quantile, interval, supports
from sfkd_jax.certification._claims import Refuted
from sfkd_jax.certification._fixed_points import require_fixed_points
from sfkd_jax.certification._output_metrics import OUTPUTS, OutputMetric
from sfkd_jax.certification._radii import Residuals, radii

MEASURED = (
    *(f"{form}_{name}" for form in ("followed", "for_ever") for name in OUTPUTS),
    "nominal",
)
"""What is calibrated of whole drives: both bounds on |y − ŷ| of every output, and the
largest |ê_y| of the copy.
"""
JOINT = (*(f"followed_{name}" for name in OUTPUTS), "nominal")
"""Those that hold together with the level; each of the others has the level for itself."""


class DriveScores(NamedTuple):
    """Of whole drives, (drive,); names as in `MEASURED`."""

    followed_position: Float[np.ndarray, " drive"]
    followed_yaw: Float[np.ndarray, " drive"]
    for_ever_position: Float[np.ndarray, " drive"]
    for_ever_yaw: Float[np.ndarray, " drive"]
    nominal: Float[np.ndarray, " drive"]


def drive_scores(
    found: Residuals,
    claims: Mapping[str, OutputMetric],
    nominal: Float[np.ndarray, " drive"],
    initial: Mapping[str, Float[np.ndarray, " drive"]] | None = None,
) -> DriveScores:
    """What a claim of a corridor would have had to be, drive by drive.

    Args:
        found: of the drives.
        claims: proved, of every output.
        nominal: largest |ê_y| of a copy run along [m].
        initial: |z_0 − ẑ_0|_P of every output's metric; nothing if the copy starts
            where the car does.
    """
    position, yaw = (
        radii(found, name, claims[name], 0.0 if initial is None else initial[name])
        for name in OUTPUTS
    )
    return DriveScores(
        followed_position=position.followed,
        followed_yaw=yaw.followed,
        for_ever_position=position.for_ever,
        for_ever_yaw=yaw.for_ever,
        nominal=np.asarray(nominal, dtype=np.float64),
    )


def calibrate(
    reference: DriveScores, scores: DriveScores, *, level: float
) -> dict[str, float]:
    """Bounds by name: those of `JOINT` hold together for a new drive with probability ≥ level, the others alone.

    Split conformal: units are fixed by other drives. The lateral tube decides: heading
    and nominal corridor count in units that are missed a tenth as often.

    Args:
        reference: of drives that fix the units.
        scores: of those that calibrate.

    Raises:
        ValueError: too few drives for the level, or scores that are not finite.
    """
    shares = {
        name: level if name == JOINT[0] else 1.0 - 0.1 * (1.0 - level) for name in JOINT
    }
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


def covered(bounds: Mapping[str, float], scores: DriveScores) -> dict[str, Any]:
    """On how many drives all bounds of `JOINT` held, with its interval; every drive is an independent one."""
    inside = np.all([getattr(scores, name) <= bounds[name] for name in JOINT], axis=0)
    count, share = len(inside), float(np.mean(inside))
    return {
        "coverage": share,
        "coverage_ci95": interval(share, count),
        "coverage_trajectories": count,
        "coverage_drives": count,
    }


def require_corridor(corridor: Mapping[str, Any], output: Mapping[str, Any]) -> None:
    """Check what is arithmetic in the document's part: sums, levels and counts that go together.

    Args:
        corridor: the part.
        output: the document's part about e_y, its constants proved.

    Raises:
        Refuted: naming what does not follow.
    """
    bounds = corridor["bounds"]
    values = np.asarray(list(bounds.values()), dtype=np.float64)
    if set(bounds) != set(MEASURED) or not (
        np.all(np.isfinite(values)) and np.all(values > 0)
    ):
        raise Refuted(
            "corridor.bounds must be positive numbers, one for each measured quantity"
        )
    expected = bounds["nominal"] + bounds["followed_position"]
    if not np.isclose(corridor["corridor_m"], expected, rtol=1e-9, atol=0.0):
        raise Refuted("corridor.corridor_m is not nominal + followed_position")
    drives, level = corridor["drives"], corridor["level"]
    if not (isinstance(drives, int) and 0 < level < 1 and supports(drives, level)):
        raise Refuted(
            f"corridor.level = {level!r} cannot be had from {drives!r} drives"
        )
    if not corridor["attack"]["over_tube"] <= 1.0:
        raise Refuted(
            "corridor.attack is a car outside of its tube whose disturbances kept their bound"
        )
    for name, part in {"corridor": corridor, **corridor["by_scenario"]}.items():
        count = part["coverage_trajectories"]
        inside = round(part["coverage"] * count)
        exact = 0 <= inside <= count and np.isclose(
            part["coverage"], inside / count, rtol=1e-9
        )
        if not exact or not np.allclose(
            part["coverage_ci95"], interval(part["coverage"], part["coverage_drives"])
        ):
            raise Refuted(f"{name}: coverage does not fit {count!r} drives")
    require_fixed_points(corridor["fixed_points"], output, bounds["for_ever_position"])
