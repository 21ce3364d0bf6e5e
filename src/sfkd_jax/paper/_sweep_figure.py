"""Figure of many runs: prediction, tracking and bounds by certified contraction."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from sfkd_jax.evaluation.formats import DASH, dig, interval, is_number
from sfkd_jax.paper._sweep_records import Record, curves, scenario_of, steps_of
from sfkd_jax.reporting.style import (
    ACCENT,
    MUTED,
    SECOND,
    THIRD,
    canvas,
    label,
    literal,
    scenario_label,
)

_LOOKS = [("o", ACCENT), ("s", SECOND), ("D", THIRD), ("^", "#882255"), ("v", MUTED)]
_LOOPS = {"none": "no inner loop", "speed": "speed loop"}
_HOLLOW: dict[str, Any] = {
    "markerfacecolor": "white",
    "markeredgewidth": 0.9,
    "markersize": 5,
    "linestyle": "none",
    "zorder": 1.5,
}
_SPREAD = 4.0
"""Ratio of largest to smallest value from which the axis is logarithmic."""


def title_of(record: Record, records: list[Record]) -> str:
    """The inner loop of a run, with its system and vehicle if runs differ in them."""
    differing = [
        key
        for key in ("system", "vehicle")
        if len({other[key] for other in records}) > 1
    ]
    names = [label(str(record[key])) for key in differing]
    return ", ".join(
        [*names, _LOOPS.get(str(record["inner_loop"]), str(record["inner_loop"]))]
    )


def tradeoff(records: list[Record]) -> Figure:
    """Prediction, tracking and latent bounds by certified α, one line per inner loop.

    Args:
        records: of `records_of`, with at least one certificate among them.
    """
    figure = canvas(5.4)
    panels = figure.subplots(2, 2, sharex=True)
    lines, scenario = curves(records), str(scenario_of(records))
    ahead, horizon = steps_of(records, "open_loop"), steps_of(records, "tube")
    measures = {
        f"position error after\n{ahead} steps [m]": ("open_loop", "position_rmse_m"),
        f"lateral RMSE driven,\n{literal(scenario_label(scenario))} [m]": (
            "closed_loop",
            scenario,
            "rmse_m",
            "mean",
        ),
        f"tube after {horizon} steps,\n$R_{{{horizon}}}$ [latent units]": (
            "tube",
            "latent",
        ),
        "ultimate bound\n[latent units]": ("ultimate",),
    }
    for axes, (title, keys) in zip(panels.flat, measures.items(), strict=True):
        for line, (marker, colour) in zip(lines, cycle(_LOOKS), strict=False):
            style: dict[str, Any] = {"color": colour, "marker": marker}
            style |= {"markersize": 5.5}
            name = literal(title_of(line[0], records))
            axes.plot(*_points(line, "alpha", keys), label=name, **style)
            if keys[0] == "closed_loop":
                _whiskers(axes, line, keys[:-1], colour)
            if keys == ("ultimate",):
                axes.plot(
                    *_points(line, "alpha_separate", ("ultimate_separate",)),
                    **style | _HOLLOW,
                )
        _scale(axes)
        axes.set_ylabel(title)
    for axes in panels[1]:
        axes.set_xlabel("certified α [-]")
    figure.align_ylabels()
    drawn = panels[0, 0].get_legend_handles_labels()[0]
    grey: dict[str, Any] = _HOLLOW | {
        "color": MUTED,
        "marker": "o",
        "label": "separate bounds, α = ρ + β",
    }
    figure.legend(
        handles=[*drawn, Line2D([], [], **grey)],
        loc="outside upper left",
        ncols=3,
        columnspacing=1.4,
    )
    return figure


def _points(line: list[Record], abscissa: str, keys: tuple[str, ...]) -> np.ndarray:
    """The pairs with two finite numbers, (2, count)."""
    pairs = [(record[abscissa], dig(record, *keys)) for record in line]
    known = [pair for pair in pairs if all(map(is_number, pair))]
    return np.array(known, dtype=float).reshape(-1, 2).T


def _whiskers(
    axes: Any, line: list[Record], keys: tuple[str, ...], colour: str
) -> None:
    """The 95 % interval of each mean."""
    for record in line:
        bounds = dig(record, *keys, "ci95")
        if interval(bounds) != DASH:
            ends = {"color": colour, "linewidth": 1.0, "marker": "_", "markersize": 6}
            axes.plot([record["alpha"]] * 2, bounds, **ends)


def _scale(axes: Any) -> None:
    """An axis from zero, or a logarithmic one for values of different magnitude."""
    values = np.concatenate(
        [line.get_ydata() for line in axes.get_lines()] or [np.zeros(0)]
    )
    if values.size == 0 or values.min() <= 0 or values.max() < _SPREAD * values.min():
        axes.set_ylim(bottom=0.0)
        return
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
