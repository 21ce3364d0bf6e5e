"""Figure of hostile planners in a certified corridor, with the shield and without it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from sfkd_jax.reporting.corridor import band
from sfkd_jax.reporting.scene import switches
from sfkd_jax.reporting.style import (
    ACCENT,
    DEPARTED,
    PLATE,
    canvas,
    conditions,
    mark,
    save,
)

_LANE = "#30363d"
_COLOURS = ("#0b57b0", "#009e73", "#8b5fbf", "#b8860b", "#56b4e9", "#6b7280")
_VIEW = 2.2
"""Of the distance from the path at which the lane ends: how far the second panel
reaches.
"""


class Hostile(NamedTuple):
    """Drives of one road.

    Attributes:
        dt: sampling period [s].
        envs: friction and wind at every step.
        width: half of the corridor of the nominal copy [m].
        tube: half width of the tube around that copy [m].
        lane: its half width, less the car's [m].
        kept: planner -> e_y with the shield [m], (drive, time).
        onset: step from which on each drive of the next two is hostile.
        held, free: e_y of such drives with the shield and without it [m].
        name: what they do.
    """

    dt: float
    envs: Float[np.ndarray, "time 2"]
    width: float
    tube: float
    lane: float
    kept: dict[str, Float[np.ndarray, "drive time"]]
    onset: Float[np.ndarray, " drive"]
    held: Float[np.ndarray, "drive time"]
    free: Float[np.ndarray, "drive time"]
    name: str


def draw_hostile(path: Path, **drives: Any) -> Path:
    """Write the figure of hostile planners as a PNG; `drives` are those of `Hostile`."""
    return save(path, hostile, Hostile(**drives))


def hostile(drives: Hostile) -> Figure:
    """Drives of hostile planners in the corridor, above one planner that loses its car without the shield."""
    figure = canvas(7.2)
    inside, lost, friction, wind = figure.subplots(
        4, 1, sharex=True, height_ratios=[5, 4.2, 1, 1]
    )
    band(inside, drives.width, drives.tube)
    colours = dict(zip(drives.kept, _COLOURS, strict=False))
    for name, lateral in drives.kept.items():
        for row, values in enumerate(lateral):
            label = f"_{name}" if row else name
            inside.plot(
                _elapsed(values, drives.dt),
                values,
                color=colours[name],
                linewidth=0.7,
                label=label,
                zorder=3,
            )
    edge = drives.width + drives.tube
    count = sum(map(len, drives.kept.values()))
    inside.set(ylim=(-1.25 * edge, 1.25 * edge), ylabel="lateral deviation [m]")
    inside.set_title(f"{count} drives with the shield, all planners hostile", pad=20)
    band(lost, drives.width, drives.tube, named=False)
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
        time, quiet = _elapsed(free, drives.dt), "_" if row else ""
        lost.plot(
            time[begin:end],
            free[begin:end],
            color=DEPARTED,
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


def _elapsed(values: np.ndarray, dt: float) -> np.ndarray:
    """Time of the states after every step [s]."""
    return dt * np.arange(1, len(values) + 1)
