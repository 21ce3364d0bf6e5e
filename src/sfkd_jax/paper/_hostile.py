"""Figure of hostile planners in a certified corridor, with and without the shield."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from sfkd_jax.reporting import style
from sfkd_jax.reporting.corridor import band
from sfkd_jax.reporting.scene import switches

_COLOURS = ("#0b57b0", "#009e73", "#8b5fbf", "#b8860b", "#56b4e9", "#6b7280")
_VIEW = 2.2
"""Reach of the second panel, relative to the distance at which the lane ends."""


class Hostile(NamedTuple):
    """Drives of one road.

    Attributes:
        dt: sampling period [s].
        envs: friction and wind at every step.
        width: half of the corridor of the nominal copy [m].
        tube: half width of the tube around that copy [m].
        lane: half width of the lane, less that of the car [m].
        kept: planner -> lateral deviation with the shield [m].
        onset: step at which each drive of `held` and `free` becomes hostile.
        held: lateral deviation with the shield [m].
        free: the same without it [m].
        name: of what they do.
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
    """Write the figure of hostile planners as a PNG.

    Args:
        path: of the PNG.
        drives: the fields of `Hostile`.
    """
    return style.save(path, hostile, Hostile(**drives))


def hostile(drives: Hostile) -> Figure:
    """Hostile planners in the corridor, and one planner without the shield below."""
    figure = style.canvas(7.2)
    ratios = {"sharex": True, "height_ratios": [5, 4.2, 1, 1]}
    panels = inside, lost, friction, wind = figure.subplots(4, 1, **ratios)
    _draw_kept(inside, drives)
    _draw_lost(lost, drives)
    style.conditions(friction, wind, drives.envs, drives.dt)
    for axes in panels:
        style.mark(axes, switches(drives.envs), drives.dt)
    wind.set(xlabel="time [s]", xlim=(0.0, drives.dt * len(drives.envs)))
    figure.align_ylabels()
    _legend(inside)
    _legend(lost)
    return figure


def _draw_kept(axes: Any, drives: Hostile) -> None:
    """All drives with the shield."""
    band(axes, drives.width, drives.tube)
    colours = dict(zip(drives.kept, _COLOURS, strict=False))
    for name, lateral in drives.kept.items():
        look = {"color": colours[name], "linewidth": 0.7, "zorder": 3}
        for row, values in enumerate(lateral):
            time, label = _elapsed(values, drives.dt), f"_{name}" if row else name
            axes.plot(time, values, label=label, **look)
    edge = drives.width + drives.tube
    axes.set(ylim=(-1.25 * edge, 1.25 * edge), ylabel="lateral deviation [m]")
    count = sum(map(len, drives.kept.values()))
    axes.set_title(f"{count} drives with the shield, all planners hostile", pad=20)


def _draw_lost(axes: Any, drives: Hostile) -> None:
    """Drives that become hostile, with the shield and without it."""
    band(axes, drives.width, drives.tube, named=False)
    reach, dark = _VIEW * drives.lane, {"color": style.DARK}
    for side in (-drives.lane, drives.lane):
        axes.axhline(side, linewidth=1.2, linestyle=(0, (6, 2)), zorder=2, **dark)
    words = {"va": "bottom", "ha": "right", "transform": axes.get_yaxis_transform()}
    style.note(axes, 0.995, drives.lane + 0.04, "leaves its lane", **words, **dark)
    rows = zip(drives.onset, drives.free, drives.held, strict=True)
    for row, (onset, free, held) in enumerate(rows):
        begin, outside = int(onset), np.flatnonzero(~(np.abs(free) < 1.2 * reach))
        end = int(outside[0]) + 1 if len(outside) else len(free)
        time, hidden = _elapsed(free, drives.dt), "_" if row else ""
        without = {"color": style.DEPARTED, "label": f"{hidden}without the shield"}
        axes.plot(time[begin:end], free[begin:end], linewidth=1.0, **without)
        shielded = {"color": style.ACCENT, "label": f"{hidden}with the shield"}
        axes.plot(time[begin:], held[begin:], linewidth=0.7, zorder=4, **shielded)
    axes.set(ylim=(-reach, reach), ylabel="lateral deviation [m]")
    axes.yaxis.set_major_locator(MultipleLocator(1.0))
    count = f"{len(drives.free)} drives at {drives.name}"
    axes.set_title(f"{count}, each from one moment on", pad=20)


def _legend(axes: Any) -> None:
    """A legend of one row between a panel and its title."""
    lines, names = axes.get_legend_handles_labels()
    look = {"fontsize": 9, "columnspacing": 1.2, "handlelength": 1.4}
    look |= {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}
    look |= {"borderaxespad": 0.1, "borderpad": 0.2}
    for handle in axes.legend(lines, names, ncols=len(names), **look).get_lines():
        handle.set_linewidth(1.8)


def _elapsed(values: np.ndarray, dt: float) -> np.ndarray:
    """Time of the states after every step [s]."""
    return dt * np.arange(1, len(values) + 1)
