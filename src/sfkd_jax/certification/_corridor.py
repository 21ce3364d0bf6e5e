"""Measured bounds of whole runs: the corridor of the nominal model, the tube around it.

The bounds are measured on the runs of `corridor`; only α, L and P behind them are
proved.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.certification._calibration import (
    conformal_bounds,
    conformal_quantile,
    coverage,
    coverage_interval,
    supports,
    tube_units,
)
from sfkd_jax.certification._claims import OUTPUTS, OutputMetric, Refuted
from sfkd_jax.certification._tubes import FORMS, Residuals, radii


class RunScores(NamedTuple):
    """The smallest bounds that would have held on each run, (run,).

    Attributes:
        vehicle_to_nominal_position: distance of vehicle and nominal model, e_y [m].
        vehicle_to_nominal_yaw: the same of e_ψ [rad].
        asymptotic_position: the same of e_y from the largest disturbance alone [m].
        asymptotic_yaw: the same of e_ψ [rad].
        nominal: largest |ê_y| of the nominal model [m].
    """

    vehicle_to_nominal_position: Float[np.ndarray, " run"]
    vehicle_to_nominal_yaw: Float[np.ndarray, " run"]
    asymptotic_position: Float[np.ndarray, " run"]
    asymptotic_yaw: Float[np.ndarray, " run"]
    nominal: Float[np.ndarray, " run"]


MEASURED = RunScores._fields
JOINT = ("vehicle_to_nominal_position", "vehicle_to_nominal_yaw", "nominal")
"""Quantities whose bounds hold jointly at the level; the others hold one by one."""


def run_scores(
    measured: Residuals,
    claims: Mapping[str, OutputMetric],
    nominal: Float[np.ndarray, " run"],
    initial: Mapping[str, Float[np.ndarray, " run"]] | None = None,
) -> RunScores:
    """Return the smallest bounds that would have held on each run.

    Args:
        measured: residuals of the runs.
        claims: proved metric of every output.
        nominal: largest |ê_y| of the nominal model [m].
        initial: |z_0 − ẑ_0|_P in the metric of every output; None if the nominal model
            starts at the state of the car.
    """
    starts = dict.fromkeys(OUTPUTS, 0.0) if initial is None else initial
    scores = {"nominal": np.asarray(nominal, dtype=np.float64)}
    for name in OUTPUTS:
        bounds = radii(measured, name, claims[name], starts[name])._asdict()
        scores |= {f"{form}_{name}": bounds[form] for form in FORMS}
    return RunScores(**scores)


def calibrate_corridor(
    reference: RunScores, scores: RunScores, *, level: float
) -> dict[str, float]:
    """Return split-conformal bounds for a new run, by name.

    The bounds in `JOINT` hold together with probability at least `level`, the others
    one by one. The units make the lateral tube decide the joint score: heading and
    nominal corridor exceed their units a tenth as often.

    Args:
        reference: scores of the runs that fix the units.
        scores: scores of the calibration runs.
        level: 1 − δ.

    Raises:
        ValueError: too few runs for the level, or scores that are not finite.
    """
    # Units of another split: scores in units of their own would not be exchangeable.
    units = tube_units(_joint(reference), level=level)
    joint = conformal_bounds(units, _joint(scores), level=level)
    alone = {
        name: conformal_quantile(getattr(scores, name), level)
        for name in MEASURED
        if name not in JOINT
    }
    return dict(zip(JOINT, joint.tolist(), strict=True)) | alone


def corridor_coverage(bounds: Mapping[str, float], scores: RunScores) -> dict[str, Any]:
    """Return the share of runs on which all bounds in `JOINT` held.

    Args:
        bounds: from `calibrate_corridor`.
        scores: scores of independent runs.
    """
    limits = np.asarray([bounds[name] for name in JOINT])
    return coverage(limits, _joint(scores))


def _joint(scores: RunScores) -> Float[np.ndarray, "run kind"]:
    """Scores of the quantities in `JOINT`, that of the lateral tube first."""
    return np.stack([getattr(scores, name) for name in JOINT], axis=1)


def require_corridor(corridor: Mapping[str, Any]) -> None:
    """Check sums, levels and counts of the document's corridor.

    Args:
        corridor: that part of the document.

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
    # Car to nominal model plus nominal model to path: the triangle inequality.
    expected = bounds["nominal"] + bounds["vehicle_to_nominal_position"]
    if not np.isclose(corridor["corridor_m"], expected, rtol=1e-9, atol=0.0):
        raise Refuted(
            "corridor.corridor_m is not nominal + vehicle_to_nominal_position"
        )
    runs, level = corridor["runs"], corridor["level"]
    if not (isinstance(runs, int) and 0 < level < 1 and supports(runs, level)):
        raise Refuted(f"corridor.level = {level!r} is not possible with {runs!r} runs")
    # The attack kept disturbances in their bound: leaving would refute the proof.
    if not corridor["attack"]["over_tube"] <= 1.0:
        raise Refuted(
            "corridor.attack left the tube with disturbances within their bound"
        )
    for name, part in {"corridor": corridor, **corridor["by_scenario"]}.items():
        require_coverage(name, part)


def require_coverage(name: str, part: Mapping[str, Any]) -> None:
    """Check that a coverage is a count of trajectories, and its interval.

    Raises:
        Refuted: names the value that does not follow.
    """
    count, runs = part["coverage_trajectories"], part["coverage_runs"]
    share = part["coverage"]
    inside = round(share * count)
    # A share must be a count over the number of trajectories, within rounding.
    if not 0 <= inside <= count or not 1 <= runs <= count:
        raise Refuted(
            f"{name}: a coverage of {share!r} is not possible with {count!r} "
            f"trajectories of {runs!r} runs"
        )
    require_equal(f"{name}: coverage", share, inside / count)
    ends = coverage_interval(share, runs)
    require_equal(f"{name}: coverage_ci95", part["coverage_ci95"], ends)


def numbers(name: str, values: Any) -> np.ndarray:
    """Return a part of a document as an array of finite numbers.

    Raises:
        Refuted: it is none.
    """
    array = np.asarray(values)
    # Booleans and strings are refused by the kind, before they compare as numbers.
    if array.dtype.kind not in "if" or not np.all(np.isfinite(array)):
        raise Refuted(f"{name} must be finite numbers")
    return array


REPEATED = 1e-9
"""Relative tolerance of recomputed values, for another order of summation."""


def require_equal(name: str, stated: Any, derived: Any) -> None:
    """Check a stated value against the derived one.

    Raises:
        Refuted: it is another.
    """
    expected = np.asarray(derived, dtype=np.float64)
    actual = numbers(name, stated)
    if actual.shape != expected.shape or not np.all(
        # Relative to the derived value, which an
        # attacker of the document cannot choose.
        np.abs(actual - expected) <= REPEATED * np.abs(expected)
    ):
        raise Refuted(f"{name} does not follow from the rest of the document")
