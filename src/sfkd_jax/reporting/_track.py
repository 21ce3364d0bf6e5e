"""The road from above: its geometry, and a figure with its hardest stretch."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from sfkd_jax.reporting import style
from sfkd_jax.reporting.scene import Scene, hardest_step, switches

EXAGGERATION = 10
"""How many times the close-up widens a deviation."""
_CLOSE_UP = 22.0
"""Half the length of the close-up [m]."""
_RING = "#c2255c"

Projections = dict[str, tuple[np.ndarray, np.ndarray]]
"""By system: the closest path point of every state, and the offset to its left [m]."""


def turn_by(yaw: float | np.floating) -> Float[np.ndarray, "2 2"]:
    """The rotation into a frame with this yaw."""
    return np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])


def project(
    positions: Float[np.ndarray, "time 2"], path: Float[np.ndarray, "point column"]
) -> tuple[np.ndarray, np.ndarray]:
    """The closest path point of each position, and the offset to its left [m].

    The search goes forward, so it follows a path that crosses itself.
    """
    near = np.zeros(len(positions), dtype=int)
    for step, position in enumerate(positions):
        last = int(near[step - 1])
        start = max(last - 5, 0) if step else 0
        gap = np.sum((path[start : start + 60, :2] - position) ** 2, axis=1)
        finite = np.all(np.isfinite(position))
        near[step] = start + int(np.argmin(gap)) if finite else last
    left = np.stack([-np.sin(path[near, 2]), np.cos(path[near, 2])], axis=1)
    return near, np.sum((positions - path[near, :2]) * left, axis=1)


def offset_points(
    points: Float[np.ndarray, "point column"], offset: np.ndarray
) -> Float[np.ndarray, "2 point"]:
    """Positions at an offset to the left of path points."""
    x = points[:, 0] - offset * np.sin(points[:, 2])
    return np.stack([x, points[:, 1] + offset * np.cos(points[:, 2])])


def first_outside(values: Float[np.ndarray, " time"], bound: float) -> int:
    """Index of the first value outside ±bound, or not finite; else their number."""
    return int(np.argmin(np.append(np.abs(values) <= bound, False)))


def track(scene: Scene) -> Figure:
    """The road in true scale, and the hardest stretch with widened deviations."""
    path = np.asarray(scene.path, dtype=float)
    drives: Projections = {
        name: project(scene.states[name][:, :2], path)
        for name in style.ordered(scene.states)
    }
    near = drives.get("nominal", next(iter(drives.values())))[0]
    centre = int(near[min(hardest_step(scene) + 1, len(near) - 1)])
    marks = [int(near[step]) for step in switches(scene.envs) if step < len(near)]
    used = path[: max(int(index.max()) for index, _ in drives.values()) + 1]
    low, high = used[:, :2].min(axis=0) - 20.0, used[:, :2].max(axis=0) + 20.0
    close = _close_up(path, centre, drives)
    limits = [
        _framed(*np.stack([low, high]).T, most=0.55),
        _framed(np.array([-_CLOSE_UP, _CLOSE_UP]), close["reach"], most=0.6),
    ]
    shapes = [np.ptp(y) / np.ptp(x) for x, y in limits]
    figure = style.canvas(0.87 * style.WIDTH * sum(shapes) + 1.95)
    figure.set_layout_engine("constrained", hspace=0.09)
    above, below = figure.subplots(2, 1, height_ratios=shapes)
    _draw_road(above, path, used, centre, drives)
    above.set_title(f"{scene.title}: the road from above")
    below.plot(*close["road"], color=style.ROAD, linewidth=4, zorder=1, label="Path")
    for name, points in close["tracks"].items():
        below.plot(*points, **style.line(name))
    for mark in (close["turn"] @ (path[marks, :2] - path[centre, :2]).T)[0]:
        below.axvline(mark, **style.SWITCH)
    _scale_bar(below, limits[1][1][0] + 0.6)
    below.set(xlabel="along the road [m]", yticks=[])
    below.set_title(f"Inside the ring, deviations drawn × {EXAGGERATION}")
    for axes, (x, y) in zip((above, below), limits, strict=True):
        axes.set(xlim=x, ylim=y, aspect="equal")
    style.legend(figure, below)
    return figure


def _draw_road(
    axes: Any, path: np.ndarray, used: np.ndarray, centre: int, drives: Projections
) -> None:
    """The road in true scale, with its start and a ring around the close-up."""
    look = {"color": style.ROAD, "linewidth": 6, "solid_capstyle": "round", "zorder": 1}
    axes.plot(*used[:, :2].T, **look)
    for name, (index, offset) in drives.items():
        points = offset_points(path[index], offset)
        axes.plot(*points, **style.line(name) | {"linewidth": 1.1})
    axes.plot(*path[0, :2], marker="o", markersize=6, color=style.DARK, zorder=6)
    words = {"textcoords": "offset points", "color": style.SOFT, "fontsize": 9}
    axes.annotate("start", path[0, :2], (7, -12), **words)
    ring = {"fill": False, "edgecolor": _RING, "linewidth": 1.3, "zorder": 7}
    axes.add_patch(Circle((path[centre, 0], path[centre, 1]), _CLOSE_UP, **ring))
    axes.set(xlabel="x [m]", ylabel="y [m]")


def _close_up(path: np.ndarray, centre: int, drives: Projections) -> dict[str, Any]:
    """Lines around a path point, turned so that the road runs left to right [m].

    Returns:
        `turn` into this frame, `road`, `tracks` by system with deviations
        × EXAGGERATION, and their lowest and highest y as `reach`.
    """
    x, y, yaw = path[centre, :3]
    turn = turn_by(yaw)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
    inside = np.abs(arc - arc[centre]) < 1.5 * _CLOSE_UP
    road = turn @ (path[inside, :2].T - [[x], [y]])
    tracks, heights = {}, [road[1, np.abs(road[0]) < _CLOSE_UP]]
    for name, (near, offset) in drives.items():
        points = offset_points(path[near], EXAGGERATION * offset)
        points = tracks[name] = turn @ (points[:, inside[near]] - [[x], [y]])
        heights.append(points[1, np.abs(points[0]) < _CLOSE_UP])
    across = np.concatenate(heights)
    across = across[np.abs(across) < 0.6 * _CLOSE_UP]
    reach = np.array([across.min(initial=0.0) - 2.5, across.max(initial=0.0) + 1.0])
    return {"turn": turn, "road": road, "tracks": tracks, "reach": reach}


def _framed(x: np.ndarray, y: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Limits around an extent with a height of 0.2 to `most` times the width."""
    height = max(np.ptp(y), 0.2 * np.ptp(x))
    width = max(np.ptp(x), height / most)
    half = np.array([-0.5, 0.5])
    return np.mean(x) + width * half, np.mean(y) + height * half


def _scale_bar(axes: Any, foot: float) -> None:
    """A bar as long as 0.1 m of deviation is drawn."""
    height, left = 0.1 * EXAGGERATION, -0.96 * _CLOSE_UP
    bar = {"linewidth": 2.5, "solid_capstyle": "butt", "zorder": 8}
    axes.plot([left, left], [foot, foot + height], color=style.DARK, **bar)
    look = {"va": "center", "fontsize": 9, "color": style.DARK}
    style.note(axes, left + 0.7, foot + height / 2, "0.1 m of deviation", **look)
