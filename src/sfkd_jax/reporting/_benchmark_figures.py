"""Figures of a comparison: every row's RMSE, and every row's way through the switches."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfkd_jax.reporting._benchmark_rows import (
    OFF_THE_ROAD_M,
    Contest,
    Line,
    by_hardness,
    is_quoted,
    measure,
    scenarios,
    title,
    together,
)
from sfkd_jax.reporting._benchmark_seeds import has_trainings, trainings
from sfkd_jax.reporting._benchmark_tables import Paper
from sfkd_jax.reporting._dots import colour, common_range, dot_panels, mark
from sfkd_jax.reporting._drives import Drive, drives
from sfkd_jax.reporting._numbers import DASH, dig, interval, is_number
from sfkd_jax.reporting._scene import switches
from sfkd_jax.reporting._style import MUTED, canvas, line, literal, scenario_label

FIGURED = "s3"
"""The scenario of Figure 1 and of the film."""
_QUOTED = "#9aa1ab"
_ALWAYS = ("sfkd", "oracle")
_FAMILIES = ("SFKD and its parts", "told friction and wind", "told neither")


def look(one: Line) -> dict[str, Any]:
    """The line of a row: that of its system, under the name that says what it is told."""
    return line(one.system) | {"label": literal(one.name)}


def overview(group: list[Contest], paper: Paper) -> Figure:
    """Mean RMSE of every row with its interval and its single trainings, a panel a scenario, a marker a sampling."""
    rows = together(group).lines
    names = by_hardness({name for contest in group for name in scenarios(contest)})

    def score(one: Line) -> float | None:
        return measure(one, names[-1], "rmse_m", "mean") if names else None

    figure, panels, places = dot_panels(
        rows, score, [scenario_label(name) for name in names] or [""]
    )
    for axes, name in zip(panels, names, strict=False):
        for shift, contest in enumerate(group):
            _dots(
                axes,
                contest,
                name,
                places,
                hollow=shift > 0,
                raised=0.17 * (len(group) - 1 - 2 * shift),
            )
        printed = [
            (dig(paper.get(one.system), f"rmse_{name}_m"), places[one.name])
            for one in rows
        ]
        quoted = np.array(
            [pair for pair in printed if is_number(pair[0])], dtype=float
        ).reshape(-1, 2)
        cross: dict[str, Any] = {
            "marker": "x",
            "markersize": 4,
            "color": _QUOTED,
            "zorder": 2,
        }
        axes.plot(
            1e3 * quoted[:, 0], quoted[:, 1], linestyle="none", gid="row", **cross
        )
        axes.set_xlabel("RMSE [mm]")
    common_range(panels, sparse=False)
    kinds = [contest.sampling or "measured" for contest in group]
    faces = [
        {} if not place else {"markerfacecolor": "white"} for place in range(len(kinds))
    ]
    handles = [
        mark(kind, marker="o", **face) for kind, face in zip(kinds, faces, strict=True)
    ]
    if is_quoted(group, paper):
        handles.append(mark("the paper", marker="x", color=_QUOTED))
    if has_trainings(group):
        handles.append(mark("one training", marker="|", markersize=7))
    if len(handles) > 1:
        figure.legend(handles=handles, loc="outside upper left", ncols=4)
    return figure


def _dots(
    axes: Any,
    contest: Contest,
    name: str,
    places: dict[str, float],
    *,
    hollow: bool,
    raised: float,
) -> None:
    """Means and intervals of a contest, each at the place of its row."""
    for one in contest.lines:
        mean = measure(one, name, "rmse_m", "mean")
        if mean is None or (hollow and not one.rows[name].get("sampling")):
            continue
        place, ink = places[one.name] - raised, colour(one)
        if mean > OFF_THE_ROAD_M:
            words: dict[str, Any] = {
                "transform": axes.get_yaxis_transform(),
                "ha": "right",
                "va": "center",
            }
            axes.text(
                0.99,
                place,
                f"{mean:.1f} m \N{RIGHTWARDS ARROW}",
                color=ink,
                fontsize=7.5,
                **words,
            )
            continue
        ends = dig(one.rows[name], "rmse_m", "ci95")
        if interval(ends) != DASH:
            axes.plot(
                [1e3 * end for end in ends],
                [place] * 2,
                color=ink,
                linewidth=1.4,
                zorder=3,
                gid="row",
            )
        single = [1e3 * value for value in trainings(one.rows[name])]
        if len(single) > 1:
            axes.plot(
                single,
                [place] * len(single),
                marker="|",
                markersize=7,
                color=ink,
                linestyle="none",
                gid="row",
            )
        face = "white" if hollow else ink
        axes.plot(
            1e3 * mean,
            place,
            marker="o",
            markersize=4.5,
            color=ink,
            markerfacecolor=face,
            zorder=4,
            gid="row",
        )


def through_switches(
    directory: Path | None, contest: Contest, seconds: float = 15.0
) -> Figure:
    """Figure 1: lateral deviation of every row in the first episode, over shaded levels of friction and wind."""
    found, absent = drives(directory, contest, FIGURED) if directory else ([], [])
    panels = [(name, _family(found, name)) for name in _FAMILIES]
    panels = [
        (name, family)
        for name, family in panels
        if any(one.line.system not in _ALWAYS for one in family)
    ]
    panels = panels or [("", found)]
    figure = canvas(0.9 + 2.05 * len(panels))
    rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    end = min([seconds, *(len(one.lateral) * one.dt for one in found)])
    for axes, (name, family) in zip(rows, panels, strict=True):
        _panel(axes, family, round(end / family[0].dt) if family else 0)
        axes.set_title(
            literal(
                ", ".join(
                    [scenario_label(FIGURED), name]
                    if name
                    else [scenario_label(FIGURED)]
                )
            ),
            pad=30 if axes is rows[0] else 7,
        )
        axes.set(xlim=(0.0, end), ylabel="deviation [m]")
    _shade(rows, next((one for one in found if one.envs is not None), None), end)
    rows[-1].set_xlabel("time [s]")
    figure.align_ylabels()
    if absent or not found:
        said = (
            f"No driven episode of: {', '.join(absent)}."
            if found
            else f"No driven episode in: {title(contest)}."
        )
        figure.supxlabel(literal(said), fontsize=8.5, color="#57606a", wrap=True)
    return figure


def _family(found: list[Drive], name: str) -> list[Drive]:
    """SFKD and oracle with one group of the others."""

    def group(one: Line) -> str:
        own, told = _FAMILIES[0], _FAMILIES[1 if one.env == "measured" else 2]
        return own if one.system.startswith("sfkd") else told

    return [
        one for one in found if one.line.system in _ALWAYS or group(one.line) == name
    ]


def _panel(axes: Any, family: list[Drive], last: int) -> None:
    """SFKD, oracle and the best two of the others in full, the rest thin; who leaves the frame does so visibly."""
    score = {
        one.line.name: measure(one.line, FIGURED, "rmse_m", "mean") or np.inf
        for one in family
    }
    others = sorted(
        (one.line for one in family if one.line.system not in _ALWAYS),
        key=lambda one: score[one.name],
    )
    strong = {one.name for one in others[:2]} | {
        one.line.name for one in family if one.line.system in _ALWAYS
    }
    axes.axhline(0.0, color="#9aa1ab", linewidth=0.8, zorder=1.5)
    for one in family:
        values = one.lateral[:last]
        thin = {} if one.line.name in strong else {"linewidth": 0.8, "alpha": 0.65}
        axes.plot(
            one.dt * np.arange(1, len(values) + 1), values, **look(one.line) | thin
        )
    peaks = [
        float(np.nanmax(np.abs(one.lateral[:last]), initial=0.0)) for one in family
    ]
    whole = [
        peak
        for one, peak in zip(family, peaks, strict=True)
        if one.line.system in _ALWAYS
    ]
    reach = 1.1 * max(
        [
            float(np.quantile(peaks, 0.85, method="lower")) if peaks else 0.0,
            *whole,
            1e-3,
        ]
    )
    axes.set_ylim(-reach, reach)
    axes.grid(visible=False, axis="x")
    if family:
        axes.legend(
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
            fontsize=8.5,
            handlelength=1.8,
            labelspacing=0.3,
        )


def _shade(rows: Any, one: Drive | None, end: float) -> None:
    """Levels of friction as shades, the darker the more slippery, with (μ, w) above the first panel."""
    if one is None or one.envs is None:
        return
    steps = round(end / one.dt)
    edges = [0, *(step for step in switches(one.envs) if step < steps), steps]
    for start, stop in pairwise(edges):
        friction, wind = one.envs[start]
        for axes in rows:
            axes.axvspan(
                start * one.dt,
                stop * one.dt,
                color=shade(friction),
                linewidth=0,
                zorder=0,
            )
            if start:
                axes.axvline(
                    start * one.dt,
                    color=MUTED,
                    linestyle=(0, (4, 3)),
                    linewidth=0.9,
                    zorder=1,
                )
        rows[0].text(
            (start + stop) / 2 * one.dt, 1.02, conditions(friction, wind).replace(", ", "\n"),
            transform=rows[0].get_xaxis_transform(), ha="center", va="bottom", fontsize=8.5, color="#57606a",
        )  # fmt: skip


def shade(friction: float) -> tuple[float, float, float]:
    """White for a dry road, blue grey for a slippery one."""
    depth = float(np.clip((0.9 - friction) / 0.6, 0.0, 1.0))
    return 1.0 - 0.14 * depth, 1.0 - 0.10 * depth, 1.0 - 0.05 * depth


def conditions(friction: float, wind: float) -> str:
    """Friction and wind in words."""
    words = f"w {wind:+.2g} m/s".replace("-", "−") if abs(wind) > 1e-3 else "no wind"
    return f"μ {friction:.2g}, {words}"
