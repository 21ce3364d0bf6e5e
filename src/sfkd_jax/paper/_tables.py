"""The tables of a results page, and the notes below them."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any, TypeAlias

from sfkd_jax.evaluation.formats import (
    DASH,
    dig,
    interval,
    is_number,
    millimetres,
    number,
    percent,
    plain,
)
from sfkd_jax.evaluation.metrics import BY_NAME, METRICS, Metric, Row
from sfkd_jax.paper._setups import Entry, Setup, difference, merged, ratio, side
from sfkd_jax.paper._study import Study
from sfkd_jax.reporting.blocks import Table
from sfkd_jax.reporting.style import scenario_label

_Columns: TypeAlias = dict[str, Callable[[Entry], str]]

PREDICTIONS = [one for one in METRICS if one.name.startswith("open_loop_rmse_m.")]


def bounds(pair: Any, digits: int = 1) -> str:
    """An interval in m as millimetres."""
    shown = interval(pair) != DASH
    return interval([1e3 * one for one in pair], digits) if shown else DASH


def with_interval(record: Any) -> str:
    """A mean in m with its 95 % interval, as millimetres."""
    shown = bounds(dig(record, "ci95"))
    shown = shown if "−" in shown else shown.replace(" to ", "–")
    return millimetres(dig(record, "mean")) + (f" ({shown})" if shown != DASH else "")


def signed(record: Any) -> str:
    """A paired difference with its interval, marked where that excludes zero."""
    shown, mean = with_interval(record), dig(record, "mean")
    plus = "+" if is_number(mean) and mean > 0 else ""
    return plus + shown + {1: " *", 0: "", -1: " †"}[side(record)]


def slashed(words: list[str]) -> str:
    """One text per scenario or force; one dash if none is known."""
    return DASH if set(words) == {DASH} else " / ".join(words)


def tracking(setup: Setup, study: Study) -> Table:
    """Lateral RMSE with its interval, beside the printed one."""
    columns: _Columns = {}
    for name in setup.scenarios:
        head = scenario_label(name)
        columns[f"{head} RMSE\n[mm] (95 %)"] = _on(
            name, lambda row: with_interval(row.get("rmse_m"))
        )
        if study.prints(f"rmse_{name}_m"):
            columns[f"{head} in the\npaper [mm]"] = _printed_rmse(study, name)
    return _table(setup, columns)


def relative(setup: Setup) -> Table:
    """Paired difference to SFKD, and ratio to the oracle."""
    names = setup.scenarios
    columns: _Columns = {
        f"{scenario_label(name)} minus SFKD\n[mm] (95 %)": _minus_sfkd(setup, name)
        for name in names
    }
    columns[f"Over the oracle\n{_heads(setup)}"] = lambda entry: slashed(
        [number(ratio(setup, entry, name), 2) for name in names]
    )
    return _table(setup, columns)


def decided(setup: Setup) -> str:
    """How the marks of `relative` are found: "by_p", in older results "by_interval"."""
    records = [
        difference(setup, entry, name)
        for entry in setup.entries
        for name in setup.scenarios
    ]
    return (
        "by_p"
        if any(is_number(dig(one, "p_holm")) for one in records)
        else "by_interval"
    )


def extremes(setup: Setup, study: Study) -> Table:
    """Largest deviation, RMSE after a switch and steering rate."""
    rate = BY_NAME["smoothness_rad_per_s"]
    columns = _columns(setup, "max_deviation_m", "rmse_after_switch_m", rate.name)
    if study.printed:
        columns["Rate in the\npaper"] = lambda entry: rate.write(
            study.number(entry.system, rate.name)
        )
    return _table(setup, columns)


def claims(setup: Setup) -> Table:
    """How often predictions left their tubes, and how wide the tubes are."""
    names = ("v0", "v1", "v1_radius_m", "v1_conformal", "v1_conformal_radius_m")
    return _table(setup, _columns(setup, *(f"violation.{name}" for name in names)))


def limits(setup: Setup, study: Study) -> Table:
    """Windows beyond the threshold, departures, and the health of the planner."""
    columns = _columns(setup, "violation.v2")
    if study.printed:
        columns["Rate in the\npaper [%]"] = lambda entry: percent(
            study.number(entry.system, "violation_rate")
        )
    columns |= _columns(setup, "departures", "unhealthy_steps", "ess")
    return _table(setup, columns)


def prediction(setup: Setup) -> Table:
    """Position error of predictions without feedback."""
    columns = {metric.head(mm=True): _constant(metric) for metric in PREDICTIONS}
    return _table(setup, columns)


def cost(group: list[Setup]) -> Table:
    """Time of a control step in every setup, parameters and certified contraction."""
    columns: _Columns = {}
    for setup in group:
        kind = (setup.sampling or "control").capitalize()
        for name, quantile in (("act_ms.p50", "median"), ("act_ms.p99", "99 %")):
            columns[f"{kind},\n{quantile} [ms]"] = _constant(BY_NAME[name], setup)
    columns |= {
        BY_NAME[name].head(): _constant(BY_NAME[name]) for name in ("params", "alpha")
    }
    return _table(merged(group), columns)


def trainings(row: Row | None) -> list[float]:
    """RMSE of every training in m, by seed; equal numbers only once."""
    values = dig(row, "rmse_trainings_m") or [dig(row, "rmse_m", "mean")]
    return list(dict.fromkeys(values)) if all(map(is_number, values)) else []


def has_trainings(group: list[Setup]) -> bool:
    """Whether a row of these setups was trained from several seeds."""
    entries = (entry for setup in group for entry in setup.entries)
    rows = (row for entry in entries for row in entry.rows.values())
    return any(len(trainings(row)) > 1 for row in rows)


def trainings_table(setup: Setup) -> Table:
    """RMSE of every training."""
    rows = [row for entry in setup.entries for row in entry.rows.values()]
    seeds = {seed for row in rows for seed in row.get("seeds") or [] if is_number(seed)}
    below = f"seed {', '.join(map(plain, sorted(seeds)))}"
    columns: _Columns = {
        f"{scenario_label(name)} [mm],\n{below}": _on(name, _trainings_text)
        for name in setup.scenarios
    }
    return _table(setup, columns)


def _trainings_text(row: Row) -> str:
    values = trainings(row)
    shown = ", ".join(millimetres(value) for value in values) or DASH
    if len(values) < 2:
        return shown
    return f"{shown} ± {number(1e3 * statistics.stdev(values), 1)}"


def _on(scenario: str, show: Callable[[Row], str]) -> Callable[[Entry], str]:
    return lambda entry: show(entry.row(scenario))


def _heads(setup: Setup) -> str:
    return slashed([scenario_label(name) for name in setup.scenarios])


def _columns(setup: Setup, *names: str) -> _Columns:
    """One column per metric, with one text per scenario."""
    metrics = [BY_NAME[name] for name in names]
    return {
        f"{one.head(mm=True)}\n{_heads(setup)}": _each(setup, one) for one in metrics
    }


def _each(setup: Setup, metric: Metric) -> Callable[[Entry], str]:
    """A metric on all scenarios of a setup."""
    names = setup.scenarios

    def show(row: Row) -> str:
        if metric.name.endswith("_radius_m"):
            return number(metric.value(row), 2)
        return metric.text(row, mm=True)

    return lambda entry: slashed([show(entry.row(name)) for name in names])


def _constant(metric: Metric, setup: Setup | None = None) -> Callable[[Entry], str]:
    """A metric that no scenario changes, of the entry of the same name in a setup."""

    def show(entry: Entry) -> str:
        own = {one.name: one for one in setup.entries} if setup else {entry.name: entry}
        one = own.get(entry.name)
        return metric.text(one.row_with(metric), mm=True) if one else DASH

    return show


def _printed_rmse(study: Study, scenario: str) -> Callable[[Entry], str]:
    def show(entry: Entry) -> str:
        mean, std = (
            study.number(entry.system, f"rmse_{scenario}_{end}") for end in ("m", "std")
        )
        spread = f" ± {millimetres(std, 0)}" if is_number(std) else ""
        return millimetres(mean, 0) + spread

    return show


def _minus_sfkd(setup: Setup, scenario: str) -> Callable[[Entry], str]:
    return lambda entry: signed(difference(setup, entry, scenario))


def _table(setup: Setup, columns: _Columns) -> Table:
    """A table with the rows of SFKD stressed."""
    strong = [i for i, entry in enumerate(setup.entries) if entry.system == "sfkd"]
    rows = [
        [one.name, *(show(one) for show in columns.values())] for one in setup.entries
    ]
    return Table(["Row", *columns], rows, tuple(strong))
