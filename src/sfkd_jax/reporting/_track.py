"""The road from above: one figure, drawn from states and path alone."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from sfkd_jax.reporting._scene import Scene, hardest_step, switches
from sfkd_jax.reporting._style import (
    MUTED,
    PLATE,
    WIDTH,
    canvas,
    legend,
    line,
    literal,
    ordered,
)

EXAGGERATION = 10
"""How many times the overhead close-up widens a deviation."""
_CLOSE_UP = 22.0  # half its length [m]
_RING = "#c2255c"


def track(scene: Scene) -> Figure:
    """The road from above in true scale, and a close-up of the hardest stretch with deviations widened."""
    path = np.asarray(scene.path, dtype=float)
    drawn = {
        name: _projected(scene.states[name][:, :2], path)
        for name in ordered(scene.states)
    }
    near = drawn.get("nominal", next(iter(drawn.values())))[0]
    centre = int(near[min(hardest_step(scene) + 1, len(near) - 1)])
    marks = [int(near[step]) for step in switches(scene.envs) if step < len(near)]
    used = path[: max(int(index.max()) for index, _ in drawn.values()) + 1]
    edges = np.stack([used[:, :2].min(axis=0) - 20.0, used[:, :2].max(axis=0) + 20.0])
    close = _close_up(path, centre, drawn)
    limits = [
        _framed(*edges.T, most=0.55),
        _framed(np.array([-_CLOSE_UP, _CLOSE_UP]), close.reach, most=0.6),
    ]
    shapes = [np.ptp(y) / np.ptp(x) for x, y in limits]
    figure = canvas(0.87 * WIDTH * sum(shapes) + 1.95)
    figure.set_layout_engine("constrained", hspace=0.09)
    above, below = figure.subplots(2, 1, height_ratios=shapes)
    above.plot(
        used[:, 0],
        used[:, 1],
        color="#d5dae1",
        linewidth=6,
        solid_capstyle="round",
        zorder=1,
    )
    for name, (index, offset) in drawn.items():
        above.plot(*_widened(path[index], offset, 1), **line(name) | {"linewidth": 1.1})
    above.plot(*path[0, :2], marker="o", markersize=6, color="#30363d", zorder=6)
    above.annotate(
        "start",
        path[0, :2],
        xytext=(7, -12),
        textcoords="offset points",
        color="#57606a",
        fontsize=9,
    )
    above.add_patch(
        Circle(
            (path[centre, 0], path[centre, 1]),
            _CLOSE_UP,
            fill=False,
            edgecolor=_RING,
            linewidth=1.3,
            zorder=7,
        )
    )
    above.set(
        xlabel="x [m]",
        ylabel="y [m]",
        title=f"{literal(scene.label)}, first episode: the road from above",
    )
    below.plot(*close.road, color="#d5dae1", linewidth=4, zorder=1, label="Path")
    for name, points in close.tracks.items():
        below.plot(*points, **line(name))
    for mark in (close.turn @ (path[marks, :2] - path[centre, :2]).T)[0]:
        below.axvline(mark, color=MUTED, linestyle=(0, (4, 3)), linewidth=0.9, zorder=1)
    _scale_bar(below, limits[1][1][0] + 0.6)
    below.set(
        xlabel="along the road [m]",
        yticks=[],
        title=f"Inside the ring, deviations drawn × {EXAGGERATION}",
    )
    for axes, (x, y) in zip((above, below), limits, strict=True):
        axes.set(xlim=x, ylim=y, aspect="equal")
    legend(figure, below)
    return figure


class _CloseUp(NamedTuple):
    """Lines around a path point, turned so that the road runs left to right [m]."""

    turn: np.ndarray
    road: np.ndarray
    tracks: dict[str, np.ndarray]
    reach: np.ndarray


def _close_up(
    path: np.ndarray, centre: int, drawn: dict[str, tuple[np.ndarray, np.ndarray]]
) -> _CloseUp:
    """The stretch around a path point with deviations × EXAGGERATION; `reach` is its extent across."""
    x, y, yaw = path[centre, :3]
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
    inside = np.abs(arc - arc[centre]) < 1.5 * _CLOSE_UP
    road = turn @ (path[inside, :2].T - [[x], [y]])
    tracks, heights = {}, [road[1, np.abs(road[0]) < _CLOSE_UP]]
    for name, (near, offset) in drawn.items():
        keep = inside[near]
        tracks[name] = turn @ (
            _widened(path[near], offset, EXAGGERATION)[:, keep] - [[x], [y]]
        )
        heights.append(tracks[name][1, np.abs(tracks[name][0]) < _CLOSE_UP])
    across = np.concatenate(heights)
    across = across[np.abs(across) < 0.6 * _CLOSE_UP]
    return _CloseUp(
        turn,
        road,
        tracks,
        np.array([across.min(initial=0.0) - 2.5, across.max(initial=0.0) + 1.0]),
    )


def _framed(x: np.ndarray, y: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Limits around an extent with a height of 0.2 to `most` times the width."""
    height = max(np.ptp(y), 0.2 * np.ptp(x))
    width = max(np.ptp(x), height / most)
    half = np.array([-0.5, 0.5])
    return np.mean(x) + width * half, np.mean(y) + height * half


def _scale_bar(axes: Any, foot: float) -> None:
    """A bar as long as 0.1 m of deviation is drawn."""
    height, left = 0.1 * EXAGGERATION, -0.96 * _CLOSE_UP
    axes.plot(
        [left, left],
        [foot, foot + height],
        color="#30363d",
        linewidth=2.5,
        solid_capstyle="butt",
        zorder=8,
    )
    axes.text(
        left + 0.7,
        foot + height / 2,
        "0.1 m of deviation",
        va="center",
        fontsize=9,
        color="#30363d",
        bbox=PLATE,
    )


def _projected(
    positions: np.ndarray, path: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The closest path point of each position, searched forward, and the offset to its left [m]."""
    near = np.zeros(len(positions), dtype=int)
    for step, position in enumerate(positions):
        start = max(int(near[step - 1]) - 5, 0) if step else 0
        gap = np.sum((path[start : start + 60, :2] - position) ** 2, axis=1)
        near[step] = (
            start + int(np.argmin(gap))
            if np.all(np.isfinite(position))
            else near[step - 1]
        )
    left = np.stack([-np.sin(path[near, 2]), np.cos(path[near, 2])], axis=1)
    return near, np.sum((positions - path[near, :2]) * left, axis=1)


def _widened(points: np.ndarray, offset: np.ndarray, factor: int) -> np.ndarray:
    """Positions `factor` times as far left of their path points as driven, (2, time)."""
    return np.stack(
        [
            points[:, 0] - factor * offset * np.sin(points[:, 2]),
            points[:, 1] + factor * offset * np.cos(points[:, 2]),
        ]
    )
