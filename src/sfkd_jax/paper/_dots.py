"""Dot plots with one height per entry, the same in every figure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sfkd_jax.paper._setups import Entry
from sfkd_jax.reporting.style import MUTED, canvas, line, literal

_PER_ROW = 0.205  # height of a row [in]
_BAND = "#eef4fc"
_NARROW = (2.0, (1.0, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0))
_WIDE = (float("inf"), (1.0,))
_FEW = (_NARROW, (100.0, (1.0, 3.0)), _WIDE)
_MANY = (
    _NARROW,
    (5.0, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)),
    (30.0, (1.0, 2.0, 5.0)),
    (300.0, (1.0, 3.0)),
    _WIDE,
)
"""(range of a logarithmic axis, its ticks in a decade), the narrowest first."""


def dot_panels(
    entries: list[Entry], score: Callable[[Entry], float | None], titles: list[str]
) -> tuple[Figure, list[Any], dict[str, float]]:
    """Make a figure with one panel per title and one height per entry.

    Entries are grouped by whether they observe e, each group sorted by its score.

    Args:
        entries: of a setup.
        score: sorts a group, smallest first; None comes last.
        titles: of the panels.

    Returns:
        Figure, panels, and the height of each entry by its name.
    """
    groups = {
        "observe friction and wind": [one for one in entries if one.env != "none"],
        "observe neither": [one for one in entries if one.env == "none"],
    }
    names: list[tuple[str, Entry | None]] = []
    heights: list[float] = []
    for head, group in groups.items():
        if group:
            start = heights[-1] + 1.3 if heights else 0.0
            heights += [start + index for index in range(1 + len(group))]
            ordered = sorted(group, key=lambda one: _last(score(one)))
            names += [(head, None), *((one.name, one) for one in ordered)]
    deep = 1 + max((title.count("\n") for title in titles), default=0)
    rows = len(entries) + 1.3 * sum(map(bool, groups.values()))
    figure = canvas(1.35 + 0.16 * deep + _PER_ROW * rows)
    panels = list(figure.subplots(1, len(titles), sharey=True, squeeze=False)[0])
    placed = list(zip(names, heights, strict=True))
    _name_heights(panels[0], placed)
    shown = [(one, height) for (_, one), height in placed if one is not None]
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(literal(title), loc="left", fontsize=9, fontweight="normal")
        _rule(axes, shown)
    return figure, panels, {one.name: height for one, height in shown}


def _name_heights(
    axes: Any, placed: list[tuple[tuple[str, Entry | None], float]]
) -> None:
    """Write the names of groups and entries beside the first panel."""
    heights = [height for _, height in placed]
    axes.set_yticks(
        heights, [literal(name) if one else name for (name, one), _ in placed]
    )
    axes.set_ylim(max(heights, default=0.0) + 0.6, -0.6)
    for text, ((name, one), _) in zip(axes.get_yticklabels(), placed, strict=True):
        if one is None:
            text.set(color=MUTED, fontstyle="italic")
        text.set(fontsize=9, fontweight="bold" if name == "SFKD" else "normal")


def _rule(axes: Any, shown: list[tuple[Entry, float]]) -> None:
    """Draw a thin line at every entry and a band behind SFKD."""
    axes.tick_params(axis="x", labelsize=8.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    band: dict[str, Any] = {"color": _BAND, "linewidth": 0, "zorder": 0.5}
    for one, height in shown:
        axes.axhline(height, color="#eef0f3", linewidth=0.6, zorder=0.6)
        if one.is_main:
            axes.axhspan(height - 0.5, height + 0.5, **band)


def dot(axes: Any, value: float, height: float, **style: Any) -> None:
    """Draw one mark; with `gid` it counts for the common range."""
    axes.plot(value, height, **{"marker": "o", "linestyle": "none"} | style)


def colour(entry: Entry) -> str:
    """The colour of a system, as in every figure."""
    return line(entry.system)["color"]


def sample(name: str, **style: Any) -> Line2D:
    """An entry of a legend that explains a kind of mark, in grey."""
    look: dict[str, Any] = {"linestyle": "none", "color": MUTED, "label": literal(name)}
    return Line2D([], [], **look | style)


def plain_log(axis: Any, set_scale: Any, *, sparse: bool = False) -> None:
    """Make an axis logarithmic with plain numbers, fewer of them if `sparse`."""
    set_scale("log")
    low, high = axis.get_view_interval()
    subs = next(subs for most, subs in (_FEW if sparse else _MANY) if high < most * low)
    count = 5 if high < 1e4 * low else 3
    ticks = count if sparse and high >= 2 * low else None
    axis.set_major_locator(LogLocator(subs=subs, numticks=ticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def common_range(panels: list[Any], *, sparse: bool = True) -> None:
    """Give panels the same logarithmic range, that of all artists with a group id."""
    drawn = [
        np.asarray(one.get_xdata(), dtype=float)
        for axes in panels
        for one in axes.get_lines()
        if one.get_gid()
    ]
    values = np.concatenate([*drawn, np.zeros(0)])
    values = values[np.isfinite(values) & (values > 0)]
    low, high = (values.min(), values.max()) if values.size else (1.0, 10.0)
    margin = max(1.15, (high / low) ** 0.06)
    for axes in panels:
        axes.set_xlim(low / margin, high * margin)
        plain_log(axes.xaxis, axes.set_xscale, sparse=sparse)


def _last(value: float | None) -> float:
    return float("inf") if value is None else value
