"""The one writer of films: cars on copies of a road above, their deviation below."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.patches import Polygon
from PIL import Image

from sfkd_jax.evaluation.metrics import LANE_HALF_WIDTH, VEHICLE_HALF_WIDTH
from sfkd_jax.report import style
from sfkd_jax.report.episodes import Episodes
from sfkd_jax.report.rows import NO_MODEL

MAX_BYTES = 2_000_000
SECONDS = 13.5
LANE = LANE_HALF_WIDTH - VEHICLE_HALF_WIDTH
"""Deviation at which a car leaves its lane [m]."""
_HALF, _SPACING = 3.4, 7.6
"""Half width of a copy of the road as drawn, and distance of two copies [m]."""
_BEHIND, _AHEAD = 14.0, 28.0
"""Of the view around the first car [m]."""
_MOST, _TRAIL, _COLOURS = 10, 20, 48
"""Largest widening of deviations, steps of a trail, colours of the file."""
_CAR = np.array([[2.4, 1.8, -2.2, -2.2, 1.8], [0.0, 0.85, 0.85, -0.85, -0.85]])
"""Corners of a car in its frame [m]."""


class Car(NamedTuple):
    """A car in a film.

    Attributes:
        name: beside the car.
        colour: of the car.
        lateral: signed deviation of x_1 … x_T [m], left positive.
        states: x_0 … x_T, beginning with x, y, yaw.
    """

    name: str
    colour: str
    lateral: Float[np.ndarray, " time"]
    states: Float[np.ndarray, "time_plus_1 state"]

    @property
    def left(self) -> int:
        """First step at which it is outside of its lane, or not finite."""
        inside = np.abs(self.lateral) <= LANE
        # A comparison with NaN is False: a car that is not finite is outside as well.
        return int(np.argmin(np.append(inside, False)))


class Film(NamedTuple):
    """Episodes on one road.

    Attributes:
        title: above the road.
        dt: sampling period [s].
        points: x, y, yaw, curvature along the road.
        envs: friction and wind [m/s] at every step.
        cars: the camera follows the first one.
        corridor: certified half width [m].
    """

    title: str
    dt: float
    points: Float[np.ndarray, "point column"]
    envs: Float[np.ndarray, "time 2"] | None
    cars: list[Car]
    corridor: float | None = None

    @property
    def reach(self) -> float:
        """Largest deviation of the corridor and of the cars in their lanes [m]."""
        peaks = [float(np.max(np.abs(car.lateral))) for car in self.cars]
        # A car that leaves its lane would make all others look motionless.
        return (
            max([self.corridor or 0.0, *(one for one in peaks if one <= LANE)]) or LANE
        )


def film_of(
    path: Path, group: list[Episodes], corridor: float | None = None
) -> Path | None:
    """Write a GIF of SFKD, nominal and one other learned system.

    Returns:
        The file; None if no row has states and a path.
    """
    whole = [one for one in group if one.states is not None and one.path is not None]
    # ICODE-MPPI is the paper's strongest rival.
    rivals = sorted(whole, key=lambda one: one.system != "icode_mppi")
    kinds = [
        [one for one in whole if one.system == "sfkd"],
        [one for one in whole if one.system == "nominal"],
        [one for one in rivals if one.system not in (*NO_MODEL, "sfkd")],
    ]
    chosen = [kind[0] for kind in kinds if kind] or whole[:1]
    if not chosen:
        return None
    first = chosen[0]
    title = style.scenario_label(str(first.row.get("scenario")))
    cars = [
        Car(one.name, style.line(one.system)["color"], one.lateral[0], states)
        for one in chosen
        if (states := one.states) is not None
    ]
    points = np.asarray(first.path)
    return write_film(Film(title, first.dt, points, first.envs, cars, corridor), path)


def write_film(
    film: Film, path: Path, seconds: float = SECONDS, every: int = 2
) -> Path:
    """Write a GIF in real time, with fewer frames if it exceeds MAX_BYTES.

    Args:
        film: to write.
        path: of the file.
        seconds: of the episode that are shown.
        every: how many steps a frame lasts.
    """
    last = min([round(seconds / film.dt), *(len(car.lateral) for car in film.cars)])
    cars = [car._replace(lateral=car.lateral[:last]) for car in film.cars]
    # Fewer frames, not fewer colours: cars are told apart by colour.
    for stride in (every, 2 * every, 5 * every):
        _write(film._replace(cars=cars), range(0, last, stride), path)
        if path.stat().st_size <= MAX_BYTES:
            break
    return path


def _write(film: Film, steps: range, path: Path) -> None:
    # Defaults: a user's style file would move axes that are placed by hand.
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        tall = 0.123 * _SPACING * len(film.cars)
        height = tall + 2.1
        figure = style.canvas(height)
        # No layout engine: axes that shift between frames would make the film shake.
        figure.set_layout_engine("none")
        figure.set(figwidth=6.0, dpi=90)
        above = figure.add_axes(
            (0.125, 1 - (tall + 0.29) / height, 0.86, tall / height)
        )
        below = figure.add_axes((0.125, 0.49 / height, 0.86, 1.16 / height))
        nearest = [_nearest(car.states[:, :2], film.points) for car in film.cars]
        frames = []
        for step in steps:
            above.clear()
            below.clear()
            _draw_road(above, film, nearest, step)
            _draw_strip(below, film, step, steps.stop)
            frames.append(_image(figure))
    # One palette for all frames: half the bytes, and no flicker.
    palette = frames[-1].quantize(colors=_COLOURS, kmeans=1)
    first, *rest = [one.quantize(palette=palette, dither=0) for one in frames]
    pause = round(1e3 * steps.step * film.dt)
    first.save(path, save_all=True, append_images=rest, duration=pause, loop=0)


def _image(figure: Any) -> Image.Image:
    """The pixels of a figure."""
    figure.canvas.draw()
    return Image.fromarray(np.array(figure.canvas.buffer_rgba())[..., :3])


def _draw_road(axes: Any, film: Film, nearest: list[np.ndarray], step: int) -> None:
    """Every car on its copy of the road, seen from the first car after a step."""
    now, path, centre = step + 1, film.points, int(nearest[0][step + 1])
    # The same factor for all cars, or their deviations could not be compared.
    factor = int(np.clip(_HALF / film.reach, 1, _MOST))
    turn = style.turn_by(path[centre, 2])
    visible = path[max(centre - 120, 0) : centre + 160]
    bottom = -_SPACING * (len(film.cars) - 0.5)
    for number, (car, near) in enumerate(zip(film.cars, nearest, strict=True)):
        shift = np.array([[0.0], [-_SPACING * number]])

        def seen(points: Any, offset: Any, shift: Any = shift) -> np.ndarray:
            """Positions to the left of path points on this copy, (2, point)."""
            left = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])])
            origin = path[centre, :2, None]
            return turn @ (points[:, :2].T + offset * left - origin) + shift

        for side, dashes in ((-_HALF, "-"), (0.0, (0, (6, 5))), (_HALF, "-")):
            axes.plot(
                *seen(visible, side), color="#aab1ba", lw=1.2, ls=dashes, zorder=2
            )
        if film.corridor:
            half = factor * film.corridor
            upper, lower = seen(visible, half), seen(visible, -half)
            axes.add_patch(Polygon(np.hstack([upper, lower[:, ::-1]]).T, **style.BAND))
            for edge in (upper, lower):
                axes.plot(*edge, **style.EDGE)
        # A car off its lane stays at the edge of its copy: beyond is another one's.
        offset = np.append(0.0, car.lateral[:now])
        offset = np.clip(
            factor * np.nan_to_num(offset), -0.5 * _SPACING, 0.5 * _SPACING
        )
        recent = slice(max(now - _TRAIL, 0), now + 1)
        points = seen(path[near[recent]], offset[recent])
        axes.plot(*points, color=car.colour, linewidth=1.8, zorder=4)
        body = style.turn_by(path[centre, 2] - car.states[now, 2]) @ _CAR
        look: dict[str, Any] = {"fc": car.colour, "ec": style.DARK, "zorder": 6}
        axes.add_patch(Polygon((body + points[:, -1:]).T, **look))
        words = f"{car.name}, left its lane at {(car.left + 1) * film.dt:.1f} s"
        words = style.literal(words if now > car.left else car.name)
        look = {"color": car.colour, "fontweight": "bold", "zorder": 8, "va": "center"}
        look["bbox"] = {"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.5}
        axes.text(4.5, shift[1, 0] - 2.3, words, fontsize=9.5, **look)
    axes.set(xlim=(-_BEHIND, _AHEAD), ylim=(bottom, 0.5 * _SPACING), aspect="equal")
    axes.set(xticks=[], yticks=[])
    title = f"{style.literal(film.title)}, deviations × {factor}"
    axes.set_title(title, fontsize=9.5, loc="right", pad=4)
    if film.envs is not None:
        friction, wind = film.envs[min(step, len(film.envs) - 1)]
        axes.set_facecolor(style.shade(friction))
        words = f"friction {friction:.2g}, wind {wind:+.0f} m/s"
        axes.set_title(words, fontsize=9.5, loc="left", pad=4)
        middle = 0.5 * (bottom + 0.5 * _SPACING)
        tip, tail = ((0.93 * _AHEAD, middle + half * wind) for half in (0.5, -0.5))
        arrow = {
            "arrowstyle": "-|>",
            "color": style.DARK,
            "lw": 2.5 * (abs(wind) > 0.1),
        }
        axes.annotate("", tip, tail, arrowprops=arrow, zorder=9)


def _draw_strip(axes: Any, film: Film, step: int, last: int) -> None:
    """Deviation up to a step over time, with dashes where friction or wind switch."""
    if film.corridor:
        style.draw_corridor(axes, film.corridor)
    for switch in style.switches(film.envs):
        axes.axvline(switch * film.dt, **style.SWITCH)
    axes.axhline(0.0, color=style.AXIS, linewidth=0.8)
    for car in film.cars:
        values = car.lateral[: step + 1]
        time = film.dt * np.arange(1, len(values) + 1)
        axes.plot(time, values, color=car.colour, linewidth=1.8)
    axes.axvline((step + 1) * film.dt, color=style.SOFT, linewidth=0.8)
    axes.set(xlim=(0.0, last * film.dt), ylim=(-1.5 * film.reach, 1.5 * film.reach))
    axes.set_xlabel("time [s]", labelpad=1)
    axes.set_ylabel("deviation [m]")
    axes.spines[["top", "right"]].set_visible(False)


def _nearest(
    positions: Float[np.ndarray, "time 2"], path: Float[np.ndarray, "point column"]
) -> np.ndarray:
    """The closest path point of each position; the search only goes forward.

    So it follows a path that crosses itself.
    """
    near = np.zeros(len(positions), dtype=int)
    for step, position in enumerate(positions):
        # A few steps back as well, since the closest point may jitter.
        start = max(int(near[step - 1]) - 5, 0) if step else 0
        gap = np.sum((path[start : start + 60, :2] - position) ** 2, axis=1)
        # A car whose state is not finite stays where it was.
        finite = np.all(np.isfinite(position))
        near[step] = start + int(np.argmin(gap)) if finite else near[step - 1]
    return near
