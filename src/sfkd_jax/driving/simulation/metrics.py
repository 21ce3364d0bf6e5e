"""The table of metrics: how each one is measured, pooled and shown.

A new metric is an entry of `METRICS`. It may name signals that no metric has used so
far, since `simulate` records all signals that the entries name.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sfkd_jax.driving.simulation import _measures as measures
from sfkd_jax.driving.simulation._measures import LANE_HALF_WIDTH as LANE_HALF_WIDTH
from sfkd_jax.driving.simulation._measures import PerEpisode as PerEpisode
from sfkd_jax.driving.simulation._measures import Recording as Recording
from sfkd_jax.driving.simulation._measures import room_in_lane as room_in_lane
from sfkd_jax.driving.simulation._measures import switches as switches
from sfkd_jax.evaluation import summary
from sfkd_jax.evaluation.formats import (
    dig,
    interval,
    mean_std,
    millimetres,
    number,
    percent,
    short,
    upper,
)
from sfkd_jax.info import ControllerInfo

Row: TypeAlias = dict[str, Any]
"""One system on one scenario, as in results.json."""
Signal: TypeAlias = Callable[[ControllerInfo], Any]
"""Maps a controller's info of a step to the array that is recorded."""


class Metric(NamedTuple):
    """One metric of a row of results.json.

    Attributes:
        name: JSON key; `a.b` is the entry b of the record a.
        label: title of the column that a reader sees.
        unit: of the value as it is shown.
        table: which table shows it: "tracking", "spread", "planner", "cost" or
            "claims"; "" for none.
        write: formats a JSON value. None and values that are not finite are an en dash.
        measure: returns one value per episode; None if the metric is not measured on
            episodes.
        pool: returns the JSON value of a row from the values of its episodes.
        pool_seeds: returns the JSON value of several rows that differ only in the
            training seed; None for the mean of their values.
        records: signals that `measure` needs, by name.
    """

    name: str
    label: str = ""
    unit: str = ""
    table: str = ""
    write: Callable[[Any], str] = number
    measure: Callable[[Recording], PerEpisode] | None = None
    pool: Callable[[PerEpisode], Any] | None = None
    pool_seeds: Callable[[list[Row]], Any] | None = None
    records: dict[str, Signal] = {}  # noqa: RUF012 never changed

    def value(self, row: Row) -> Any:
        """Return the JSON value in a row, or None."""
        return dig(row, *self.name.split("."))

    def text(self, row: Row) -> str:
        """Return the value of a row as text, in the unit of the metric."""
        return self.write(self.value(row))

    def head(self) -> str:
        """Return label and unit, as the head of a column."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


def _pool_known(combine: Callable[[np.ndarray], Any], values: np.ndarray) -> Any:
    """Combine the values that are not NaN; None if there are none."""
    known = values[~np.isnan(values)]
    return combine(known).item() if len(known) else None


def _count(values: np.ndarray) -> Any:
    """Return the sum of whole numbers, as an integer."""
    return np.sum(values).astype(int)


def _pool_rows(name: str, combine: Callable[[list[Any]], Any], rows: list[Row]) -> Any:
    """Combine the values of one metric in several rows; None if one has no value."""
    values = [row.get(name) for row in rows]
    return None if None in values else combine(values)


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values))


def _max(values: np.ndarray) -> float:
    return float(np.max(values))


def _sum(values: np.ndarray) -> int:
    return int(np.sum(values))


def _median(values: np.ndarray) -> float | None:
    """Return the median; None if one of the values is not known."""
    return None if np.any(np.isnan(values)) else float(np.median(values))


def as_numbers(values: list[float | None]) -> np.ndarray:
    """Return stored numbers as an array; None, of one that was not finite, is NaN."""
    return np.asarray(values, dtype=float)


def _errors_of_trainings(rows: list[Row]) -> list[list[float]]:
    """Return the RMSE of every episode [m], one list per training."""
    return [as_numbers(row["rmse_episodes_m"]).tolist() for row in rows]


def _error_summary(rows: list[Row]) -> dict[str, Any]:
    """Return the summary of the RMSE over trainings and episodes."""
    return summary(np.asarray(_errors_of_trainings(rows)))


def _all_errors(rows: list[Row]) -> list[float]:
    """Return the RMSE of every episode of all trainings, one after another [m]."""
    return list(chain.from_iterable(_errors_of_trainings(rows)))


def _max_of_rows(rows: list[Row]) -> float:
    """Return the largest deviation of all trainings [m]."""
    return float(np.max(as_numbers([row["max_deviation_m"] for row in rows])))


def _departures_of_rows(rows: list[Row]) -> int:
    """Return the number of departures of all trainings."""
    return sum(row["departures"] for row in rows)


METRICS: tuple[Metric, ...] = (
    Metric(
        name="rmse_m",
        label="RMSE",
        unit="mm",
        table="tracking",
        write=partial(mean_std, digits=1, scale=1e3),
        measure=measures.rmse,
        pool=summary,
        pool_seeds=_error_summary,
    ),
    Metric(
        name="rmse_m.ci95",
        label="95 % interval",
        unit="mm",
        table="tracking",
        write=partial(interval, digits=1, scale=1e3),
    ),
    Metric(
        name="rmse_m.median",
        label="Median",
        unit="mm",
        table="spread",
        write=millimetres,
    ),
    Metric(
        name="rmse_m.p95",
        label="95th percentile",
        unit="mm",
        table="spread",
        write=millimetres,
    ),
    Metric(
        name="rmse_episodes_m",
        measure=measures.rmse,
        pool=np.ndarray.tolist,
        pool_seeds=_all_errors,
    ),
    Metric(
        name="max_deviation_m",
        label="Largest deviation",
        unit="mm",
        table="tracking",
        write=partial(millimetres, digits=0),
        measure=measures.max_deviation,
        pool=_max,
        pool_seeds=_max_of_rows,
    ),
    Metric(
        name="smoothness_rad_per_s",
        label="Steering rate",
        unit="rad/s",
        table="tracking",
        measure=measures.steering_rate,
        pool=_mean,
    ),
    Metric(
        name="departures",
        label="Left the lane",
        table="spread",
        write=short,
        measure=measures.departed,
        pool=_sum,
        pool_seeds=_departures_of_rows,
    ),
    Metric(
        name="unhealthy_steps",
        label="Steps with the last plan held",
        unit="%",
        table="planner",
        write=percent,
        measure=measures.unhealthy_share,
        pool=_mean,
        records={"healthy": measures.healthy},
    ),
    Metric(
        name="ess",
        label="Effective samples",
        table="planner",
        write=partial(number, digits=0),
        measure=measures.median_effective_samples,
        pool=_median,
        records={"effective_samples": measures.effective_samples},
    ),
    Metric(
        name="collisions",
        label="Episodes with a collision",
        table="claims",
        write=short,
        measure=measures.collided,
        pool=partial(_pool_known, _count),
        pool_seeds=partial(_pool_rows, "collisions", sum),
        records={"gap": measures.gap},
    ),
    Metric(
        name="clearance_m",
        label="Smallest clearance",
        unit="m",
        table="claims",
        write=partial(number, digits=2),
        measure=measures.nearest,
        pool=partial(_pool_known, np.min),
        pool_seeds=partial(_pool_rows, "clearance_m", min),
        records={"gap": measures.gap},
    ),
    Metric(
        name="below_claim",
        label="Steps below the claimed clearance",
        table="claims",
        write=short,
        measure=measures.below_claim,
        pool=partial(_pool_known, _count),
        pool_seeds=partial(_pool_rows, "below_claim", sum),
        records={"gap": measures.gap, "clearance": measures.claimed_clearance},
    ),
    Metric(
        name="mean_speed_mps",
        label="Mean speed",
        unit="m/s",
        table="spread",
        write=partial(number, digits=2),
        measure=measures.mean_speed,
        pool=partial(_pool_known, np.mean),
        records={"gap": measures.gap},
    ),
    Metric(
        name="ratio_to_oracle",
        label="RMSE over oracle",
        table="tracking",
        write=partial(number, digits=2),
    ),
    Metric(
        name="difference_to_sfkd.mean",
        label="RMSE minus SFKD",
        unit="mm",
        table="spread",
        write=millimetres,
    ),
    Metric(
        name="difference_to_sfkd.ci95",
        label="95 % interval of the difference",
        unit="mm",
        table="spread",
        write=partial(interval, digits=1, scale=1e3),
    ),
    Metric(
        name="params",
        label="Parameters",
        table="cost",
        write=short,
    ),
    Metric(
        name="alpha",
        label="Certified α",
        table="cost",
        write=upper,
    ),
)
"""All metrics, in the order of the columns of tables."""

BY_NAME: dict[str, Metric] = {metric.name: metric for metric in METRICS}
"""The metrics by their JSON keys."""
SIGNALS: dict[str, Signal] = {
    name: signal for metric in METRICS for name, signal in metric.records.items()
}
"""Signals that the metrics need, by name."""
