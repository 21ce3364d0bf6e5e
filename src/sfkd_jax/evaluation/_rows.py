"""Rows of results.json from simulated episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np

from sfkd_jax.evaluation._loops import Episode
from sfkd_jax.evaluation._statistics import holm, paired_difference
from sfkd_jax.evaluation.metrics import (
    METRICS,
    SIGNALS,
    PerEpisode,
    Recording,
    Row,
    as_numbers,
)

SHARED = ("scenario", "vehicle", "inner_loop", "controller", "planner", "sampling")
"""Columns that are equal in rows that are compared."""
IDENTITY = ("system", *SHARED, "env")
"""Columns that identify a row of results.json; a new row replaces the old row of the
same identity.
"""

Scores: TypeAlias = dict[str, PerEpisode]
"""Numbers per episode by the name of their metric."""


def score(episodes: Episode, *, dt: float, size: tuple[float, float]) -> Scores:
    """Measure every metric on a batch of episodes.

    Args:
        episodes: of one system.
        dt: sampling period [s].
        size: length and width of the car [m].
    """
    recording = Recording(
        dt=dt,
        size=size,
        lateral=np.asarray(episodes.lateral, dtype=np.float64),
        states=np.asarray(episodes.states),
        controls=np.asarray(episodes.controls),
        signals={name: np.asarray(episodes.signals[name]) for name in SIGNALS},
    )
    return {one.name: one.measure(recording) for one in METRICS if one.measure}


def row(scores: Scores, about: dict[str, Any]) -> Row:
    """One system on one scenario; what does not apply is None.

    Args:
        scores: per episode.
        about: system, model, controller, sampling, env, scenario, vehicle, seeds,
            episodes, episode_s, params.
    """
    compared = dict.fromkeys(("ratio_to_oracle", "difference_to_sfkd"))
    return about | _pooled(scores) | compared


def _pooled(scores: Scores) -> Row:
    """The values of all metrics that are measured on episodes."""
    return {one.name: one.pool(scores[one.name]) for one in METRICS if one.pool}


def disturbed(force: float, scores: Scores) -> dict[str, Any]:
    """The part of a row that is also measured under side forces up to `force` [N]."""
    pooled = _pooled(scores)
    return {
        "force_n": force,
        "rmse_m": pooled["rmse_m"],
        "departures": pooled["departures"],
    }


def compare(rows: list[Row], *, missing: int = 0) -> list[Row]:
    """Add comparisons of systems on the same episodes with the same sampling.

    A row without sampling (a quadratic program) is compared with rows that sample
    around feedback. Of several rows of a system, the one with the same controller and
    planner is taken. `p_holm` of the differences to SFKD is adjusted for all rows.

    Args:
        rows: of evaluated systems; `drives`, if they have it, tells which episodes.
        missing: number of rows of the same comparison that are not there yet.
    """
    for entry in rows:
        same = [other for other in rows if _episodes(other) == _episodes(entry)]
        # Of several rows of a system, the one that searches like this row.
        same.sort(key=lambda other, entry=entry: _search(other) != _search(entry))
        first = {other["system"]: other for other in reversed(same)}
        if oracle := first.get("oracle"):
            means = [float(np.mean(_by_seed(one))) for one in (entry, oracle)]
            entry["ratio_to_oracle"] = means[0] / means[1]
        # In the frame of the body or in that of a path; one sampling has one frame.
        ours = first.get("sfkd", first.get("sfkd_path"))
        if ours is not None and ours is not entry:
            errors = _by_seed(entry), _by_seed(ours)
            entry["difference_to_sfkd"] = paired_difference(*errors)
    # One family: every difference that a reader could pick from the table.
    differences = [entry.get("difference_to_sfkd") or {} for entry in rows]
    family = [one for one in differences if one.get("p") is not None]
    adjusted = holm([one["p"] for one in family], not_made=missing)
    for record, p in zip(family, adjusted, strict=True):
        record["p_holm"] = p
    return rows


def _episodes(entry: Row) -> tuple[Any, ...]:
    """Key of the episodes of a row; rows with equal keys are paired."""
    return (
        *(entry[name] for name in ("scenario", "vehicle")),
        # A quadratic program has no sampling; it starts from feedback too.
        entry["sampling"] or "feedback",
        entry.get("drives"),
        _by_seed(entry).shape[1],
    )


def _search(entry: Row) -> tuple[Any, ...]:
    """Controller and planner of a row."""
    return entry.get("controller"), entry.get("planner")


def _by_seed(entry: Row) -> np.ndarray:
    """RMSE, one line per training seed, one column per episode."""
    return as_numbers(entry["rmse_episodes_m"]).reshape(len(entry["seeds"]), -1)


def pool(rows: list[Row]) -> Row:
    """Pool rows of the same episodes that differ in the training seed alone.

    Metrics are pooled as in their table, by default averaged.
    """
    first, *rest = rows
    if not rest:
        return first
    # What is named pools otherwise than by the mean, so it comes last.
    return _mean(rows) | {
        "arrays": first.get("arrays"),
        "seeds": [seed for entry in rows for seed in entry["seeds"]],
        **{one.name: one.pool_seeds(rows) for one in METRICS if one.pool_seeds},
    }


def _mean(values: list[Any]) -> Any:
    """The mean of equal structures, leaf by leaf.

    A leaf that is not a number stays where all agree and is None otherwise.
    """
    first = values[0]
    # A mean over some of the seeds would not be that of the row.
    if any(value is None for value in values):
        return None
    if isinstance(first, dict):
        return {name: _mean([value.get(name) for value in values]) for name in first}
    if all(isinstance(value, float) for value in values):
        return float(np.mean(values))
    return first if all(value == first for value in values) else None


def identity(row: Mapping[str, Any]) -> dict[str, str | None]:
    """Return the identity of a row."""
    columns = ((name, row.get(name)) for name in IDENTITY)
    return {name: None if value is None else str(value) for name, value in columns}


def merge(
    old: Iterable[Mapping[str, Any]], new: Iterable[Mapping[str, Any]]
) -> list[Any]:
    """Return old and new rows; a new row replaces the old row of the same identity."""
    # Twice over: an iterator would be empty the second time.
    fresh = list(new)
    replaced = [identity(row) for row in fresh]
    return [row for row in old if identity(row) not in replaced] + fresh
