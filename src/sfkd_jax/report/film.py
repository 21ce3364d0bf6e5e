"""Films: cars on copies of a road, with their deviations below."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from matplotlib.text import Text
from PIL import Image

from sfkd_jax.report import style
from sfkd_jax.report.episodes import Episodes
from sfkd_jax.report.frames import (
    EVERY,
    SECONDS,
    TRAIL,
    area_between,
    draw_frames,
    draw_once,
    draw_wind,
    rotation_into,
    seen_from,
    surface_colour,
)
from sfkd_jax.report.tables import NO_MODEL

_LOST = 0.85
"""Larger deviations do not set the scale of a film [m]."""
_HALF = 3.4
"""Half width of the road as drawn [m]."""
_SPACING = 7.6
"""Width of what a copy of the road shows [m]."""
_COPY = 0.123 * _SPACING
"""Height of a copy on the page [in]."""
_GAP = 0.1
"""Distance between two copies on the page [in]."""
_TIMES = {2: "twice", 3: "three times"}
"""How often the road is drawn, in words."""
_BEHIND = 14.0
"""How far the view reaches behind the first car [m]."""
_AHEAD = 28.0
"""How far the view reaches ahead of the first car [m]."""
_LARGEST_FACTOR = 10
"""Largest factor by which deviations are widened."""
_COLOURS = 48
"""Number of colours of the file."""
_CAR = np.array([[2.4, 1.8, -2.2, -2.2, 1.8], [0.0, 0.85, 0.85, -0.85, -0.85]])
"""Corners of the drawing of a car [m]. It shows where the car points, and is the same
for all of them: files of episodes do not say how large theirs is.
"""


def film_of(
    path: Path, group: list[Episodes], corridor: float | None = None
) -> Path | None:
    """Write a GIF of SFKD, nominal and one other learned system, in real time.

    Args:
        path: of the file.
        group: of episodes on one road.
        corridor: half width of the certified corridor [m], or None.

    Returns:
        The path, or None if no row of the group has states and a path.
    """
    whole = [
        episodes
        for episodes in group
        if episodes.states is not None and episodes.path is not None
    ]
    if not whole:
        return None
    ours = [episodes for episodes in whole if episodes.system == "sfkd"]
    nominal = [episodes for episodes in whole if episodes.system == "nominal"]
    rivals = [
        episodes
        for episodes in whole
        if not episodes.system.startswith((*NO_MODEL, "sfkd"))
    ]
    # ICODE-MPPI is the paper's strongest rival.
    rivals.sort(key=lambda episodes: episodes.system != "icode_mppi")
    cars = [*ours[:1], *nominal[:1], *rivals[:1]] or whole[:1]
    shortest = min(episodes.lateral.shape[1] for episodes in cars)
    last = min(round(SECONDS / cars[0].dt), shortest)
    return write(path, Film(cars, last, corridor))


@runtime_checkable
class Frames(Protocol):
    """What can be written as a film.

    Attributes:
        dt: sampling period [s]; a frame lasts `EVERY` of them.
    """

    dt: float

    def frames(self) -> Iterator[Image.Image]:
        """Yield the frames."""
        ...


def write(path: Path, film: Frames) -> Path:
    """Write the GIF of a film, in real time."""
    # Defaults: a user's style file would move axes that are placed by hand.
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        frames = [*film.frames()]
    # One palette for all: half the bytes, and no flicker. Some frames hold all colours.
    some = [np.asarray(frame)[::2, ::2] for frame in frames[:: 1 + len(frames) // 4]]
    palette = Image.fromarray(np.vstack(some)).quantize(colors=_COLOURS, kmeans=1)
    first, *rest = [
        frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames
    ]
    pause = round(1e3 * EVERY * film.dt)
    first.save(path, save_all=True, append_images=rest, duration=pause, loop=0)
    return path


class Film:
    """Episodes on one road, with states and a path; the first car is followed."""

    def __init__(
        self,
        cars: list[Episodes],
        last: int,
        corridor: float | None = None,
        factor: int | None = None,
    ) -> None:
        """Measure what is drawn.

        Args:
            cars: with states and a path.
            last: number of steps that are drawn.
            corridor: certified half width [m].
            factor: by which deviations are widened; by default as much as fits.
        """
        self.cars = cars
        self.last = last
        self.corridor = corridor
        self.dt = cars[0].dt
        # Signed, left positive [m].
        self.deviations = [car.lateral[0, :last] for car in cars]
        peaks = [float(np.max(np.abs(lateral))) for lateral in self.deviations]
        # A car that leaves its lane would make all others look motionless.
        shown = [corridor or 0.0, *(peak for peak in peaks if peak <= _LOST)]
        self.largest = max(shown) or _LOST
        # The same widening for all cars, so that they compare.
        fitting = int(np.clip(_HALF / self.largest, 1, _LARGEST_FACTOR))
        self.factor = factor or fitting
        self.path = np.asarray(cars[0].path)
        self.near = [_nearest(np.asarray(car.states)[:, :2], self.path) for car in cars]

    def frames(self) -> Iterator[Image.Image]:
        """Yield frames: a copy of the road for each car, and all deviations below."""
        count = len(self.cars)
        height = count * (_COPY + _GAP) + 2.14
        figure = style.canvas(height)
        # No layout engine: axes that shift between frames would make the film shake.
        figure.set_layout_engine("none")
        figure.set(figwidth=6.0, dpi=90)
        copies = []
        for number in range(count):
            bottom = height - 0.29 - _COPY - number * (_COPY + _GAP)
            place = (0.125, bottom / height, 0.86, _COPY / height)
            copies.append(figure.add_axes(place))
        errors = figure.add_axes((0.125, 0.49 / height, 0.86, 1.16 / height))
        # What no frame changes: scales, corridor, dashes at switches.
        edge = 0.5 * _SPACING
        for axes in copies:
            axes.set(xlim=(-_BEHIND, _AHEAD), ylim=(-edge, edge), aspect="equal")
            axes.set_axis_off()
        title = f"deviations × {self.factor}" if self.factor > 1 else "to scale"
        if count > 1:
            times = _TIMES.get(count, f"{count} times")
            title = f"one road, drawn {times}, {title}"
        copies[0].set_title(title, fontsize=9.5, loc="right", pad=4)
        dt = self.dt
        high = 1.5 * self.largest
        if self.corridor:
            style.draw_corridor(errors, self.corridor)
        for switch in self.cars[0].switches:
            errors.axvline(switch * dt, **style.SWITCH)
        errors.axhline(0.0, color=style.AXIS, linewidth=0.8)
        errors.set(xlim=(0.0, self.last * dt), ylim=(-high, high))
        errors.set_xlabel("time [s]", labelpad=1)
        errors.set_ylabel("deviation [m]")
        scenario = style.scenario_label(str(self.cars[0].row.get("scenario")))
        errors.set_title(style.literal(scenario), fontsize=9.5, loc="left", pad=4)
        errors.spines[["top", "right"]].set_visible(False)

        def draw(step: int) -> None:
            self._draw_roads(copies, step)
            self._draw_errors(errors, step)

        return draw_frames(figure, range(0, self.last, EVERY), draw)

    def _draw_errors(self, axes: Any, step: int) -> None:
        """Draw the deviations up to a step."""
        time = self.dt * np.arange(1, step + 2)
        for car, values in zip(self.cars, self.deviations, strict=True):
            color = style.line(car.system)["color"]
            draw_once(
                axes, Line2D(time, values[: step + 1], color=color, linewidth=1.8)
            )
        now = Line2D([time[-1]] * 2, axes.get_ylim(), color=style.SOFT, linewidth=0.8)
        draw_once(axes, now)

    def _draw_roads(self, copies: list[Any], step: int) -> None:
        """Draw every car on its copy of the road, seen from the first car."""
        envs = self.cars[0].envs
        friction = 0.9
        wind = 0.0
        if envs is not None:
            friction, wind = envs[min(step, len(envs) - 1)]
        for number, axes in enumerate(copies):
            whole = {"transform": axes.transAxes}
            draw_once(
                axes, Rectangle((0, 0), 1, 1, fc=surface_colour(friction), **whole)
            )
            self._draw_car(axes, step + 1, number)
            draw_once(axes, Rectangle((0, 0), 1, 1, fill=False, clip_on=False, **whole))
            draw_wind(axes, wind, 0.93 * _AHEAD)
        if envs is not None:
            whole = {"transform": copies[0].transAxes, "clip_on": False}
            words = f"friction {friction:.2g}, wind {round(wind):+d} m/s"
            draw_once(copies[0], Text(0, 1.04, words, fontsize=9.5, **whole))

    def _draw_car(self, axes: Any, now: int, number: int) -> None:
        """Draw one car on its copy of the road, its trail and its name.

        Args:
            axes: of the copy.
            now: index of the state that is drawn.
            number: of the car.
        """
        car = self.cars[number]
        lateral = self.deviations[number]
        nearest = self.near[number]
        first = int(self.near[0][now])
        color = style.line(car.system)["color"]
        seen = partial(seen_from, self.path[first])
        around = self.path[max(first - 120, 0) : first + 160]
        for side, dashes in ((-_HALF, "-"), (0.0, (0, (6, 5))), (_HALF, "-")):
            look: dict[str, Any] = {"color": style.MARKING, "lw": 1.2, "ls": dashes}
            draw_once(axes, Line2D(*seen(around, side), **look))
        if self.corridor:
            half = self.factor * self.corridor
            edges = [seen(around, half), seen(around, -half)]
            draw_once(axes, area_between(*edges, **style.BAND))
            for edge in edges:
                draw_once(axes, Line2D(*edge, **style.EDGE))
        # A car off its lane stays at the edge of its copy.
        offset = self.factor * np.nan_to_num(np.append(0.0, lateral[:now]))
        offset = np.clip(offset, -0.5 * _SPACING, 0.5 * _SPACING)
        recent = slice(max(now - TRAIL, 0), now + 1)
        trail = seen(self.path[nearest[recent]], offset[recent])
        draw_once(axes, Line2D(*trail, color=color, linewidth=1.8))
        yaw = np.asarray(car.states)[now, 2]
        body = rotation_into(self.path[first, 2] - yaw) @ _CAR + trail[:, -1:]
        draw_once(axes, Polygon(body.T, fc=color, ec=style.DARK))
        look = {"color": color, "fontweight": "bold", "fontsize": 9.5, "va": "center"}
        look["bbox"] = {"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.5}
        draw_once(axes, Text(4.5, -2.3, style.literal(car.name), **look))


def _nearest(
    positions: Float[np.ndarray, "time 2"], path: Float[np.ndarray, "point column"]
) -> np.ndarray:
    """Return the index of the path point that is closest to each position.

    For a position that is not finite it is 0.
    """
    gaps = positions[:, None] - path[None, :, :2]
    return np.argmin(np.nan_to_num(np.sum(gaps**2, axis=-1)), axis=1)
