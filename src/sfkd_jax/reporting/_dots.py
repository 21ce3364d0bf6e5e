"""Dot plots of many rows: who stands where, so that two dozen stay readable and are the same in every figure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sfkd_jax.reporting._benchmark_rows import Line
from sfkd_jax.reporting._style import MUTED, canvas, line, literal

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
    lines: list[Line], score: Callable[[Line], float | None], titles: list[str]
) -> tuple[Figure, list[Any], dict[str, float]]:
    """A figure with one panel a title and one height a line, grouped by what they are told, each group best first.

    Args:
        lines: of a contest.
        score: what a group is sorted by, smallest first; None comes last.
        titles: of the panels.

    Returns:
        Figure, panels, and the height of each line by its name.
    """
    groups = [("told friction and wind", [one for one in lines if one.env != "none"])]
    groups.append(("told neither", [one for one in lines if one.env == "none"]))
    groups = [
        (name, sorted(group, key=lambda one: _last(score(one))))
        for name, group in groups
        if group
    ]
    deep = 1 + max((title.count("\n") for title in titles), default=0)
    figure = canvas(1.35 + 0.16 * deep + _PER_ROW * (len(lines) + 1.3 * len(groups)))
    panels = list(figure.subplots(1, len(titles), sharey=True, squeeze=False)[0])
    names, heights = [], []
    for title, group in groups:
        heights += [heights[-1] + 1.3 if heights else 0.0]
        heights += [heights[-1] + 1.0 + place for place in range(len(group))]
        names += [title, *(literal(one.name) for one in group)]
    ordered = [one for _, group in groups for one in group]
    heads = {name for name, _ in groups}
    of_lines = [
        height for name, height in zip(names, heights, strict=True) if name not in heads
    ]
    places = {one.name: height for one, height in zip(ordered, of_lines, strict=True)}
    panels[0].set_yticks(heights, names)
    panels[0].set_ylim(max(heights, default=0.0) + 0.6, -0.6)
    for text, name in zip(panels[0].get_yticklabels(), names, strict=True):
        if name in heads:
            text.set(color=MUTED, fontstyle="italic")
        text.set(fontsize=9, fontweight="bold" if name == "SFKD" else "normal")
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(literal(title), loc="left", fontsize=9, fontweight="normal")
        axes.tick_params(axis="x", labelsize=8.5)
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
        for one in ordered:
            axes.axhline(places[one.name], color="#eef0f3", linewidth=0.6, zorder=0.6)
            if one.system == "sfkd" and one.env == "measured":
                axes.axhspan(
                    places[one.name] - 0.5,
                    places[one.name] + 0.5,
                    color=_BAND,
                    linewidth=0,
                    zorder=0.5,
                )
    return figure, panels, places


def colour(one: Line) -> str:
    """The colour of a line's system, as in every figure."""
    return line(one.system)["color"]


def mark(name: str, **style: Any) -> Line2D:
    """What stands for a kind of mark, in the colour of no system."""
    look: dict[str, Any] = {"linestyle": "none", "color": MUTED, "label": literal(name)}
    return Line2D([], [], **look | style)


def plain_log(axis: Any, set_scale: Any, *, sparse: bool = False) -> None:
    """A logarithmic axis with plain numbers, `sparse` in a narrow panel; what is not positive is not shown."""
    set_scale("log")
    low, high = axis.get_view_interval()
    subs = next(subs for most, subs in (_FEW if sparse else _MANY) if high < most * low)
    few = sparse and high >= 2 * low
    axis.set_major_locator(
        LogLocator(
            subs=subs, numticks=None if not few else 5 if high < 1e4 * low else 3
        )
    )
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def common_range(panels: list[Any], *, sparse: bool = True) -> None:
    """The same logarithmic range in panels of one quantity, from all artists in them that have a group id."""
    drawn = [
        np.asarray(one.get_xdata(), dtype=float)
        for axes in panels
        for one in axes.get_lines()
        if one.get_gid()
    ]
    values = np.concatenate([*drawn, np.zeros(0)])
    values = values[np.isfinite(values) & (values > 0)]
    low, high = (values.min(), values.max()) if values.size else (1.0, 10.0)
    room = max(1.15, (high / low) ** 0.06)
    for axes in panels:
        axes.set_xlim(low / room, high * room)
        plain_log(axes.xaxis, axes.set_xscale, sparse=sparse)


def _last(value: float | None) -> float:
    return float("inf") if value is None else value
