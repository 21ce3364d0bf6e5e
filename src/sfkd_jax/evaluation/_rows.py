"""From scores to the rows of results.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfkd_jax.evaluation._metrics import Scores
from sfkd_jax.evaluation._statistics import paired_difference, summary

IDENTITY = ("system", "scenario", "vehicle", "sampling", "env")
"""What makes a row the same row."""


def row(
    scores: Scores,
    about: dict[str, Any],
    act_ms: tuple[float, float] | None,
    violation: dict[str, Any],
    *,
    watched: bool = False,
) -> dict[str, Any]:
    """One system on one scenario; what does not apply is None.

    Args:
        scores: per episode. about: system, model, controller, sampling, env, scenario, vehicle, seeds, episodes,
            episode_s, params. act_ms: median and 99 % quantile of one control step. violation: from `violations`.
        watched: whether a monitor looked on.
    """
    after = scores.rmse_after_switch
    return about | {
        "rmse_m": summary(scores.rmse),
        "max_deviation_m": float(np.max(scores.max_deviation)),
        "rmse_after_switch_m": None if np.all(np.isnan(after)) else float(np.nanmean(after)),
        "smoothness_rad_per_s": float(np.mean(scores.smoothness)),
        "violation": violation,
        "departures": int(np.sum(scores.departed)),
        "unhealthy_steps": float(np.mean(scores.unhealthy)),
        "breach_steps": float(np.mean(scores.breach)) if watched else None,
        "box_exit_steps": float(np.mean(scores.box_exit)) if watched else None,
        "ess": float(np.median(scores.ess)),
        "act_ms": None if act_ms is None else {"p50": act_ms[0], "p99": act_ms[1]},
        "ratio_to_oracle": None,
        "difference_to_sfkd": None,
    }


def disturbed(force: float, scores: Scores, violation: dict[str, Any]) -> dict[str, Any]:
    """What becomes of a row when forces of up to ±`force` [N], which nobody measures, push the car sideways."""
    kept = {name: violation[name] for name in ("v0", "v1", "v1_conformal", "v2")}
    departures = int(np.sum(scores.departed))
    return {"force_n": force, "rmse_m": summary(scores.rmse), **kept, "departures": departures}


def compare(rows: dict[str, dict[str, Any]], scores: dict[str, Scores]) -> list[dict[str, Any]]:
    """Add the comparisons between systems that drove the same episodes."""
    for name, entry in rows.items():
        if "oracle" in rows:
            entry["ratio_to_oracle"] = float(np.mean(scores[name].rmse) / np.mean(scores["oracle"].rmse))
        if "sfkd" in rows and name != "sfkd":
            entry["difference_to_sfkd"] = paired_difference(scores[name].rmse, scores["sfkd"].rmse)
    return list(rows.values())


def merge(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """New rows replace old ones with the same identity; the others stay."""
    replaced = {tuple(entry[name] for name in IDENTITY) for entry in new}
    return [entry for entry in old if tuple(entry[name] for name in IDENTITY) not in replaced] + new
