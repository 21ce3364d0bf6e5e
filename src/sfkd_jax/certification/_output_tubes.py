"""Calibrated tubes of single outputs, each in its own metric."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sfkd_jax.certification._calibration import conformal_quantile, coverage_interval
from sfkd_jax.certification._claims import Refuted, readouts
from sfkd_jax.certification._exported import Exported, one_thread
from sfkd_jax.certification._metric_search import propose_metric
from sfkd_jax.certification._output_metrics import (
    OUTPUTS,
    OutputMetric,
    may_have_metrics,
)
from sfkd_jax.certification._radii import Radii, radii, residuals, worst_gaps
from sfkd_jax.types import Model, Params, Trajectory

WORST = 5
"""Steps of every validation drive that the metric is optimised for."""
FORMS = ("for_ever", "followed")


def output_tubes(
    model: Model,
    params: Params,
    weights: Exported,
    *,
    validation: Trajectory,
    calibration: Trajectory,
    test: Trajectory,
    level: float,
) -> dict[str, dict[str, Any]]:
    """Prove a metric for each of `OUTPUTS` and calibrate a bound on |y − ŷ| with it.

    Args:
        model: a model along a path.
        params: folded parameters.
        weights: explicit weights of the same model.
        validation: drives that the metric is optimised for.
        calibration: drives that set the bounds.
        test: drives on which coverage is counted.
        level: of each bound, for a whole new drive.

    Returns:
        α, L, their witness and the tube by output; empty if the model has no metrics.
    """
    if not may_have_metrics(weights):
        return {}
    reference, measured, unseen = (
        residuals(model, params, part) for part in (validation, calibration, test)
    )
    worst, start = worst_gaps(reference, WORST), weights.residual_multipliers
    documents = {}
    for name in OUTPUTS:
        try:
            with one_thread():
                claim = propose_metric(weights, readouts(weights)[name], worst, start)
        except Refuted:
            return {}
        calibrated = radii(measured, name, claim)
        tube = _tube(calibrated, radii(unseen, name, claim), level)
        documents[name] = claim.document() | tube
    return documents


def _tube(calibration: Radii, test: Radii, level: float) -> dict[str, Any]:
    """Conformal bounds on the radii of the calibration drives, and their coverage."""
    bounds = {
        form: conformal_quantile(getattr(calibration, form), level) for form in FORMS
    }
    shares = {
        form: float(np.mean(getattr(test, form) <= bounds[form])) for form in FORMS
    }
    count = len(test.largest)
    return {
        "tube": bounds,
        "coverage": shares,
        "coverage_ci95": {
            form: coverage_interval(shares[form], count) for form in FORMS
        },
        "coverage_drives": count,
    }


def output_metrics_from(outputs: Mapping[str, Any]) -> dict[str, OutputMetric]:
    """Read the proved metric of every output from a document."""
    return {name: OutputMetric.from_document(part) for name, part in outputs.items()}
