"""The table of metrics: what each one measures, how it is pooled and shown.

A new metric is an entry of `METRICS`, also if it needs a signal that no episode has
had so far: `simulate` records what the entries name.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sfkd_jax.evaluation._statistics import summary
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
from sfkd_jax.types import ControllerInfo

Row: TypeAlias = dict[str, Any]
"""One system on one scenario, as in results.json."""
Signal: TypeAlias = Callable[[ControllerInfo], Any]
"""A controller's info of a step -> what to record of it, an array."""
PerEpisode: TypeAlias = Float[np.ndarray, " episode"] | Bool[np.ndarray, " episode"]

SETTLING = 2.0
"""Start of an episode, not scored because it is the same for every system [s]."""
LANE_HALF_WIDTH = 1.75
"""[m]"""
MIRROR = 0.1
"""Width of a mirror [m]. A departure is about the body of the car without its mirrors,
as the committed departures are; obstacles are kept clear of its whole width.
"""
SWITCH = (0.05, 6.0)
"""A larger step of friction [-] or wind [m/s] is a switch; the ramps of gusts reach
5 m/s a step.
"""


class Recording(NamedTuple):
    """What metrics measure: fields of `Episode` as arrays, and the size of the car."""

    dt: float
    size: tuple[float, float]  # length and width [m]
    lateral: Float[np.ndarray, "episode time"]
    states: Float[np.ndarray, "episode time_plus_1 state"]
    controls: Float[np.ndarray, "episode time control"]
    signals: dict[str, np.ndarray]


class Metric(NamedTuple):
    """One metric of a row of results.json.

    Attributes:
        name: JSON key; `a.b` is the entry b of the record a.
        label: what a reader sees.
        unit: of the value as shown.
        table: which table shows it: "tracking", "spread", "planner", "cost" or
            "claims"; "" for none.
        write: formats a JSON value; an en dash for None and for what is not finite.
        measure: one number per episode; None if the value is not about one episode.
        pool: the JSON value of a row from the numbers of its episodes.
        pool_seeds: the JSON value of rows that differ in the training seed; None for
            the mean of their numbers.
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
        """The JSON value in a row, or None."""
        return dig(row, *self.name.split("."))

    def text(self, row: Row) -> str:
        """The value of a row as text, in the unit of the metric."""
        return self.write(self.value(row))

    def head(self) -> str:
        """Label and unit, as the head of a column."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


def _scored(run: Recording) -> np.ndarray:
    """Lateral deviation after the start of the episode."""
    return run.lateral[:, round(SETTLING / run.dt) :]


def _rmse(run: Recording) -> np.ndarray:
    return np.sqrt(np.mean(_scored(run) ** 2, axis=1))


def _max_deviation(run: Recording) -> np.ndarray:
    return np.max(np.abs(_scored(run)), axis=1)


def switches(
    envs: Float[np.ndarray, "*batch time environment"],
) -> Bool[np.ndarray, "*batch time"]:
    """Whether friction or wind has switched at a step; at the first it has not."""
    jumps = np.any(np.abs(np.diff(envs, axis=-2)) > np.asarray(SWITCH), axis=-1)
    return np.concatenate([np.zeros_like(jumps[..., :1]), jumps], axis=-1)


def _steering_rate(run: Recording) -> np.ndarray:
    """Mean |steering rate| of the applied controls."""
    return np.mean(np.abs(np.diff(run.controls[..., 0], axis=1)), axis=1) / run.dt


def room_in_lane(size: tuple[float, float]) -> float:
    """Return the deviation from the middle up to which a car is in its lane [m].

    Args:
        size: length and width of the car [m].
    """
    # The side of the car counts, not its centre.
    return LANE_HALF_WIDTH - (0.5 * size[1] - MIRROR)


def _departed(run: Recording) -> np.ndarray:
    """Whether the car left its lane or a state is not finite."""
    # All states, also those of the start: NaN is never a stay in the lane.
    finite = np.all(np.isfinite(run.states), axis=(1, 2))
    stays = _max_deviation(run) <= room_in_lane(run.size)
    return ~finite | ~stays


def _nearest(run: Recording) -> np.ndarray:
    """Smallest true distance from an obstacle; NaN where there is none."""
    nearest = np.min(run.signals["gap"], axis=1)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _below_claim(run: Recording) -> np.ndarray:
    """Number of steps nearer to an obstacle than was claimed; NaN without a claim."""
    gap = run.signals["gap"]
    claim = run.signals["clearance"]
    below = np.sum(gap < claim, axis=1)
    return np.where(np.all(np.isnan(claim), axis=1), np.nan, below)


def _known(combine: Callable[[Any], Any], values: np.ndarray) -> Any:
    """A sum, mean or extreme of the episodes that have the measure."""
    found = values[~np.isnan(values)]
    return combine(found).item() if len(found) else None


def _whole(values: np.ndarray) -> Any:
    return np.sum(values).astype(int)


def _of_rows(name: str, combine: Callable[[list[Any]], Any], rows: list[Row]) -> Any:
    """The same over trainings; None where one has no value."""
    values = [row.get(name) for row in rows]
    return None if None in values else combine(values)


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values))


def _median(values: np.ndarray) -> float | None:
    # Of unknown numbers no median is known.
    return None if np.any(np.isnan(values)) else float(np.median(values))


def as_numbers(values: list[float | None]) -> np.ndarray:
    """Stored numbers as an array; null, for one that was not finite, is NaN."""
    return np.asarray(values, dtype=float)


def _of_trainings(rows: list[Row]) -> list[list[float]]:
    """RMSE of every episode, one list per training."""
    return [as_numbers(row["rmse_episodes_m"]).tolist() for row in rows]


_MM: dict[str, Any] = {"digits": 1, "scale": 1e3}
"""How lateral errors, in files in m, are written."""
_TWO = partial(number, digits=2)
_GAP: dict[str, Signal] = {"gap": lambda info: info.get("gap", math.nan)}

# fmt: off
METRICS: tuple[Metric, ...] = (
    Metric("rmse_m", "RMSE", "mm", "tracking", partial(mean_std, **_MM), _rmse, summary,
           lambda rows: summary(np.asarray(_of_trainings(rows)))),
    Metric("rmse_m.ci95", "95 % interval", "mm", "tracking", partial(interval, **_MM)),
    Metric("rmse_m.median", "Median", "mm", "spread", millimetres),
    Metric("rmse_m.p95", "95th percentile", "mm", "spread", millimetres),
    Metric("rmse_episodes_m", measure=_rmse, pool=np.ndarray.tolist,
           pool_seeds=lambda rows: [x for one in _of_trainings(rows) for x in one]),
    Metric("max_deviation_m", "Largest deviation", "mm", "tracking",
           partial(millimetres, digits=0), _max_deviation,
           lambda values: float(np.max(values)),
           lambda rows: float(np.max(as_numbers(
               [row["max_deviation_m"] for row in rows])))),
    Metric("smoothness_rad_per_s", "Steering rate", "rad/s", "tracking",
           measure=_steering_rate, pool=_mean),
    Metric("departures", "Left the lane", "", "spread", short, _departed,
           lambda values: int(np.sum(values)),
           lambda rows: sum(row["departures"] for row in rows)),
    Metric("unhealthy_steps", "Steps with the last plan held", "%", "planner", percent,
           lambda run: 1.0 - np.mean(run.signals["healthy"], axis=1), _mean,
           records={"healthy": lambda info: info["healthy"]}),
    Metric("ess", "Effective samples", "", "planner", partial(number, digits=0),
           lambda run: np.median(run.signals["effective_samples"], axis=1), _median,
           records={"effective_samples": lambda info: info["effective_samples"]}),
    Metric("collisions", "Episodes with a collision", "", "claims", short,
           lambda run: 1.0 * (_nearest(run) < 0.0) + 0.0 * _nearest(run),
           partial(_known, _whole), partial(_of_rows, "collisions", sum), _GAP),
    Metric("clearance_m", "Smallest clearance", "m", "claims", _TWO, _nearest,
           partial(_known, np.min), partial(_of_rows, "clearance_m", min), _GAP),
    Metric("below_claim", "Steps below the claimed clearance", "", "claims", short,
           _below_claim, partial(_known, _whole), partial(_of_rows, "below_claim", sum),
           _GAP | {"clearance": lambda info: info.get("clearance", math.nan)}),
    Metric("mean_speed_mps", "Mean speed", "m/s", "spread", _TWO,
           lambda run: np.mean(run.states[:, 1:, 3], axis=1) + 0.0 * _nearest(run),
           partial(_known, np.mean), records=_GAP),
    Metric("ratio_to_oracle", "RMSE over oracle", "", "tracking", _TWO),
    Metric("difference_to_sfkd.mean", "RMSE minus SFKD", "mm", "spread", millimetres),
    Metric("difference_to_sfkd.ci95", "95 % interval of the difference", "mm", "spread",
           partial(interval, **_MM)),
    Metric("params", "Parameters", "", "cost", short),
    Metric("alpha", "Certified α", "", "cost", upper),
)
"""All metrics, in the order of the columns of tables."""
# fmt: on

BY_NAME: dict[str, Metric] = {metric.name: metric for metric in METRICS}
"""The same by JSON key."""
SIGNALS: dict[str, Signal] = {
    name: signal for metric in METRICS for name, signal in metric.records.items()
}
"""Signals that the metrics need, by name."""
