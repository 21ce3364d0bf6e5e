"""Figures: RMSE of all entries, and their deviation during one episode."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfkd_jax.evaluation.formats import DASH, dig, interval, is_number
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.paper._dots import colour, common_range, dot, dot_panels, sample
from sfkd_jax.paper._drives import Drive, drives
from sfkd_jax.paper._setups import OFF_THE_ROAD_M, Setup, by_hardness, merged
from sfkd_jax.paper._study import Study
from sfkd_jax.paper._tables import has_trainings, trainings
from sfkd_jax.paper._texts import text
from sfkd_jax.reporting.scene import switches
from sfkd_jax.reporting.style import (
    MUTED,
    canvas,
    env_text,
    line,
    literal,
    scenario_label,
    shade,
)

_PRINTED: dict[str, Any] = {"marker": "x", "color": "#9aa1ab"}
_ALWAYS = ("sfkd", "oracle")
_FAMILIES = (
    "SFKD and its parts",
    "friction and wind observed",
    "neither observed",
)
_SECONDS = 15.0


def overview_caption(group: list[Setup], study: Study) -> str:
    """What the figure of all rows shows."""
    several = has_trainings(group)
    marks = text("figures.strokes") if several else ""
    marks += text("figures.crosses") if study.is_printed(group) else ""
    rows = [
        row for one in group for entry in one.entries for row in entry.rows.values()
    ]
    means = [dig(row, "rmse_m", "mean") for row in rows]
    if any(is_number(mean) and mean > OFF_THE_ROAD_M for mean in means):
        marks += text("figures.edge", limit=f"{OFF_THE_ROAD_M:g}")
    over = text("figures.trainings" if several else "figures.episodes")
    return text("figures.overview", over=over, marks=marks)


def overview(group: list[Setup], study: Study) -> Figure:
    """Mean RMSE of every row: one panel per scenario, one kind of mark per setup."""
    entries = merged(group).entries
    names = by_hardness(name for setup in group for name in setup.scenarios)
    figure, panels, heights = dot_panels(
        entries,
        lambda one: one.value(names[-1], "rmse_m", "mean") if names else None,
        [scenario_label(name) for name in names] or [""],
    )
    for axes, name in zip(panels, names, strict=False):
        for i, setup in enumerate(group):
            offset = 0.17 * (len(group) - 1 - 2 * i)
            for one in setup.entries:
                row = one.row(name)
                if row and not (i and not row.get("sampling")):
                    _rmse_mark(
                        axes, row, heights[one.name] - offset, colour(one), i > 0
                    )
        for one in entries:
            value = study.number(one.system, f"rmse_{name}_m")
            if is_number(value):
                style = _PRINTED | {"markersize": 4, "zorder": 2, "gid": "row"}
                dot(axes, 1e3 * value, heights[one.name], **style)
        axes.set_xlabel("RMSE [mm]")
    common_range(panels, sparse=False)
    handles = [
        sample(
            setup.sampling or "measured",
            marker="o",
            **({"markerfacecolor": "white"} if i else {}),
        )
        for i, setup in enumerate(group)
    ]
    if study.is_printed(group):
        handles.append(sample("the paper", **_PRINTED))
    if has_trainings(group):
        handles.append(sample("one training", marker="|", markersize=7))
    if len(handles) > 1:
        figure.legend(handles=handles, loc="outside upper left", ncols=4)
    return figure


def _rmse_mark(axes: Any, row: Row, height: float, color: str, hollow: bool) -> None:
    """Draw the mean of a row with its interval and its trainings."""
    mean = dig(row, "rmse_m", "mean")
    if not is_number(mean):
        return
    if mean > OFF_THE_ROAD_M:
        style: dict[str, Any] = {"color": color, "fontsize": 7.5, "ha": "right"}
        across = axes.get_yaxis_transform()
        far = f"{mean:.1f} m \N{RIGHTWARDS ARROW}"
        axes.text(0.99, height, far, transform=across, va="center", **style)
        return
    ends = dig(row, "rmse_m", "ci95")
    if interval(ends) != DASH:
        ends = [1e3 * end for end in ends]
        axes.plot(ends, [height] * 2, color=color, linewidth=1.4, zorder=3, gid="row")
    single = [1e3 * value for value in trainings(row)]
    if len(single) > 1:
        style = {"marker": "|", "markersize": 7, "linestyle": "none", "gid": "row"}
        axes.plot(single, [height] * len(single), color=color, **style)
    face = {"markerfacecolor": "white" if hollow else color, "markersize": 4.5}
    dot(axes, 1e3 * mean, height, color=color, zorder=4, gid="row", **face)


def deviations(directory: Path, setup: Setup, scenario: str) -> Figure:
    """Lateral deviation of every row in the first episode, over friction and wind."""
    driven, missing = drives(directory, setup.rows_on(scenario))
    panels = [(name, _family(driven, name)) for name in _FAMILIES]
    panels = [
        (f"{scenario_label(scenario)}, {name}", family)
        for name, family in panels
        if any(one.system not in _ALWAYS for one in family)
    ] or [(scenario_label(scenario), driven)]
    figure = canvas(0.9 + 2.05 * len(panels))
    rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    end = min([_SECONDS, *(len(one.lateral) * one.dt for one in driven)])
    for axes, (title, family) in zip(rows, panels, strict=True):
        _panel(axes, family, round(end / family[0].dt) if family else 0)
        axes.set_title(literal(title), pad=30 if axes is rows[0] else 7)
        axes.set(xlim=(0.0, end), ylabel="deviation [m]")
    _shade(rows, next((one for one in driven if one.envs is not None), None), end)
    rows[-1].set_xlabel("time [s]")
    figure.align_ylabels()
    if missing or not driven:
        kind = "figures.not_driven" if driven else "figures.none_driven"
        names = literal(text(kind, names=", ".join(missing) if driven else setup.title))
        figure.supxlabel(names, fontsize=8.5, color="#57606a", wrap=True)
    return figure


def _family(driven: list[Drive], name: str) -> list[Drive]:
    """SFKD and the oracle with one group of the others."""

    def group(one: Drive) -> str:
        part = one.system.startswith("sfkd")
        return _FAMILIES[0 if part else 1 if one.row.get("env") == "measured" else 2]

    return [one for one in driven if one.system in _ALWAYS or group(one) == name]


def _panel(axes: Any, family: list[Drive], last: int) -> None:
    """Draw SFKD, the oracle and the best two others thick, the rest thin."""

    def rmse(one: Drive) -> float:
        mean = dig(one.row, "rmse_m", "mean")
        return mean if is_number(mean) and mean else np.inf

    others = sorted((one for one in family if one.system not in _ALWAYS), key=rmse)
    thick = {one.name for one in others[:2]}
    thick |= {one.name for one in family if one.system in _ALWAYS}
    axes.axhline(0.0, color="#9aa1ab", linewidth=0.8, zorder=1.5)
    for one in family:
        values = one.lateral[:last]
        look = line(one.system) | {"label": literal(one.name)}
        look |= {} if one.name in thick else {"linewidth": 0.8, "alpha": 0.65}
        axes.plot(one.dt * np.arange(1, len(values) + 1), values, **look)
    limit = _limit(family, last)
    axes.set_ylim(-limit, limit)
    axes.grid(visible=False, axis="x")
    if family:
        look = {"fontsize": 8.5, "handlelength": 1.8, "labelspacing": 0.3}
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), **look)


def _limit(family: list[Drive], last: int) -> float:
    """Half height of a panel: SFKD, the oracle and most others fit."""
    peaks = {
        one.name: float(np.nanmax(np.abs(one.lateral[:last]), initial=0.0))
        for one in family
    }
    always = [peaks[one.name] for one in family if one.system in _ALWAYS]
    most = np.quantile([*peaks.values()], 0.85, method="lower") if peaks else 0.0
    return 1.1 * max([float(most), *always, 1e-3])


def _shade(rows: Any, one: Drive | None, end: float) -> None:
    """Shade the levels of friction, and write (μ, w) above the first panel."""
    if one is None or one.envs is None:
        return
    steps = round(end / one.dt)
    edges = [0, *(step for step in switches(one.envs) if step < steps), steps]
    dashed: dict[str, Any] = {
        "color": MUTED,
        "linestyle": (0, (4, 3)),
        "linewidth": 0.9,
    }
    for start, stop in pairwise(edges):
        friction, wind = one.envs[start]
        begin, until = start * one.dt, stop * one.dt
        for axes in rows:
            axes.axvspan(begin, until, color=shade(friction), linewidth=0, zorder=0)
            if start:
                axes.axvline(begin, zorder=1, **dashed)
        rows[0].text(
            (start + stop) / 2 * one.dt,
            1.02,
            env_text(friction, wind).replace(", ", "\n"),
            transform=rows[0].get_xaxis_transform(),
            ha="center",
            va="bottom",
            fontsize=8.5,
            color="#57606a",
        )
