"""Robustness: RMSE under a changed protocol over the same row's RMSE as it is, one figure per study."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from sfkd_jax.reporting._benchmark_figures import plain_log
from sfkd_jax.reporting._benchmark_rows import Contest, Row, drawn_for, name_of, rank, title
from sfkd_jax.reporting._blocks import Table
from sfkd_jax.reporting._numbers import dig, is_number, number
from sfkd_jax.reporting._style import canvas, literal

_STUDIES = ("environment late", "environment noise", "environment bias", "sensor noise", "side force", "data share")
_COLOURS = ("#0b57b0", "#e8a33d", "#009e73", "#882255", "#56b4e9", "#3c3c3c")
_MARKERS = "osD^vP"
_PANELS = 3


class Study(NamedTuple):
    """Ratios of one group of variations in one contest.

    Attributes:
        name: of the study. contest: whose rows. scenarios: with any ratio. levels: variations, in words.
        names: of the rows. ratios: by (row, scenario, level), RMSE over that of the same row as it is.
    """

    name: str
    contest: Contest
    scenarios: list[str]
    levels: list[str]
    names: list[str]
    ratios: dict[tuple[str, str, str], float]


def studies(rows: list[Row], contest: Contest) -> list[Study]:
    """All studies whose rows drove the contest's vehicle with its sampling."""
    mine = [row for row in rows if isinstance(row.get("variation"), str) and _belongs(row, contest)]
    found = []
    for name in dict.fromkeys(study_of(row["variation"]) for row in mine):
        group = drawn_for(contest, sorted((row for row in mine if study_of(row["variation"]) == name), key=_order))
        ratios = {(name_of(row), str(row.get("scenario")), row["variation"]): _ratio(row, contest) for row in group}
        ratios = {key: value for key, value in ratios.items() if value is not None}
        if ratios:
            names, where, levels = (list(dict.fromkeys(key[place] for key in ratios)) for place in range(3))
            found.append(Study(name, contest, sorted(where), sorted(levels, key=_level), names, ratios))
    return found


def study_of(variation: str) -> str:
    """The study that a variation belongs to: its words without numbers, as "environment late" of 0.5 s late."""
    words = set(re.findall(r"[a-z]+", variation.lower()))
    for name in _STUDIES:
        if set(name.split()) <= words:
            return name
    plain = re.findall(r"[a-z]+", variation.lower())
    return "levels" if plain[:1] == ["levels"] else " ".join(plain[:2]) or variation


def level_of(variation: str, study: str) -> str:
    """What is left of a variation beside the words of its study."""
    left = [word for word in variation.split() if word.lower() not in study.split()]
    return " ".join(left) or variation


def _belongs(row: Row, contest: Contest) -> bool:
    same = (str(row.get("vehicle")), str(row.get("inner_loop"))) == (contest.vehicle, contest.inner_loop)
    return same and row.get("sampling") in (contest.sampling, None)


def _order(row: Row) -> tuple[Any, ...]:
    return (*rank(str(row.get("system"))), str(row.get("env")))


def _level(variation: str) -> tuple[Any, ...]:
    """By the words first, then by the numbers."""
    words = re.sub(r"[\d.]+", "", variation)
    return words, [float(found) for found in re.findall(r"\d+(?:\.\d+)?", variation)]


def _ratio(row: Row, contest: Contest) -> float | None:
    """RMSE over that of the same row without the variation."""
    for line in contest.lines:
        if (line.system, line.env) == (str(row.get("system")), str(row.get("env"))):
            plain = dig(line.rows.get(str(row.get("scenario"))), "rmse_m", "mean")
            mean = dig(row, "rmse_m", "mean")
            return mean / plain if is_number(mean) and is_number(plain) and plain > 0 else None
    return None


def robustness(study: Study) -> Figure:
    """One line a row, one marker a level, one panel a scenario."""
    names = study.scenarios[-_PANELS:]
    figure = canvas(1.6 + 0.235 * len(study.names))
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    looks = [(_COLOURS[place % 6], _MARKERS[place % 6]) for place in range(len(study.levels))]
    for axes, name in zip(panels, names, strict=True):
        axes.axvline(1.0, color="#9aa1ab", linewidth=1.0, zorder=1)
        for place, who in enumerate(study.names):
            values = [study.ratios.get((who, name, level), np.nan) for level in study.levels]
            if np.any(np.isfinite(values)):
                axes.plot([np.nanmin(values), np.nanmax(values)], [place] * 2, color="#d5dae1", linewidth=2, zorder=2)
            for value, (colour, marker) in zip(values, looks, strict=True):
                axes.plot(value, place, color=colour, marker=marker, markersize=5, linestyle="none", zorder=3)
        plain_log(axes.xaxis, axes.set_xscale)
        axes.set(title=literal(name.upper()), xlabel="RMSE over its own\nwithout the change")
    panels[0].set_yticks(range(len(study.names)), [literal(who) for who in study.names])
    panels[0].set_ylim(len(study.names) - 0.4, -0.6)
    shown = [literal(level_of(level, study.name)) for level in study.levels]
    handles = [
        Line2D([], [], color=colour, marker=marker, linestyle="none", label=text)
        for text, (colour, marker) in zip(shown, looks, strict=True)
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=min(4, len(handles)), columnspacing=1.2)
    return figure


def robustness_table(study: Study) -> Table:
    """The ratios of the figure, two decimals."""
    columns = [(name, level) for name in study.scenarios for level in study.levels]
    columns = [pair for pair in columns if any((who, *pair) in study.ratios for who in study.names)]
    head = [f"{name.upper()}\n{level_of(level, study.name)}" for name, level in columns]

    rows = [[who, *(number(study.ratios.get((who, *pair)), 2) for pair in columns)] for who in study.names]
    return Table(["Row", *head], rows, tuple(place for place, who in enumerate(study.names) if who == "SFKD"))


def caption(study: Study) -> str:
    """What the figure shows."""
    return (
        f"{study.name.capitalize()}, {title(study.contest).lower()}: mean lateral RMSE over that of the same row "
        "without the change; 1 means that nothing is lost."
    )
