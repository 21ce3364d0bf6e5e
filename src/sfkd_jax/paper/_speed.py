"""The corridor against speed, a line for each friction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from sfkd_jax.reporting.style import MUTED, PLATE, canvas, legend, literal, save

_COLOURS = ("#c2410c", "#e8a33d", "#009e73", "#56b4e9", "#0b57b0")
_MARKS = "osD^v"


def draw_speed(
    path: Path, cars: Mapping[str, Sequence[Mapping[str, Any]]], *, room: float
) -> Path:
    """Write the figure as a PNG.

    Args:
        cars: name -> cells, each with its friction, speed [m/s] and corridor [m].
        room: of the lane [m].
    """
    return save(path, against_speed, cars, room)


def against_speed(
    cars: Mapping[str, Sequence[Mapping[str, Any]]], room: float
) -> Figure:
    """A panel for each car: corridors by speed and friction, and the room that the lane leaves."""
    figure = canvas(3.7)
    panels = figure.subplots(1, len(cars), sharey=True, squeeze=False)[0]
    for panel, (name, cells) in zip(panels, cars.items(), strict=True):
        for row, friction in enumerate(sorted({cell["friction"] for cell in cells})):
            chosen = sorted(
                (cell["speed"], cell["corridor_m"])
                for cell in cells
                if cell["friction"] == friction
            )
            style = {
                "color": _COLOURS[row % len(_COLOURS)],
                "marker": _MARKS[row % len(_MARKS)],
                "markersize": 4,
            }
            panel.plot(
                *zip(*chosen, strict=True),
                label=f"friction {friction:g}",
                linewidth=1.3,
                **style,
            )
        panel.axhline(room, color=MUTED, linestyle=(0, (6, 2)), linewidth=1.2, zorder=2)
        words = {
            "fontsize": 8.5,
            "color": MUTED,
            "va": "bottom",
            "ha": "left",
            "bbox": PLATE,
        }
        panel.text(
            0.01,
            1.02 * room,
            f"room: {room:g} m",
            transform=panel.get_yaxis_transform(),
            **words,
        )
        panel.set(xlabel="speed [m/s]", title=literal(name))
    widest = max(cell["corridor_m"] for cells in cars.values() for cell in cells)
    panels[0].set(
        ylabel="corridor, on either side [m]",
        ylim=(0.0, 1.2 * max(room, min(widest, 3.0 * room))),
    )
    legend(figure, panels[0])
    return figure
