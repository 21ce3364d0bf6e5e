"""Tubes of single outputs on drives like the data, each in the metric that suits it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sfkd_jax.certification._calibration import conformal_quantile, interval
from sfkd_jax.certification._claims import Refuted, readouts
from sfkd_jax.certification._exported import Exported, one_thread
from sfkd_jax.certification._metric_search import propose_metric
from sfkd_jax.certification._output_metrics import (
    OUTPUTS,
    OutputMetric,
    may_have_metrics,
)
from sfkd_jax.certification._radii import radii, residuals, worst_gaps
from sfkd_jax.types import Model, Params, Trajectory

WORST = 5
"""Steps of every validation drive that a metric is chosen for."""
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
    """For each of `OUTPUTS` what is proved in its own metric, and a bound on |y − ŷ| calibrated with it.

    Args:
        model: along a path.
        params: folded.
        weights: explicit, of the same.
        validation: what the metric is chosen on.
        calibration: sets the bounds.
        test: counts coverage.
        level: of each bound, for a whole new drive.

    Returns:
        By output α, L, their witness and `tube`; nothing for a model that can have no
        metric but I.
    """
    if not may_have_metrics(weights):
        return {}
    parts = {
        name: residuals(model, params, part)
        for name, part in {
            "validation": validation,
            "calibration": calibration,
            "test": test,
        }.items()
    }
    worst, documents = worst_gaps(parts["validation"], WORST), {}
    for name in OUTPUTS:
        try:
            with one_thread():
                claim = propose_metric(
                    weights,
                    readouts(weights)[name],
                    worst,
                    weights.residual_multipliers,
                )
        except Refuted:
            return {}
        known, fresh = (
            radii(parts[part], name, claim) for part in ("calibration", "test")
        )
        bounds = {
            form: conformal_quantile(getattr(known, form), level) for form in FORMS
        }
        inside = {
            form: float(np.mean(getattr(fresh, form) <= bounds[form])) for form in FORMS
        }
        count = len(fresh.largest)
        documents[name] = claim.document() | {
            "tube": bounds,
            "coverage": inside,
            "coverage_ci95": {
                form: interval(share, count) for form, share in inside.items()
            },
            "coverage_drives": count,
        }
    return documents


def claims_of(outputs: Mapping[str, Any]) -> dict[str, OutputMetric]:
    """The proved part back from a document."""
    return {name: OutputMetric.from_document(part) for name, part in outputs.items()}
