"""From scores to the rows of results.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfkd_jax.evaluation._metrics import Scores
from sfkd_jax.evaluation._statistics import paired_difference, summary


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
        scores: per episode.
        about: system, model, controller, sampling, env, scenario, vehicle, seeds,
            episodes, episode_s, params.
        act_ms: median and 99 % quantile of one control step.
        violation: from `violations`.
        watched: whether a monitor looked on.
    """
    after = scores.rmse_after_switch
    return about | {
        "rmse_m": summary(scores.rmse),
        "rmse_episodes_m": [float(value) for value in scores.rmse],
        "max_deviation_m": float(np.max(scores.max_deviation)),
        "rmse_after_switch_m": None
        if np.all(np.isnan(after))
        else float(np.nanmean(after)),
        "smoothness_rad_per_s": float(np.mean(scores.smoothness)),
        "violation": violation,
        "departures": int(np.sum(scores.departed)),
        "unhealthy_steps": float(np.mean(scores.unhealthy)),
        "breach_steps": float(np.mean(scores.breach)) if watched else None,
        "box_exit_steps": float(np.mean(scores.box_exit)) if watched else None,
        "ess": None if np.any(np.isnan(scores.ess)) else float(np.median(scores.ess)),
        "act_ms": None if act_ms is None else {"p50": act_ms[0], "p99": act_ms[1]},
        "ratio_to_oracle": None,
        "difference_to_sfkd": None,
    }


def disturbed(
    force: float, scores: Scores, violation: dict[str, Any]
) -> dict[str, Any]:
    """What becomes of a row when forces of up to ±`force` [N], which nobody measures, push the car sideways."""
    kept = {name: violation[name] for name in ("v0", "v1", "v1_conformal", "v2")}
    departures = int(np.sum(scores.departed))
    return {
        "force_n": force,
        "rmse_m": summary(scores.rmse),
        **kept,
        "departures": departures,
    }


def compare(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with comparisons between systems that drove the same episodes with the same sampling.

    A row without sampling (a quadratic program) is compared with those that sample
    around feedback. Of several rows of a system, the one with the same controller and
    planner is taken.
    """
    for entry in rows:
        same = [other for other in rows if _episodes(other) == _episodes(entry)]
        same.sort(key=lambda other, entry=entry: _search(other) != _search(entry))
        for systems, name, measure in _COMPARISONS:
            other = next((other for other in same if other["system"] in systems), None)
            if other is None or (systems == _SFKD and other is entry):
                continue
            entry[name] = measure(_by_seed(entry), _by_seed(other))
    return rows


def _episodes(entry: dict[str, Any]) -> tuple[Any, ...]:
    """Which episodes a row drove: those of equal answers are paired."""
    names = ("scenario", "vehicle", "variation")
    return (
        *(entry[name] for name in names),
        entry["sampling"] or "feedback",
        _by_seed(entry).shape,
    )


def _search(entry: dict[str, Any]) -> tuple[Any, ...]:
    """How the controls of a row were found."""
    return entry.get("controller"), entry.get("planner")


def _by_seed(entry: dict[str, Any]) -> np.ndarray:
    """RMSE, one line per training seed, one column per episode."""
    return np.asarray(entry["rmse_episodes_m"]).reshape(len(entry["seeds"]), -1)


def _ratio(values: np.ndarray, reference: np.ndarray) -> float:
    return float(np.mean(values) / np.mean(reference))


_SFKD = ("sfkd", "sfkd_path")
"""In the frame of the body and along a path: rows of one sampling have one frame."""
_COMPARISONS = (
    (("oracle",), "ratio_to_oracle", _ratio),
    (_SFKD, "difference_to_sfkd", paired_difference),
)


def pool(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of several that differ in the training seed alone: episodes are joined, other measures averaged.

    Args:
        rows: at least one, in the order of their seeds; all drove the same episodes.
    """
    first, *rest = rows
    if not rest:
        return first
    driven = [entry["rmse_episodes_m"] for entry in rows]
    return _mean(rows) | {
        "arrays": first.get("arrays"),
        "seeds": [seed for entry in rows for seed in entry["seeds"]],
        "rmse_m": summary(np.asarray(driven)),
        "rmse_episodes_m": [value for episodes in driven for value in episodes],
        "rmse_trainings_m": [float(np.mean(episodes)) for episodes in driven],
        "max_deviation_m": max(entry["max_deviation_m"] for entry in rows),
        "departures": sum(entry["departures"] for entry in rows),
    }


def _mean(values: list[Any]) -> Any:
    """The mean of equal structures, leaf by leaf; what is no number stays where all agree, and is None otherwise."""
    first = values[0]
    if isinstance(first, dict):
        return {
            name: _mean([value.get(name) for value in values]) for name in first
        }  # older rows lack newer measures
    if all(isinstance(value, float) for value in values):
        return float(np.mean(values))
    return first if all(value == first for value in values) else None
