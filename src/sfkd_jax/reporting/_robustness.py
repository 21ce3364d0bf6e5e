"""Studies: every row under a changed protocol beside the same row as it is, one table and one figure a contest."""

from __future__ import annotations

import re
import textwrap
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from sfkd_jax.reporting._benchmark_rows import (
    Contest,
    Line,
    Row,
    by_hardness,
    drawn_for,
    measure,
    name_of,
    title,
)
from sfkd_jax.reporting._benchmark_tables import millimetres
from sfkd_jax.reporting._blocks import Table
from sfkd_jax.reporting._dots import colour, common_range, dot_panels, mark
from sfkd_jax.reporting._numbers import DASH, dig, is_number, number
from sfkd_jax.reporting._style import MUTED, scenario_label

AS_IT_IS = "as it is"
_WHOLE = {"data share": "data share 100 %"}
"""What the plain protocol is called among variations that begin with these words; it is
then the last of them.
"""


class Study(NamedTuple):
    """The variations of one contest on one scenario.

    Attributes:
        contest: whose rows.
        scenario: that was driven.
        levels: variations in words, by size.
        plain: what the protocol without a variation is called.
        rows: by (name of the line, level).
    """

    contest: Contest
    scenario: str
    levels: list[str]
    plain: str
    rows: dict[tuple[str, str], Row]


def studies(rows: list[Row], contest: Contest) -> list[Study]:
    """What was driven with the contest's vehicle and sampling under a variation, by scenario."""
    mine = drawn_for(
        contest,
        [
            row
            for row in rows
            if isinstance(row.get("variation"), str) and _belongs(row, contest)
        ],
    )
    return [
        _study(contest, name, mine)
        for name in by_hardness({str(row.get("scenario")) for row in mine})
    ]


def _study(contest: Contest, scenario: str, mine: list[Row]) -> Study:
    here = [row for row in mine if str(row.get("scenario")) == scenario]
    names = {line.name for line in contest.lines}
    found = {
        (_name(row), str(row["variation"])): row for row in here if _name(row) in names
    }
    levels = list(dict.fromkeys(str(row["variation"]) for row in here))
    kinds = list(dict.fromkeys(map(_words, levels)))
    levels.sort(key=lambda level: (kinds.index(_words(level)), _numbers(level)))
    whole = [
        name
        for start, name in _WHOLE.items()
        if all(level.startswith(start) for level in levels)
    ]
    found |= {
        (line.name, (*whole, AS_IT_IS)[0]): line.rows.get(scenario) or {}
        for line in contest.lines
    }
    return Study(contest, scenario, levels, (*whole, AS_IT_IS)[0], found)


def columns(study: Study) -> list[str]:
    """All levels in the order of the table: the plain protocol first, or last where it is the largest of them."""
    return (
        [*study.levels, study.plain]
        if study.plain != AS_IT_IS
        else [study.plain, *study.levels]
    )


def _belongs(row: Row, contest: Contest) -> bool:
    same = (str(row.get("vehicle")), str(row.get("inner_loop"))) == (
        contest.vehicle,
        contest.inner_loop,
    )
    return same and row.get("sampling") in (contest.sampling, None)


def _name(row: Row) -> str:
    """What the row is called as it is: where e is estimated under a variation, it is measured without."""
    return name_of(row | {"env": "measured"} if row.get("env") == "estimated" else row)


def _words(variation: str) -> str:
    return re.sub(r"[\d.]+", "", variation)


def _numbers(variation: str) -> list[float]:
    return [float(found) for found in re.findall(r"\d+(?:\.\d+)?", variation)]


def _rmse(study: Study, name: str, level: str) -> float | None:
    mean = dig(study.rows.get((name, level)), "rmse_m", "mean")
    return mean if is_number(mean) else None


def robustness(study: Study) -> Figure:
    """One panel a variation: RMSE of every row under it, filled, and as it is, hollow."""
    titles = [
        textwrap.fill(_shown(level), 66 // len(study.levels)) for level in study.levels
    ]

    def score(line: Line) -> float | None:
        return measure(line, study.scenario, "rmse_m", "mean")

    figure, panels, places = dot_panels(study.contest.lines, score, titles)
    for axes, level in zip(panels, study.levels, strict=True):
        for line in study.contest.lines:
            plain, varied = (
                _rmse(study, line.name, name) for name in (study.plain, level)
            )
            shown = [1e3 * value for value in (plain, varied) if value is not None]
            axes.plot(
                shown,
                [places[line.name]] * len(shown),
                color=colour(line),
                linewidth=1.6,
                alpha=0.45,
                gid="row",
            )
            for value, face in ((plain, "white"), (varied, colour(line))):
                if value is not None:
                    style: dict[str, Any] = {
                        "markerfacecolor": face,
                        "markersize": 4.6,
                        "zorder": 4,
                    }
                    axes.plot(
                        1e3 * value,
                        places[line.name],
                        marker="o",
                        color=colour(line),
                        **style,
                    )
    common_range(panels)
    panels[len(panels) // 2].set_xlabel(
        f"lateral RMSE on {scenario_label(study.scenario)} [mm]"
    )
    marks = [
        mark(study.plain, marker="o", markerfacecolor="white"),
        mark("as the title says", marker="o", color=MUTED),
    ]
    figure.legend(handles=marks, loc="outside upper left", ncols=2)
    return figure


def robustness_table(study: Study) -> Table:
    """RMSE of every row at every level, over that of the same row as it is."""
    head = [f"{_shown(level)}\n[mm]" for level in columns(study)]
    rows = [
        [line.name, *(_cell(study, line, level) for level in columns(study))]
        for line in study.contest.lines
    ]
    return Table(
        ["Row", *head],
        rows,
        tuple(place for place, line in enumerate(study.contest.lines) if _own(line)),
    )


def _shown(level: str) -> str:
    """A variation with the signs of print."""
    return re.sub(
        r"(?<=\d)\s+(?=%|m/s|s\b)",
        "\u00a0",
        level.replace("-", "−").replace(" x ", " ×\u00a0"),
    )


def _own(line: Line) -> bool:
    return line.system == "sfkd" and line.env == "measured"


def _cell(study: Study, line: Line, level: str) -> str:
    """The mean, the ratio, and how many episodes left the lane."""
    mean, plain = (_rmse(study, line.name, name) for name in (level, study.plain))
    if mean is None:
        return DASH
    ratio = f" ({number(mean / plain, 2)})" if level != study.plain and plain else ""
    left = dig(study.rows.get((line.name, level)), "departures")
    return f"{millimetres(mean)}{ratio}" + (
        f", {left} left" if is_number(left) and left else ""
    )


def heading(study: Study) -> str:
    """What is varied, and whose rows these are."""
    what = "Share of the training data" if _shares(study) else "What changes cost"
    return f"{what}, {scenario_label(study.scenario)}: {title(study.contest)}"


def caption(study: Study) -> str:
    """What the figure shows."""
    changed = (
        "trained on the share that the panel names"
        if _shares(study)
        else "under the change that the panel names"
    )
    return (
        f"{title(study.contest)}, {scenario_label(study.scenario)}: mean lateral RMSE of every row. Hollow: "
        f"{study.plain}; filled: {changed}. Rows that are told friction and wind above, those that are not below, "
        "each group by its RMSE without the change; the scale is logarithmic and the same in every panel."
    )


def note(study: Study) -> str:
    """What the numbers of the table are."""
    said = (
        "Mean lateral RMSE over the same episodes for all rows of a column; in brackets, over that of the same row at "
        f"“{study.plain}”. “2 left”, where it stands: two episodes left the lane."
    )
    if _shares(study):
        return f"{said} Nominal and oracle learn nothing."
    deaf = any(line.env == "none" for line in study.contest.lines)
    return said + (
        " Rows that are not told friction and wind do not hear what is wrong about them."
        if deaf
        else ""
    )


def _shares(study: Study) -> bool:
    return study.plain in _WHOLE.values()
