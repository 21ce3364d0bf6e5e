"""Figure of the corridor by speed, with a line for each friction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from sfkd_jax.reporting import style

_COLOURS = ("#c2410c", "#e8a33d", "#009e73", "#56b4e9", "#0b57b0")
_MARKS = "osD^v"


Cars = Mapping[str, Sequence[Mapping[str, Any]]]
"""Name -> points, each with friction, speed [m/s] and corridor_m."""


def draw_speed(path: Path, cars: Cars, *, margin: float) -> Path:
    """Write the figure as a PNG.

    Args:
        path: of the PNG.
        cars: to show.
        margin: from a car in the middle of its lane to the edge of the lane [m].
    """
    return style.save(path, against_speed, cars, margin)


def against_speed(cars: Cars, margin: float) -> Figure:
    """A panel for each car: corridor by speed and friction, and the lane."""
    figure = style.canvas(3.7)
    panels = figure.subplots(1, len(cars), sharey=True, squeeze=False)[0]
    for panel, (name, points) in zip(panels, cars.items(), strict=True):
        for row, friction in enumerate(sorted({one["friction"] for one in points})):
            chosen = [one for one in points if one["friction"] == friction]
            pairs = sorted((one["speed"], one["corridor_m"]) for one in chosen)
            look = {"color": _COLOURS[row % len(_COLOURS)], "markersize": 4}
            look |= {"marker": _MARKS[row % len(_MARKS)], "linewidth": 1.3}
            panel.plot(
                *zip(*pairs, strict=True), label=f"friction {friction:g}", **look
            )
        edge = {"linestyle": (0, (6, 2)), "linewidth": 1.2, "zorder": 2}
        panel.axhline(margin, color=style.MUTED, **edge)
        words = {"va": "bottom", "ha": "left", "color": style.MUTED}
        words |= {"transform": panel.get_yaxis_transform()}
        style.note(
            panel, 0.01, 1.02 * margin, f"edge of the lane: {margin:g} m", **words
        )
        panel.set(xlabel="speed [m/s]", title=style.literal(name))
    widest = max(one["corridor_m"] for points in cars.values() for one in points)
    top = 1.2 * max(margin, min(widest, 3.0 * margin))
    panels[0].set(ylabel="corridor, on either side [m]", ylim=(0.0, top))
    style.legend(figure, panels[0])
    return figure
