"""The upper part of a film: a copy of the road for every car, seen from above in the frame of the first one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.patches import Polygon

from sfkd_jax.reporting._benchmark_figures import conditions, shade
from sfkd_jax.reporting._film import (
    BAND,
    BAND_EDGE,
    HALF_LANE,
    LANE,
    Car,
    Film,
    Move,
    until,
    widening,
)
from sfkd_jax.reporting._style import PLATE, literal
from sfkd_jax.reporting._track import _projected, _widened

_AHEAD, _BEHIND = 28.0, 14.0  # of the picture around the first car [m]
_SPACING = 7.6  # between two copies of the road [m]
_ROOM = 2.6  # below the last copy, where its car leaves it [m]
_NAMED = 2.8  # how far from the middle of a copy a name goes with its car [m]
_TRAIL = 20  # steps
_CAR = np.array(
    [[2.4, 0.0], [1.8, 0.85], [-2.2, 0.85], [-2.2, -0.85], [1.8, -0.85]]
).T  # nose to tail [m]
_EDGE: dict[str, Any] = {"color": "#aab1ba", "linewidth": 1.3, "zorder": 2}
_MIDDLE = _EDGE | {"linewidth": 0.9, "linestyle": (0, (6, 5))}


class _View(NamedTuple):
    """Where the first car is: the nearest point of the path, its yaw, and the turn into its frame."""

    point: int
    origin: np.ndarray
    yaw: float
    turn: np.ndarray

    def of(self, points: np.ndarray, offset: np.ndarray, shift: float) -> np.ndarray:
        """Positions left of path points on a copy of the road, (2, point)."""
        return self.turn @ (_widened(points, offset, 1) - self.origin) + np.array(
            [[0.0], [shift]]
        )


_Part: TypeAlias = Callable[[int, _View], None]


def extent(film: Film) -> tuple[float, float]:
    """Lower and upper end of the picture above the middle of the last copy [m]."""
    leaves = until(film.cars[-1].lateral, LANE) < len(film.cars[-1].lateral)
    return -0.5 * _SPACING - _ROOM * leaves, (len(film.cars) - 0.5) * _SPACING


def road(axes: Any, film: Film, last: int) -> Move:
    """Draw every car on its copy, and the weather."""
    factor, path = widening(film, last), np.asarray(film.points)
    shifts = _SPACING * np.arange(len(film.cars) - 1, -1, -1.0)
    places = [_projected(np.asarray(car.states)[:, :2], path) for car in film.cars]
    parts: list[_Part] = [
        _lanes(axes, path, factor * (film.corridor or 0.0), shift) for shift in shifts
    ]
    for car, (near, offset), shift in zip(film.cars, places, shifts, strict=True):
        left = until(offset, LANE)
        parting = left, f"left its lane ({LANE} m) at {left * film.dt:.1f} s"
        parts.append(_car(axes, car, (path[near], factor * offset), shift, parting))
    axes.set(xlim=(-_BEHIND, _AHEAD), ylim=extent(film), xticks=[], yticks=[])
    axes.set_aspect("equal")
    axes.set_title(
        f"{literal(film.title)}, deviations × {factor}",
        fontsize=9.5,
        loc="right",
        pad=4,
    )
    parts += (
        [_weather(axes, film.envs, 0.5 * shifts[0])] if film.envs is not None else []
    )

    def move(step: int) -> None:
        centre = int(places[0][0][step + 1])
        x, y, yaw = path[centre, :3]
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        for part in parts:
            part(step, _View(centre, np.array([[x], [y]]), yaw, turn))

    return move


def _lanes(axes: Any, path: np.ndarray, half: float, shift: float) -> _Part:
    """Middle and edges of a copy, and the corridor around its middle."""
    lines = {side: axes.plot([], [], **_EDGE)[0] for side in (-HALF_LANE, HALF_LANE)}
    lines[0.0] = axes.plot([], [], **_MIDDLE)[0]
    band = axes.add_patch(Polygon(np.zeros((1, 2)), **BAND))
    if half:
        lines |= {side: axes.plot([], [], **BAND_EDGE)[0] for side in (-half, half)}

    def move(_: int, view: _View) -> None:
        points = path[max(view.point - 120, 0) : view.point + 160]
        drawn = {
            side: view.of(points, np.full(len(points), side), shift) for side in lines
        }
        for side, line in lines.items():
            line.set_data(*drawn[side])
        if half:
            band.set_xy(np.hstack([drawn[half], drawn[-half][:, ::-1]]).T)

    return move


def _car(
    axes: Any,
    car: Car,
    drawn: tuple[np.ndarray, np.ndarray],
    shift: float,
    parting: tuple[int, str],
) -> _Part:
    """A car, its trail and its name, until it is as far away as the next copy.

    Args:
        drawn: path points beside it, and how far left of them it is drawn [m].
        shift: of its copy [m].
        parting: from which step on it has left its lane, and the words that say so.
    """
    (points, offset), states = drawn, np.asarray(car.states)
    shape = axes.add_patch(
        Polygon(
            _CAR.T, facecolor=car.colour, edgecolor="#30363d", linewidth=0.8, zorder=6
        )
    )
    trail = axes.plot([], [], color=car.colour, linewidth=1.8, zorder=4)[0]
    words: dict[str, Any] = {
        "color": car.colour,
        "fontsize": 10,
        "fontweight": "bold",
        "va": "center",
        "zorder": 8,
    }
    name = axes.text(
        3.2, shift, literal(car.name), bbox=PLATE | {"alpha": 0.75}, **words
    )
    seen = until(offset, _SPACING)

    def move(step: int, view: _View) -> None:
        now = step + 1
        here = slice(max(now - _TRAIL - 1, 0), min(now + 1, seen))
        trail.set_data(*view.of(points[here], offset[here], shift))
        shape.set_visible(now < seen)
        if now < seen:
            place = view.of(points[now : now + 1], offset[now : now + 1], shift)
            yaw = states[now, 2] - view.yaw
            rotation = np.array(
                [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
            )
            shape.set_xy((rotation @ _CAR + place).T)
            name.set_y(np.clip(place[1, 0], shift - _NAMED, shift + _NAMED))
        if now >= parting[0]:
            name.set(text=f"{literal(car.name)}\n{parting[1]}", y=shift)

    return move


def _weather(axes: Any, envs: np.ndarray, middle: float) -> _Part:
    """Friction and wind in words, as shade and as an arrow."""
    words = axes.set_title("", fontsize=10.5, loc="left", pad=4)
    arrow: dict[str, Any] = {"arrowstyle": "-|>", "color": "#30363d", "lw": 2.5}
    wind = axes.annotate("", (0.0, 0.0), (0.0, 0.0), arrowprops=arrow, zorder=9)

    def move(step: int, _: _View) -> None:
        friction, speed = envs[min(step, len(envs) - 1)]
        axes.set_facecolor(shade(friction))
        words.set_text(conditions(friction, speed))
        wind.set_visible(bool(abs(speed) > 1e-3))
        wind.set_position((0.93 * _AHEAD, middle - 0.5 * speed))
        wind.xy = (0.93 * _AHEAD, middle + 0.5 * speed)

    return move
