"""Rows of results.json from simulated episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np

from sfkd_jax.driving.simulation._loops import Episode
from sfkd_jax.driving.simulation.metrics import (
    METRICS,
    SIGNALS,
    PerEpisode,
    Recording,
    Row,
    as_numbers,
)
from sfkd_jax.evaluation import holm, paired_difference

SHARED = (
    *("scenario", "vehicle", "inner_loop", "latency"),
    *("controller", "planner", "sampling"),
)
"""Columns in which rows that are compared must be equal."""
IDENTITY = ("system", *SHARED, "env")
"""Columns that identify a row of results.json. A new row replaces the old row with the
same identity.
"""

Scores: TypeAlias = dict[str, PerEpisode]
"""One value per episode, by the name of the metric."""


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
    return {
        metric.name: metric.measure(recording) for metric in METRICS if metric.measure
    }


def row(scores: Scores, columns: dict[str, Any]) -> Row:
    """Return the row of one system on one scenario; what does not apply is None.

    Args:
        scores: per episode.
        columns: what identifies and describes the row: system, model, controller,
            sampling, env, scenario, vehicle, seeds, episodes, episode_s, params.
    """
    # `compare` fills these in, as soon as there are rows to compare with.
    comparisons = dict.fromkeys(("ratio_to_oracle", "difference_to_sfkd"))
    return {**columns, **_pooled(scores), **comparisons}


def _pooled(scores: Scores) -> Row:
    """Return the values of all metrics that are measured on episodes."""
    return {
        metric.name: metric.pool(scores[metric.name])
        for metric in METRICS
        if metric.pool
    }


def disturbed(force: float, scores: Scores) -> dict[str, Any]:
    """Return the part of a row about the same episodes with side forces.

    Args:
        force: largest side force [N].
        scores: per episode, under these forces.
    """
    pooled = _pooled(scores)
    return {
        "force_n": force,
        "rmse_m": pooled["rmse_m"],
        "departures": pooled["departures"],
    }


def compare(rows: list[Row], *, missing: int = 0) -> list[Row]:
    """Add comparisons of systems on the same episodes with the same sampling.

    Every row is compared with the row of the oracle and with that of SFKD. If such a
    system has several rows, the one with the same controller and planner is taken. A
    row without sampling, of a quadratic program, is compared with rows that sample
    around feedback. `p_holm` of the differences to SFKD is adjusted for all rows.

    Args:
        rows: of evaluated systems. Their entry `drives`, if they have it, says which
            episodes they drove.
        missing: number of rows of the same comparison that are not there yet.
    """
    for entry in rows:
        systems = _comparable(entry, rows)
        oracle = systems.get("oracle")
        if oracle is not None:
            error = float(np.mean(_by_seed(entry)))
            oracle_error = float(np.mean(_by_seed(oracle)))
            entry["ratio_to_oracle"] = error / oracle_error
        # SFKD in the frame of the body or in that of a path. All rows of one sampling
        # have the same frame, so that at most one of them is there.
        sfkd = systems.get("sfkd", systems.get("sfkd_path"))
        if sfkd is not None and sfkd is not entry:
            entry["difference_to_sfkd"] = paired_difference(
                _by_seed(entry), _by_seed(sfkd)
            )
    # All differences are one family, since a reader could pick any from the table.
    differences = [entry.get("difference_to_sfkd") or {} for entry in rows]
    family = [record for record in differences if record.get("p") is not None]
    adjusted = holm([record["p"] for record in family], not_made=missing)
    for record, p in zip(family, adjusted, strict=True):
        record["p_holm"] = p
    return rows


def _comparable(entry: Row, rows: list[Row]) -> dict[str, Row]:
    """Return one row of each system on the same episodes, by the name of the system.

    Of several rows of a system it is the first one that searches like `entry`, or else
    the first one.
    """
    same = [other for other in rows if _episodes(other) == _episodes(entry)]
    alike = [other for other in same if _search(other) == _search(entry)]
    others = [other for other in same if _search(other) != _search(entry)]
    systems: dict[str, Row] = {}
    for other in (*alike, *others):
        systems.setdefault(other["system"], other)
    return systems


def _episodes(entry: Row) -> tuple[Any, ...]:
    """Return what identifies the episodes of a row; rows with equal keys are paired."""
    return (
        entry["scenario"],
        entry["vehicle"],
        # A quadratic program has no sampling. It starts from feedback, too.
        entry["sampling"] or "feedback",
        entry.get("drives"),
        _by_seed(entry).shape[1],
    )


def _search(entry: Row) -> tuple[Any, ...]:
    """Return controller and planner of a row."""
    return entry.get("controller"), entry.get("planner")


def _by_seed(entry: Row) -> np.ndarray:
    """Return the RMSE, one line per training seed, one column per episode [m]."""
    return as_numbers(entry["rmse_episodes_m"]).reshape(len(entry["seeds"]), -1)


def pool(rows: list[Row]) -> Row:
    """Pool rows of the same episodes that differ in the training seed alone.

    A metric with `pool_seeds` is pooled by it. All other numbers are averaged.
    """
    first = rows[0]
    if len(rows) == 1:
        return first
    pooled = _mean(rows)
    pooled["arrays"] = first.get("arrays")
    pooled["seeds"] = [seed for entry in rows for seed in entry["seeds"]]
    for metric in METRICS:
        if metric.pool_seeds is not None:
            pooled[metric.name] = metric.pool_seeds(rows)
    return pooled


def _mean(values: list[Any]) -> Any:
    """Return the mean of values of equal structure, leaf by leaf.

    A leaf that is not a float stays as it is if all values agree, otherwise it is None.
    """
    first = values[0]
    # A mean over some of the seeds would not be the mean of the row.
    if any(value is None for value in values):
        return None
    if isinstance(first, dict):
        return {name: _mean([value.get(name) for value in values]) for name in first}
    if all(isinstance(value, float) for value in values):
        return float(np.mean(values))
    return first if all(value == first for value in values) else None


def identity(row: Mapping[str, Any]) -> dict[str, str | None]:
    """Return the identity of a row."""
    values = {name: row.get(name) for name in IDENTITY}
    return {
        name: None if value is None else str(value) for name, value in values.items()
    }


def merge(
    old: Iterable[Mapping[str, Any]], new: Iterable[Mapping[str, Any]]
) -> list[Any]:
    """Return old and new rows; a new row replaces the old row of the same identity."""
    # A list, because it is read twice and `new` may be an iterator.
    new_rows = list(new)
    replaced = [identity(row) for row in new_rows]
    kept = [row for row in old if identity(row) not in replaced]
    return kept + new_rows
