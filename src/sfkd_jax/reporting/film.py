"""Animations of drives of one road: a copy of the road for every car."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import matplotlib
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from sfkd_jax.reporting import style
from sfkd_jax.reporting._film import BAND, EDGE, HALF_LANE, LANE, Move, draw_strip
from sfkd_jax.reporting._film import Car as Car
from sfkd_jax.reporting._film import Film as Film
from sfkd_jax.reporting._track import first_outside, offset_points, project, turn_by

MAX_BYTES = 2_000_000
SECONDS = 13.5
_COLOURS = 48
_INCHES_PER_METRE, _OTHER_INCHES = 0.123, 2.1
"""Scale of the road, and the height of the rest of the figure."""
_AHEAD, _BEHIND = 28.0, 14.0
"""Of the view around the first car [m]."""
_SPACING = 7.6
"""Between two copies of the road [m]."""
_BELOW = 2.6
"""Space below the last copy for a car that leaves it [m]."""
_NAMED = 2.8
"""How far from the middle of a copy a name follows its car [m]."""
_TRAIL = 20
"""[steps]"""
_CAR = np.array([[2.4, 1.8, -2.2, -2.2, 1.8], [0.0, 0.85, 0.85, -0.85, -0.85]])
"""Corners of a car in its frame [m]."""
_SIDE: dict[str, Any] = dict(color="#aab1ba", linewidth=1.3, zorder=2)
_MIDDLE = _SIDE | dict(linewidth=0.9, linestyle=(0, (6, 5)))


class _View(NamedTuple):
    """The frame of the first car.

    Attributes:
        point: index of the path point nearest to it.
        origin: position of that point, (2, 1).
        yaw: of the path there.
        turn: into this frame.
    """

    point: int
    origin: np.ndarray
    yaw: float
    turn: np.ndarray

    def of(self, points: np.ndarray, offset: np.ndarray, shift: float) -> np.ndarray:
        """Positions to the left of path points on a copy of the road, (2, point)."""
        positions = self.turn @ (offset_points(points, offset) - self.origin)
        return positions + np.array([[0.0], [shift]])


_Part: TypeAlias = Callable[[int, _View], None]
"""Draws one part of the road after a step."""


def extent(film: Film) -> tuple[float, float]:
    """Lower and upper end of the view, from the middle of the last copy [m]."""
    lateral = film.cars[-1].lateral
    leaves = first_outside(lateral, LANE) < len(lateral)
    return -0.5 * _SPACING - _BELOW * leaves, (len(film.cars) - 0.5) * _SPACING


def draw_road(axes: Any, film: Film, last: int) -> Move:
    """Draw every car on its copy of the road, with friction and wind."""
    factor, path = film.widening(last), np.asarray(film.points)
    shifts = _SPACING * np.arange(len(film.cars) - 1, -1, -1.0)
    half = factor * (film.corridor or 0.0)
    parts: list[_Part] = [_draw_lane(axes, path, half, shift) for shift in shifts]
    drives = [project(np.asarray(car.states)[:, :2], path) for car in film.cars]
    for car, (near, offset), shift in zip(film.cars, drives, shifts, strict=True):
        left = first_outside(offset, LANE)
        departure = left, f"left its lane ({LANE} m) at {left * film.dt:.1f} s"
        drawn = path[near], factor * offset
        parts.append(_draw_car(axes, car, drawn, shift, departure))
    axes.set(xlim=(-_BEHIND, _AHEAD), ylim=extent(film), xticks=[], yticks=[])
    axes.set_aspect("equal")
    title = f"{style.literal(film.title)}, deviations × {factor}"
    axes.set_title(title, fontsize=9.5, loc="right", pad=4)
    if film.envs is not None:
        parts.append(_draw_conditions(axes, film.envs, 0.5 * shifts[0]))

    def move(step: int) -> None:
        centre = int(drives[0][0][step + 1])
        x, y, yaw = path[centre, :3]
        view = _View(centre, np.array([[x], [y]]), yaw, turn_by(yaw))
        for part in parts:
            part(step, view)

    return move


def _draw_lane(axes: Any, path: np.ndarray, half: float, shift: float) -> _Part:
    """Middle and edges of a copy, and the corridor around its middle."""
    lines = {side: axes.plot([], [], **_SIDE)[0] for side in (-HALF_LANE, HALF_LANE)}
    lines[0.0] = axes.plot([], [], **_MIDDLE)[0]
    band = axes.add_patch(Polygon(np.zeros((1, 2)), **BAND))
    if half:
        lines |= {side: axes.plot([], [], **EDGE)[0] for side in (-half, half)}

    def move(_: int, view: _View) -> None:
        points = path[max(view.point - 120, 0) : view.point + 160]
        drawn = {}
        for side, line in lines.items():
            drawn[side] = view.of(points, np.full(len(points), side), shift)
            line.set_data(*drawn[side])
        if half:
            band.set_xy(np.hstack([drawn[half], drawn[-half][:, ::-1]]).T)

    return move


def _draw_car(
    axes: Any,
    car: Car,
    drawn: tuple[np.ndarray, np.ndarray],
    shift: float,
    departure: tuple[int, str],
) -> _Part:
    """A car, its trail and its name, until it is as far away as the next copy.

    Args:
        axes: of the road.
        car: to draw.
        drawn: path points beside it, and how far left of them it is drawn [m].
        shift: of its copy [m].
        departure: the step at which it leaves its lane, and the words for that.
    """
    (points, offset), states = drawn, np.asarray(car.states)
    body: dict[str, Any] = dict(fc=car.colour, ec=style.DARK, linewidth=0.8, zorder=6)
    shape = axes.add_patch(Polygon(_CAR.T, **body))
    trail = axes.plot([], [], color=car.colour, linewidth=1.8, zorder=4)[0]
    look: dict[str, Any] = {"fontsize": 10, "fontweight": "bold", "va": "center"}
    look |= {"color": car.colour, "zorder": 8, "bbox": style.PLATE | {"alpha": 0.75}}
    name = axes.text(3.2, shift, style.literal(car.name), **look)
    seen = first_outside(offset, _SPACING)

    def move(step: int, view: _View) -> None:
        now = step + 1
        recent = slice(max(now - _TRAIL - 1, 0), min(now + 1, seen))
        trail.set_data(*view.of(points[recent], offset[recent], shift))
        shape.set_visible(now < seen)
        if now < seen:
            centre = view.of(points[now : now + 1], offset[now : now + 1], shift)
            rotation = turn_by(states[now, 2] - view.yaw).T
            shape.set_xy((rotation @ _CAR + centre).T)
            name.set_y(np.clip(centre[1, 0], shift - _NAMED, shift + _NAMED))
        if now >= departure[0]:
            name.set(text=f"{style.literal(car.name)}\n{departure[1]}", y=shift)

    return move


def _draw_conditions(axes: Any, envs: np.ndarray, middle: float) -> _Part:
    """Friction and wind in words, as a shade and as an arrow."""
    words = axes.set_title("", fontsize=10.5, loc="left", pad=4)
    arrow: dict[str, Any] = {"arrowstyle": "-|>", "color": style.DARK, "lw": 2.5}
    wind = axes.annotate("", (0.0, 0.0), (0.0, 0.0), arrowprops=arrow, zorder=9)

    def move(step: int, _: _View) -> None:
        friction, speed = envs[min(step, len(envs) - 1)]
        axes.set_facecolor(style.shade(friction))
        words.set_text(style.env_text(friction, speed))
        wind.set_visible(bool(abs(speed) > 1e-3))
        wind.set_position((0.93 * _AHEAD, middle - 0.5 * speed))
        wind.xy = (0.93 * _AHEAD, middle + 0.5 * speed)

    return move


class _Writer(PillowWriter):
    """One palette for all frames, of the last one: half the bytes, and no flicker."""

    def finish(self) -> None:
        palette = self._frames[-1].quantize(colors=_COLOURS, kmeans=1)
        self._frames = [f.quantize(palette=palette, dither=0) for f in self._frames]
        super().finish()


def write_film(film: Film, path: Path, seconds: float = SECONDS) -> Path:
    """Write a GIF in real time, with fewer frames if it exceeds MAX_BYTES."""
    last = min([round(seconds / film.dt), *(len(car.lateral) for car in film.cars)])
    for stride in (1, 2, 5):
        _write(film, range(0, last, stride), path, rate=1 / (stride * film.dt))
        if path.stat().st_size <= MAX_BYTES:
            break
    return path


def _write(film: Film, steps: range, path: Path, rate: float) -> None:
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        low, high = extent(film)
        tall = _INCHES_PER_METRE * (high - low)
        height = tall + _OTHER_INCHES
        figure = Figure(figsize=(6.0, height))
        FigureCanvasAgg(figure)
        top = 1.0 - (tall + 0.29) / height
        above = figure.add_axes((0.125, top, 0.86, tall / height))
        below = figure.add_axes((0.125, 0.49 / height, 0.86, 1.16 / height))
        pairs = (draw_road, above), (draw_strip, below)
        moves = [draw(axes, film, steps.stop) for draw, axes in pairs]
        writer = _Writer(fps=max(1, round(rate)))
        with writer.saving(figure, str(path), dpi=90):
            for step in steps:
                for move in moves:
                    move(step)
                writer.grab_frame()
