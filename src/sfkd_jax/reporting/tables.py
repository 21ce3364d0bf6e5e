"""Tables of metrics, of prediction errors, and of the settings of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sfkd_jax.evaluation.formats import DASH, dig, is_number, number, plain
from sfkd_jax.evaluation.metrics import Row, in_table
from sfkd_jax.reporting.blocks import Table
from sfkd_jax.reporting.rows import name_of

AHEAD = {
    "Position [m]": "position_rmse_m",
    "Along [m]": "longitudinal_rmse_m",
    "Across [m]": "lateral_rmse_m",
    "Yaw [rad]": "yaw_rmse_rad",
    "Speed [m/s]": "speed_rmse_m_per_s",
}
"""Errors of open-loop prediction, by step ahead."""
_STEPS = (1, 5, 10, 20)
_OBSERVED = {"measured": "measured", "estimated": "estimated", "none": "no"}


def metric_table(group: list[Row], *tables: str, observed: bool = False) -> Table:
    """The metrics of one or more tables for each system, with SFKD stressed.

    Args:
        group: rows that may be compared.
        tables: as in `Metric.table`.
        observed: whether a column shows how each system observes e.

    Returns:
        Only columns in which a row has a value.
    """
    columns: dict[str, Callable[[Row], str]] = {}
    for metric in (one for table in tables for one in in_table(table)):
        if any(metric.text(row) != DASH for row in group):
            columns[metric.head()] = metric.text
    if observed:
        columns["Observes μ, w"] = lambda row: _OBSERVED.get(str(row.get("env")), DASH)
    rows = [[name_of(row), *(text(row) for text in columns.values())] for row in group]
    strong = tuple(index for index, (name, *_) in enumerate(rows) if name == "SFKD")
    return Table(["System", *columns], rows, strong)


def open_loop_table(errors: dict[str, Any]) -> Table:
    """Prediction errors at some of the steps ahead that the file has."""
    columns = [(name, errors.get(key)) for name, key in AHEAD.items()]
    period = errors["dt"] if is_number(errors.get("dt")) else None
    seconds = [step * period if period else None for step in errors["steps"]]
    return _by_step(errors["steps"], [("Seconds ahead", seconds), *columns])


def baseline_table(errors: dict[str, Any]) -> Table | None:
    """Position errors [m] of the model beside those of naive predictors."""
    baselines = dig(errors, "baselines")
    named = baselines.items() if isinstance(baselines, dict) else ()
    naive = {name.replace("_", " ").capitalize(): record for name, record in named}
    key = "position_rmse_m"
    columns = [(name, dig(r, key)) for name, r in ({"Model": errors} | naive).items()]
    return _by_step(errors["steps"], columns) if naive else None


def _by_step(steps: list[int], columns: list[tuple[str, Any]]) -> Table:
    """Columns by step ahead, of which some steps are shown."""
    shown = [(str(step), str(steps.index(step))) for step in _STEPS if step in steps]
    rows = [[n, *(number(dig(c, i), 4) for _, c in columns)] for n, i in shown]
    return Table(["Steps ahead", *(name for name, _ in columns)], rows)


def named_values(header: tuple[str, str], values: dict[str, Any]) -> Table:
    """A record as a table, one entry a row."""
    rows = [[str(name), plain(value)] for name, value in values.items()]
    return Table([*header], rows, prose=True)
