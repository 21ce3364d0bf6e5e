"""A certified corridor as ink: around drives of a page, and around hostile planners with their shield and without."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from sfkd_jax.reporting._conditions import conditions, mark
from sfkd_jax.reporting._numbers import number
from sfkd_jax.reporting._scene import Scene, switches
from sfkd_jax.reporting._style import ACCENT, LEAVES, PLATE, canvas, literal, save

_INNER, _OUTER = "#cfe0f5", "#e9f1fb"
_LANE = "#30363d"
_COLOURS = ("#0b57b0", "#009e73", "#8b5fbf", "#b8860b", "#56b4e9", "#6b7280")
_VIEW = 2.2
"""Of the distance from the path at which the lane ends: how far the second panel
reaches.
"""


class Corridor(NamedTuple):
    """Half widths [m]: kept by the shield, and the tube around the copy."""

    width: float
    tube: float


class Hostile(NamedTuple):
    """Drives of one road.

    Attributes:
        dt: sampling period [s].
        envs: friction and wind at every step.
        corridor: certified.
        lane: its half width, less the car's [m].
        kept: planner -> e_y with the shield [m], (drive, time).
        onset: step from which on each drive of the next two is hostile.
        held, free: e_y of such drives with the shield and without it [m].
        name: what they do.
    """

    dt: float
    envs: Float[np.ndarray, "time 2"]
    corridor: Corridor
    lane: float
    kept: dict[str, Float[np.ndarray, "drive time"]]
    onset: Float[np.ndarray, " drive"]
    held: Float[np.ndarray, "drive time"]
    free: Float[np.ndarray, "drive time"]
    name: str


def band(axes: Any, corridor: Corridor, *, named: bool) -> None:
    """Both parts of a corridor along the whole of an axis, and its edge."""
    edge = corridor.width + corridor.tube
    axes.axhspan(-edge, edge, color=_OUTER, linewidth=0, zorder=0.1)
    axes.axhspan(-corridor.width, corridor.width, color=_INNER, linewidth=0, zorder=0.2)
    for side in (-edge, edge):
        axes.axhline(side, color=ACCENT, linewidth=1.2, zorder=2)
    if named:
        words = {
            "fontsize": 8.5,
            "color": ACCENT,
            "va": "bottom",
            "ha": "right",
            "zorder": 6,
            "bbox": PLATE,
        }
        for height, name in ((edge, "W + tube"), (corridor.width, "W")):
            where = {"transform": axes.get_yaxis_transform()}
            axes.text(
                0.995,
                height + 0.03 * edge,
                f"{name} = {number(height)} m",
                **where,
                **words,
            )


def draw_hostile(path: Path, *, width: float, tube: float, **drives: Any) -> Path:
    """Write the figure of hostile planners as a PNG; width, tube: of the corridor [m], the rest as in `Hostile`."""
    return save(path, hostile, Hostile(corridor=Corridor(width, tube), **drives))


def hostile(drives: Hostile) -> Figure:
    """Drives of hostile planners in the corridor, above one planner that loses its car without the shield."""
    figure = canvas(7.2)
    inside, lost, friction, wind = figure.subplots(
        4, 1, sharex=True, height_ratios=[5, 4.2, 1, 1]
    )
    band(inside, drives.corridor, named=True)
    colours = dict(zip(drives.kept, _COLOURS, strict=False))
    for name, lateral in drives.kept.items():
        for row, values in enumerate(lateral):
            label = f"_{name}" if row else name
            inside.plot(
                _time(values, drives.dt),
                values,
                color=colours[name],
                linewidth=0.7,
                label=label,
                zorder=3,
            )
    edge = drives.corridor.width + drives.corridor.tube
    count = sum(map(len, drives.kept.values()))
    inside.set(ylim=(-1.25 * edge, 1.25 * edge), ylabel="lateral deviation [m]")
    inside.set_title(f"{count} drives with the shield, all planners hostile", pad=20)
    band(lost, drives.corridor, named=False)
    reach = _VIEW * drives.lane
    for side in (-drives.lane, drives.lane):
        lost.axhline(side, color=_LANE, linewidth=1.2, linestyle=(0, (6, 2)), zorder=2)
    words = {
        "fontsize": 8.5,
        "color": _LANE,
        "va": "bottom",
        "ha": "right",
        "bbox": PLATE,
    }
    lost.text(
        0.995,
        drives.lane + 0.04,
        "leaves its lane",
        transform=lost.get_yaxis_transform(),
        **words,
    )
    for row, (began, free, held) in enumerate(
        zip(drives.onset, drives.free, drives.held, strict=True)
    ):
        begin, outside = int(began), np.flatnonzero(~(np.abs(free) < 1.2 * reach))
        end = int(outside[0]) + 1 if len(outside) else len(free)
        time, quiet = _time(free, drives.dt), "_" if row else ""
        lost.plot(
            time[begin:end],
            free[begin:end],
            color=LEAVES,
            linewidth=1.0,
            label=f"{quiet}without the shield",
        )
        lost.plot(
            time[begin:],
            held[begin:],
            color=ACCENT,
            linewidth=0.7,
            label=f"{quiet}with the shield",
            zorder=4,
        )
    lost.set(ylim=(-reach, reach), ylabel="lateral deviation [m]")
    lost.yaxis.set_major_locator(MultipleLocator(1.0))
    lost.set_title(
        f"{len(drives.free)} drives at {drives.name}, each from one moment on", pad=20
    )
    conditions(friction, wind, drives.envs, drives.dt)
    for axes in (inside, lost, friction, wind):
        mark(axes, switches(drives.envs), drives.dt)
    wind.set(xlabel="time [s]", xlim=(0.0, drives.dt * len(drives.envs)))
    figure.align_ylabels()
    _named(inside)
    _named(lost)
    return figure


def around_drives(scene: Scene, system: str, corridor: Corridor) -> Figure:
    """e_y of every episode of a system in its corridor."""
    figure = canvas(3.4)
    axes = figure.subplots()
    band(axes, corridor, named=True)
    for values in scene.lateral[system]:
        axes.plot(_time(values, scene.dt), values, color=ACCENT, linewidth=0.6)
    values = np.abs(scene.lateral[system])
    farthest = float(np.max(values, where=np.isfinite(values), initial=0.0))
    reach = 1.25 * max(corridor.width + corridor.tube, farthest)
    axes.set(
        xlabel="time [s]",
        ylabel="lateral deviation [m]",
        ylim=(-reach, reach),
        xlim=(0.0, scene.dt * values.shape[1]),
    )
    count = "the one episode" if len(values) == 1 else f"{len(values)} episodes"
    axes.set_title(
        f"{literal(scene.label)}: {count}, at most {number(farthest)} m from the path"
    )
    mark(axes, switches(scene.envs) if len(values) == 1 else (), scene.dt)
    return figure


def _time(values: np.ndarray, dt: float) -> np.ndarray:
    """Of e_y after every step."""
    return dt * np.arange(1, len(values) + 1)


def _named(axes: Any) -> None:
    """A legend of one row between a panel and its title."""
    lines, names = axes.get_legend_handles_labels()
    place = {
        "loc": "lower left",
        "bbox_to_anchor": (0.0, 1.0),
        "borderaxespad": 0.1,
        "borderpad": 0.2,
    }
    found = axes.legend(
        lines,
        names,
        ncols=len(names),
        fontsize=9,
        columnspacing=1.2,
        handlelength=1.4,
        **place,
    )
    for handle in found.get_lines():
        handle.set_linewidth(1.8)
