"""The paper's Table 1 and what it leaves out, as tables that can be read one by one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sfkd_jax.reporting._benchmark_rows import (
    Contest,
    Line,
    difference,
    known,
    ratio,
    scenarios,
    side,
    together,
)
from sfkd_jax.reporting._blocks import Table
from sfkd_jax.reporting._numbers import (
    DASH,
    dig,
    interval,
    is_number,
    number,
    short,
    upper,
)
from sfkd_jax.reporting._style import scenario_label

Paper = dict[str, dict[str, float]]
_Columns = dict[str, Callable[[Line], str]]

STEPS = ("1", "5", "10", "20")
"""Steps ahead at which prediction without feedback is shown."""


def millimetres(value: Any, digits: int = 1) -> str:
    """A length in m as millimetres."""
    return number(1e3 * value, digits) if is_number(value) else DASH


def percent(share: Any) -> str:
    """A share; one that is not zero is not shown as zero."""
    if not is_number(share):
        return DASH
    return (
        "0" if share == 0 else "< 0.1" if 0 < share < 5e-4 else number(100 * share, 1)
    )


def bounds(pair: Any, digits: int = 1) -> str:
    """An interval in m as millimetres, or an en dash."""
    return (
        DASH
        if interval(pair) == DASH
        else interval([1e3 * one for one in pair], digits)
    )


def with_interval(record: Any) -> str:
    """A mean in m with its 95 % interval, in millimetres; an interval of lengths alone is written with a dash."""
    shown = bounds(dig(record, "ci95"))
    shown = shown if "−" in shown else shown.replace(" to ", "–")
    return millimetres(dig(record, "mean")) + (f" ({shown})" if shown != DASH else "")


def signed(record: Any) -> str:
    """A paired difference with its interval; * above zero for sure, † below."""
    shown = with_interval(record)
    plus = "+" if is_number(dig(record, "mean")) and record["mean"] > 0 else ""
    return plus + shown + {1: " *", 0: "", -1: " †"}[side(dig(record, "ci95"))]


def tracking(contest: Contest, paper: Paper) -> Table:
    """Lateral RMSE with its interval, the paper's beside ours."""
    columns: _Columns = {}
    for name in scenarios(contest):
        columns[f"{scenario_label(name)} RMSE\n[mm] (95 %)"] = _cell(
            name, lambda row: with_interval(row.get("rmse_m"))
        )
        if any(f"rmse_{name}_m" in row for row in paper.values()):
            columns[f"{scenario_label(name)} in the\npaper [mm]"] = _paper(paper, name)
    return _table(contest, columns)


def against(contest: Contest) -> Table:
    """Paired difference to SFKD, and ratio to the oracle."""
    columns: _Columns = {}
    for name in scenarios(contest):
        columns[f"{scenario_label(name)} minus SFKD\n[mm] (95 %)"] = _minus_sfkd(
            contest, name
        )
    names = scenarios(contest)
    columns[f"Over the oracle\n{_heads(names)}"] = lambda line: slashed(
        [number(ratio(contest, line, name), 2) for name in names]
    )
    return _table(contest, columns)


def extremes(contest: Contest, paper: Paper) -> Table:
    """Largest deviation, RMSE after a switch and steering rate."""
    names = scenarios(contest)
    below = _heads(names)
    columns: _Columns = {
        f"Largest [mm]\n{below}": _each(
            names, lambda row: millimetres(row.get("max_deviation_m"), 0)
        ),
        f"After a switch [mm]\n{below}": _each(
            names, lambda row: millimetres(row.get("rmse_after_switch_m"))
        ),
        f"Steering rate [rad/s]\n{below}": _each(
            names, lambda row: number(row.get("smoothness_rad_per_s"))
        ),
    }
    if paper:
        columns["Rate in the\npaper"] = lambda line: number(
            dig(paper.get(line.system), "smoothness_rad_per_s")
        )
    return _table(contest, columns)


def claims(contest: Contest) -> Table:
    """How often predictions left what is claimed about them, and how wide the claim is."""
    names = scenarios(contest)
    columns: _Columns = {
        "V0, theorem\n[%]": _each(
            names, lambda row: percent(dig(row, "violation", "v0"))
        ),
        "V1, certified\ntube [%]": _each(
            names, lambda row: percent(certified(row, "v1"))
        ),
        "its mean\nradius [m]": _each(
            names, lambda row: number(certified(row, "v1_radius_m"), 2)
        ),
        "V1, conformal\ntube [%]": _each(
            names, lambda row: percent(conformal(row, "v1_conformal", "v1"))
        ),
        "mean radius\nof that [m]": _each(
            names,
            lambda row: number(
                conformal(row, "v1_conformal_radius_m", "v1_radius_m"), 2
            ),
        ),
    }
    return _table(contest, columns)


def limits(contest: Contest, paper: Paper) -> Table:
    """Windows beyond one threshold, departures from the lane, and how the planner fared."""
    names = scenarios(contest)
    below = _heads(names)
    columns: _Columns = {
        f"V2 [%]\n{below}": _each(
            names, lambda row: percent(dig(row, "violation", "v2"))
        )
    }
    if paper:
        columns["Rate in the\npaper [%]"] = lambda line: percent(
            dig(paper.get(line.system), "violation_rate")
        )
    columns |= {
        f"Left the lane\n{below}": _each(
            names, lambda row: short(row.get("departures"))
        ),
        f"Unhealthy steps [%]\n{below}": _each(
            names, lambda row: percent(row.get("unhealthy_steps"))
        ),
        f"Effective samples\n{below}": _each(
            names, lambda row: number(row.get("ess"), 0)
        ),
    }
    return _table(contest, columns)


def prediction(contest: Contest) -> Table:
    """Position error of predictions without feedback."""
    return _table(
        contest,
        {f"{step} step{'s' * (step != '1')}\n[mm]": _ahead(step) for step in STEPS},
    )


def cost(group: list[Contest]) -> Table:
    """Time of a control step in every contest of a vehicle, parameters and certified contraction."""
    columns: _Columns = {}
    for contest in group:
        for quantile, words in (("p50", "median"), ("p99", "99 %")):
            columns[
                f"{(contest.sampling or 'control').capitalize()},\n{words} [ms]"
            ] = _time(contest, quantile)
    columns |= {
        "Parameters": lambda line: short(known(line, "params")),
        "Certified α": lambda line: upper(known(line, "alpha")),
    }
    return _table(together(group), columns)


def certified(row: dict[str, Any], key: str) -> Any:
    """A measure of the certified tube, None for a row whose own tube is conformal."""
    return (
        dig(row, "violation", key)
        if dig(row, "violation", "v1_tube") == "certified"
        else None
    )


def conformal(row: dict[str, Any], key: str, own: str) -> Any:
    """A measure of the conformal tube, which for rows without a certificate may stand under the name of their own."""
    found = dig(row, "violation", key)
    return (
        dig(row, "violation", own)
        if found is None and dig(row, "violation", "v1_tube") == "conformal"
        else found
    )


def _cell(
    scenario: str, show: Callable[[dict[str, Any]], str]
) -> Callable[[Line], str]:
    return lambda line: show(line.rows.get(scenario) or {})


def _each(
    names: list[str], show: Callable[[dict[str, Any]], str]
) -> Callable[[Line], str]:
    """One entry per scenario, divided by slashes."""
    return lambda line: slashed([show(line.rows.get(name) or {}) for name in names])


def _heads(names: list[str]) -> str:
    return slashed([scenario_label(name) for name in names])


def slashed(words: list[str]) -> str:
    """One entry per scenario or level, a dash if none is known."""
    return DASH if set(words) == {DASH} else " / ".join(words)


def _paper(paper: Paper, scenario: str) -> Callable[[Line], str]:
    def show(line: Line) -> str:
        mean, std = (
            dig(paper.get(line.system), f"rmse_{scenario}_{end}")
            for end in ("m", "std")
        )
        return (
            f"{millimetres(mean, 0)} ± {millimetres(std, 0)}"
            if is_number(std)
            else millimetres(mean, 0)
        )

    return show


def _minus_sfkd(contest: Contest, scenario: str) -> Callable[[Line], str]:
    return lambda line: signed(difference(contest, line, scenario))


def _ahead(step: str) -> Callable[[Line], str]:
    return lambda line: millimetres(known(line, "open_loop_rmse_m", step))


def _time(contest: Contest, quantile: str) -> Callable[[Line], str]:
    own = {line.name: line for line in contest.lines}
    return lambda line: (
        number(known(own[line.name], "act_ms", quantile), 2)
        if line.name in own
        else DASH
    )


def _table(contest: Contest, columns: _Columns) -> Table:
    """Finished strings; the rows of SFKD stressed."""
    strong = tuple(
        place for place, line in enumerate(contest.lines) if line.system == "sfkd"
    )
    rows = [
        [line.name, *(cell(line) for cell in columns.values())]
        for line in contest.lines
    ]
    return Table(["Row", *columns], rows, strong)
