"""What is certified about predictions, as ink: the latent radius by step, and the tube about a way that was driven."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, MaxNLocator

from sfkd_jax.reporting._curves import numbers
from sfkd_jax.reporting._numbers import short, upper
from sfkd_jax.reporting._scene import Scene, hardest_step
from sfkd_jax.reporting._style import ACCENT, MUTED, PLATE, SECOND, canvas, literal

_WASH = "#dce8f7"
_REACH = (4.0, 11.0)  # least and most of half the height of the picture from above [m]
_MARGIN = 14.0  # before and behind the stretch that is predicted [m]


def tube(radii: list[Any], ultimate: Any, alpha: Any) -> Figure:
    """The certified latent radius R_k by prediction step, with its limit in words."""
    figure = canvas(3.2)
    axes = figure.subplots()
    steps = np.arange(1, len(radii) + 1)
    values = numbers(radii, len(radii))
    axes.fill_between(steps, 0.0, values, color=ACCENT, alpha=0.12, linewidth=0)
    axes.plot(steps, values, color=ACCENT, marker="o", markersize=4)
    words = [
        f"α = {alpha}",
        f"$R_1$ = {upper(radii[0])},  $R_{{{len(radii)}}}$ = {upper(radii[-1])}",
        f"ultimate bound = {ultimate}",
    ]
    axes.text(
        0.03,
        0.95,
        "\n".join(words),
        transform=axes.transAxes,
        va="top",
        linespacing=1.6,
        color="#30363d",
    )
    axes.set(
        xlabel="steps ahead k",
        ylabel="latent radius $R_k$ [-]",
        xlim=(0.5, len(radii) + 0.5),
    )
    axes.set_ylim(bottom=0.0)
    axes.set_title("Tube that the prediction error cannot leave while ‖d‖ ≤ d̄")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def tube_on_drive(
    scene: Scene, system: str, radii: list[float], errors: list[Any]
) -> Figure:
    """The certified tube of a prediction about a stretch that was driven, from above, and its radius by step.

    Distance is symmetric: a prediction that starts on the way at the dot lies within
    R_k of the k-th state after it.

    Args:
        scene: with states of `system` and a path.
        radii: position radius of the tube [m], by step.
        errors: position RMSE of predictions on held-out drives [m], by step; null where
            it is not known.
    """
    states, steps = scene.states[system], np.arange(1, len(radii) + 1)
    start = int(
        np.clip(
            hardest_step(scene) - len(radii) // 2,
            0,
            max(0, len(states) - 1 - len(radii)),
        )
    )
    figure = canvas(5.6)
    above, below = figure.subplots(2, 1, height_ratios=[1.25, 1])
    _from_above(above, scene, states[:, :2], start, radii)
    above.set_title(
        f"{literal(scene.label)}, first episode: the certified tube about the way driven"
    )
    below.fill_between(steps, radii, 1e-9, color=_WASH, linewidth=0)
    below.plot(steps, radii, color=ACCENT, marker="o", markersize=3.5)
    measured = numbers(errors, len(radii))
    below.plot(
        steps,
        np.where(measured > 0, measured, np.nan),
        color=SECOND,
        marker="s",
        markersize=3.5,
    )
    named = (
        (radii[-1], "certified", ACCENT),
        (measured[-1], "measured RMSE, held-out drives", "#9a6516"),
    )
    for last, name, colour in named:
        if np.isfinite(last) and last > 0:
            words = {
                "textcoords": "offset points",
                "ha": "right",
                "va": "bottom",
                "fontsize": 9,
                "color": colour,
            }
            below.annotate(
                f"{name}: {short(float(last))} m", (steps[-1], last), (0, 6), **words
            )
    lowest = min([*radii, *measured[measured > 0]])
    below.set(
        yscale="log", ylim=(0.4 * lowest, 8 * max(radii)), xlim=(0.5, len(radii) + 0.5)
    )
    below.set(xlabel="steps ahead k", ylabel="position radius [m]")
    below.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    below.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _from_above(
    axes: Any, scene: Scene, way: np.ndarray, start: int, radii: list[float]
) -> None:
    """Discs about the states after `start`, turned so that the car drives to the right; in true scale."""
    ahead = way[start + 1 : start + 1 + len(radii)]
    origin, end = way[start], ahead[-1]
    yaw = np.arctan2(*(end - origin)[::-1])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])

    def turned(points: np.ndarray) -> np.ndarray:
        return turn @ (points - origin).T

    centres = turned(ahead).T
    reach = float(np.clip(1.2 * max(radii) + 2.0, *_REACH))
    quarter = max(1, len(radii) // 4)
    for step in range(len(centres), 0, -1):
        shade = (1.0 - 0.8 * (step - 1) / len(radii)) * np.subtract(1.0, to_rgb(ACCENT))
        named = step % quarter == 0
        edge: dict[str, Any] = {
            "edgecolor": ACCENT if named else "white",
            "linewidth": 0.9 if named else 0.4,
        }
        disc = Circle(
            tuple(centres[step - 1]),
            radii[step - 1],
            facecolor=1.0 - 0.45 * shade,
            zorder=0.4,
            **edge,
        )
        axes.add_patch(disc)
        if named:
            _name(axes, centres[step - 1], radii[step - 1], reach, f"k = {step}")
    if scene.path is not None:
        axes.plot(*turned(scene.path[:, :2]), color="#c9ced6", linewidth=5, zorder=1.5)
    axes.plot(*turned(way), color=MUTED, linewidth=1.0, zorder=3)
    axes.plot(
        *turned(way[start : start + 1 + len(radii)]),
        color=ACCENT,
        linewidth=2.0,
        zorder=4,
    )
    axes.plot(0.0, 0.0, marker="o", markersize=6, color="#1d2329", zorder=5)
    right = float(centres[-1, 0]) + _MARGIN
    axes.set(xlim=(-_MARGIN, right), ylim=(-reach, reach), aspect="equal")
    axes.set(xlabel="along the way [m]", ylabel="across [m]")
    axes.grid(visible=False)


def _name(
    axes: Any, centre: np.ndarray, radius: float, reach: float, name: str
) -> None:
    """The name of a disc above it, or where its edge leaves the picture on the left; none where that is outside."""
    (x, y), height = centre, reach - 1.2
    if y + radius > height - 1.0:
        x -= np.sqrt(max(radius**2 - (height - y) ** 2, 0.0))
    else:
        height = max(y + radius + 0.8, y + 1.2)
    if x > -_MARGIN + 2.5:
        axes.text(
            x,
            height,
            name,
            ha="center",
            va="center",
            fontsize=8.5,
            color=ACCENT,
            bbox=PLATE,
            zorder=6,
        )
