"""Films: cars on copies of a road with their deviation below, and a car in a lane."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Polygon, Rectangle
from matplotlib.text import Text
from PIL import Image

from sfkd_jax.evaluation import Episode
from sfkd_jax.report import style
from sfkd_jax.report.episodes import Episodes
from sfkd_jax.report.tables import NO_MODEL

SECONDS, EVERY = 13.5, 2
"""Of the episode that are shown; steps that a frame lasts."""
_LOST = 0.85
"""Larger deviations do not set the scale of a film [m]."""
_HALF = 3.4
"""Half width of the road as drawn [m]."""
_SPACING = 7.6
"""Width of what a copy of the road shows [m]."""
_COPY = 0.123 * _SPACING
"""Height of a copy on the page [in]."""
_GAP = 0.1
"""Between two copies [in]."""
_TIMES = {2: "twice", 3: "three times"}
"""How often the road is drawn, in words."""
_BEHIND, _AHEAD = 14.0, 28.0
"""Of the view around the first car [m]."""
_MOST, _TRAIL, _COLOURS = 10, 20, 48
"""Largest widening of deviations, steps of a trail, colours of the file."""
_CAR = np.array([[2.4, 1.8, -2.2, -2.2, 1.8], [0.0, 0.85, 0.85, -0.85, -0.85]])
"""Corners of the drawing of a car [m]. It shows where the car points, and is the same
for all of them: files of episodes do not say how large theirs is.
"""
_SIGHT, _SIDE = (-8.0, 34.0), 6.6
"""Of a lane that is seen: behind and ahead of the car, to either side [m]."""
_OBSTACLE: dict[str, Any] = dict(fc=style.SOFT, ec=style.DARK, lw=0.8)
_INFLATED: dict[str, Any] = dict(fc=style.SECOND, alpha=0.3, lw=0)
_CORRIDOR: dict[str, Any] = dict(fc=style.ACCENT, alpha=0.45, lw=0)
_REFERENCE: dict[str, Any] = dict(color=style.ACCENT, lw=0.9)
_BODY: Any = (
    (
        [[1, 0.8], [1, -0.8], [0.9, -1], [-1, -1], [-1, 1], [0.9, 1]],
        dict(fc="#5b9bd5", ec=style.DARK, lw=1.0),
    ),
    ([[0.45, 0.7], [0.45, -0.7], [0.15, -0.6], [0.15, 0.6]], dict(fc=style.DARK)),
    ([[-0.75, 0.6], [-0.75, -0.6], [-0.6, -0.55], [-0.6, 0.55]], dict(fc=style.DARK)),
)
"""Of the car: outline, front and rear window, in shares of half its size."""


def film_of(
    path: Path, group: list[Episodes], corridor: float | None = None
) -> Path | None:
    """Write a GIF of SFKD, nominal and one other learned system, in real time.

    Returns the file; None if no row of the group has states and a path.
    """
    whole = [one for one in group if one.states is not None and one.path is not None]
    # ICODE-MPPI is the paper's strongest rival.
    rivals = sorted(whole, key=lambda one: one.system != "icode_mppi")
    kinds = [
        [one for one in whole if one.system == "sfkd"],
        [one for one in whole if one.system == "nominal"],
        [one for one in rivals if not one.system.startswith((*NO_MODEL, "sfkd"))],
    ]
    chosen = [kind[0] for kind in kinds if kind] or whole[:1]
    if not chosen:
        return None
    dt, length = chosen[0].dt, min(one.lateral.shape[1] for one in chosen)
    return write(path, Film(chosen, min(round(SECONDS / dt), length), corridor))


def write(path: Path, film: Film | LaneFilm) -> Path:
    """Write the GIF of a film, in real time."""
    # Defaults: a user's style file would move axes that are placed by hand.
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        frames = [*film.frames()]
    # One palette for all: half the bytes, and no flicker. Some frames hold all colours.
    some = [np.asarray(one)[::2, ::2] for one in frames[:: 1 + len(frames) // 4]]
    palette = Image.fromarray(np.vstack(some)).quantize(colors=_COLOURS, kmeans=1)
    first, *rest = [
        one.quantize(palette=palette, dither=Image.Dither.NONE) for one in frames
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
        self.cars, self.last, self.corridor = cars, last, corridor
        self.dt = cars[0].dt
        # Signed, left positive [m].
        self.deviations = [car.lateral[0, :last] for car in cars]
        peaks = [float(np.max(np.abs(one))) for one in self.deviations]
        # A car that leaves its lane would make all others look motionless.
        shown = [corridor or 0.0, *(one for one in peaks if one <= _LOST)]
        self.largest = max(shown) or _LOST
        # The same widening for all cars, so that they compare.
        self.factor = factor or int(np.clip(_HALF / self.largest, 1, _MOST))
        self.path = np.asarray(cars[0].path)
        self.near = [_nearest(np.asarray(one.states)[:, :2], self.path) for one in cars]

    def frames(self) -> Iterator[Image.Image]:
        """The frames: a copy of the road for each car, and all deviations below."""
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
        words = f"deviations × {self.factor}" if self.factor > 1 else "to scale"
        if count > 1:
            words = f"one road, drawn {_TIMES.get(count, f'{count} times')}, {words}"
        copies[0].set_title(words, fontsize=9.5, loc="right", pad=4)
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

        return _each(figure, range(0, self.last, EVERY), draw)

    def _draw_errors(self, axes: Any, step: int) -> None:
        """Deviations up to a step."""
        time = self.dt * np.arange(1, step + 2)
        for car, values in zip(self.cars, self.deviations, strict=True):
            color = style.line(car.system)["color"]
            _put(axes, Line2D(time, values[: step + 1], color=color, linewidth=1.8))
        now = Line2D([time[-1]] * 2, axes.get_ylim(), color=style.SOFT, linewidth=0.8)
        _put(axes, now)

    def _draw_roads(self, copies: list[Any], step: int) -> None:
        """Every car on its copy of the road, seen from the first car after a step."""
        envs = self.cars[0].envs
        friction, wind = (0.9, 0.0) if envs is None else envs[min(step, len(envs) - 1)]
        for number, axes in enumerate(copies):
            whole = {"transform": axes.transAxes}
            _put(axes, Rectangle((0, 0), 1, 1, fc=_surface(friction), **whole))
            self._draw_car(axes, step + 1, number)
            _put(axes, Rectangle((0, 0), 1, 1, fill=False, clip_on=False, **whole))
            _draw_wind(axes, wind, 0.93 * _AHEAD)
        if envs is not None:
            whole = {"transform": copies[0].transAxes, "clip_on": False}
            words = f"friction {friction:.2g}, wind {round(wind):+d} m/s"
            _put(copies[0], Text(0, 1.04, words, fontsize=9.5, **whole))

    def _draw_car(self, axes: Any, now: int, number: int) -> None:
        """One car on its copy of the road, its trail and its name."""
        car = self.cars[number]
        lateral = self.deviations[number]
        nearest = self.near[number]
        first = int(self.near[0][now])
        color = style.line(car.system)["color"]
        seen = partial(_seen, self.path[first])

        around = self.path[max(first - 120, 0) : first + 160]
        for side, dashes in ((-_HALF, "-"), (0.0, (0, (6, 5))), (_HALF, "-")):
            look: dict[str, Any] = {"color": "#aab1ba", "lw": 1.2, "ls": dashes}
            _put(axes, Line2D(*seen(around, side), **look))
        if self.corridor:
            half = self.factor * self.corridor
            edges = [seen(around, half), seen(around, -half)]
            _put(axes, _between(*edges, **style.BAND))
            for edge in edges:
                _put(axes, Line2D(*edge, **style.EDGE))
        # A car off its lane stays at the edge of its copy.
        offset = self.factor * np.nan_to_num(np.append(0.0, lateral[:now]))
        offset = np.clip(offset, -0.5 * _SPACING, 0.5 * _SPACING)
        recent = slice(max(now - _TRAIL, 0), now + 1)
        trail = seen(self.path[nearest[recent]], offset[recent])
        _put(axes, Line2D(*trail, color=color, linewidth=1.8))
        yaw = np.asarray(car.states)[now, 2]
        body = _turn_by(self.path[first, 2] - yaw) @ _CAR + trail[:, -1:]
        _put(axes, Polygon(body.T, fc=color, ec=style.DARK))
        look = {"color": color, "fontweight": "bold", "fontsize": 9.5, "va": "center"}
        look["bbox"] = {"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.5}
        _put(axes, Text(4.5, -2.3, style.literal(car.name), **look))


class LaneFilm:
    """A car in its lane, and the reference that it has committed to.

    Seen along the road at the car. `corridor` and `reference` have been recorded.
    """

    def __init__(
        self, scenario: Any, episode: Episode, *, dt: float, car: tuple[float, float]
    ) -> None:
        """Take an episode on a course; `car` is half of length and width [m]."""
        self.dt, self.envs = dt, np.asarray(scenario.envs)
        lane, obstacles = scenario.course[:2]
        self.path, self.spacing = np.asarray(lane.path.points), float(lane.path.spacing)
        # To the left of the middle [m].
        self.edges = np.asarray(lane.left), -np.asarray(lane.right)
        self.obstacles = [*zip(*map(np.asarray, obstacles), strict=True)]
        self.states, self.car = np.asarray(episode.states), np.asarray(car)
        self.along, self.signals = np.append(0.0, episode.progress), episode.signals
        self.corridor = np.nan_to_num(episode.signals["corridor"])
        # From where the road fills the view: it begins where the car starts.
        self.first = int(np.argmax(self.along >= -_SIGHT[0]))
        self.last = min(round(SECONDS / dt), len(self.corridor))

    def frames(self) -> Iterator[Image.Image]:
        """The frames."""
        figure = style.canvas(3.5)
        # No layout engine: axes that shift between frames would make the film shake.
        figure.set_layout_engine("none")
        figure.set(figwidth=8.0, dpi=100)
        axes = figure.add_axes((0.07, 0.225, 0.92, 0.68))
        axes.set(xlim=_SIGHT, ylim=(-_SIDE, _SIDE), aspect="equal")
        axes.set_facecolor("#e6e9e2")
        axes.set_xlabel("ahead of the car [m]", labelpad=1)
        axes.set_ylabel("left of the middle [m]")
        corridor = f"certified corridor, ± {self.corridor.min():.2f} m"
        handles = [
            Line2D([], [], **_REFERENCE, label="committed reference"),
            Polygon([[0, 0]], **_CORRIDOR, label=corridor),
            Polygon([[0, 0]], **_OBSTACLE, label="obstacle"),
            Polygon([[0, 0]], **_INFLATED, label="plus half the car and corridor"),
        ]
        about: dict[str, Any] = {"loc": "lower center", "ncols": 4, "frameon": False}
        figure.legend(handles=handles, fontsize=9, **about, columnspacing=1.4)
        steps = range(self.first, self.last, EVERY)
        return _each(figure, steps, partial(self._draw, axes))

    def _draw(self, axes: Any, step: int) -> None:
        """Road, obstacles, corridor and car at a step."""
        first, share = divmod(self.along[step] / self.spacing, 1.0)
        first, state = int(first), self.states[step]
        centre = (1.0 - share) * self.path[first] + share * self.path[first + 1]
        seen = partial(_seen, centre)
        around = slice(max(first - 40, 0), first + 120)
        road = self.path[around]
        edges = [seen(road, edge[around]) for edge in self.edges]
        friction, wind = self.envs[step]
        _put(axes, _between(*edges, fc=_surface(friction), ec="none"))
        for edge in edges:
            _put(axes, Line2D(*edge, color=style.DARK, lw=1.4))
        _put(axes, Line2D(*seen(road), color="#aab1ba", lw=1.0, ls=(0, (6, 5))))
        wide, every = self.corridor[step], np.asarray(self.signals["reference"])
        # What it has followed, and what it follows next.
        past = every[max(step - _TRAIL, 0) : step, 0]
        ahead = np.concatenate([past, every[step]])
        for place, yaw, half, radius, present in self.obstacles:
            grown = radius + self.car[1] + wide
            for size, look in ((grown, _INFLATED), (radius, _OBSTACLE)):
                outline = _turn_by(-yaw) @ _rounded(half, size) + place[0][:, None]
                if present:
                    flat = seen(np.vstack([outline, outline[:1]]).T)
                    _put(axes, Polygon(flat.T, **look))
        _put(axes, _between(seen(ahead, wide), seen(ahead, -wide), **_CORRIDOR))
        _put(axes, Line2D(*seen(ahead), **_REFERENCE))
        turn = _turn_by(centre[2] - state[2])
        for corners, look in _BODY:
            body = turn @ (np.array(corners).T * self.car[:, None]) + seen(state[None])
            _put(axes, Polygon(body.T, **look))
        _draw_wind(axes, wind, 0.93 * _SIGHT[1])
        whole: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False}
        words = f"friction {friction:.1f}   wind {round(wind)} m/s"
        free = max(float(self.signals["clearance"][step]), 0.0)
        words = f"{step * self.dt:4.1f} s   {state[3]:4.1f} m/s   {words}"
        words = f"{words}   keeps {free:.2f} m clear"
        _put(axes, Text(0, 1.04, words, fontsize=11, **whole))
        # In half a second.
        if every[step, round(0.5 / self.dt) - 1, 3] < state[3] - 0.3:
            look = {"ha": "right", "fontweight": "bold", "color": "#d55e00"}
            _put(axes, Text(0.96, 1.04, "brakes", fontsize=11, **look, **whole))


def _each(
    figure: Any, steps: range, draw: Callable[[int], None]
) -> Iterator[Image.Image]:
    """Frames, each drawn over what is the same in all of them."""
    canvas = figure.canvas
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for step in steps:
        canvas.restore_region(background)
        draw(step)
        yield Image.fromarray(np.array(canvas.buffer_rgba())[..., :3])


def _seen(centre: Any, points: Any, offset: Any = 0.0) -> np.ndarray:
    """Places to the left of points with a yaw, in the frame of a centre, (2, point)."""
    left = np.stack([-np.sin(points[:, 2]), np.cos(points[:, 2])])
    there = points[:, :2].T + offset * left
    return _turn_by(centre[2]) @ (there - centre[:2, None])


def _between(one: Any, other: Any, **look: Any) -> Polygon:
    """The area between two lines, (2, point)."""
    return Polygon(np.hstack([one, other[:, ::-1]]).T, **look)


def _rounded(half: Any, radius: Any) -> Float[np.ndarray, "2 point"]:
    """The outline of a box with round corners around the origin."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)])
    return radius * around + np.sign(around) * half[:, None]


def _surface(friction: Any) -> tuple[float, ...]:
    """White for a dry road, blue grey for a slippery one."""
    slippery = float(np.clip((0.9 - friction) / 0.6, 0.0, 1.0))
    return tuple(1.0 - slippery * np.array([0.14, 0.10, 0.05]))


def _draw_wind(axes: Any, wind: Any, where: float) -> None:
    """An arrow across the view, as long as the wind is strong."""
    if abs(wind) > 0.1:
        middle = float(np.mean(axes.get_ylim()))
        ends = [(where, middle + half * wind) for half in (-0.4, 0.4)]
        arrow = {"arrowstyle": "-|>", "color": style.DARK, "lw": 2.5}
        _put(axes, FancyArrowPatch(*ends, mutation_scale=10, **arrow))


def _put(axes: Any, artist: Any) -> None:
    """Draw something over what the axes already show, without keeping it."""
    axes.add_artist(artist)
    axes.draw_artist(artist)
    artist.remove()


def _turn_by(yaw: float | np.floating) -> Float[np.ndarray, "2 2"]:
    """The rotation into a frame with this yaw."""
    return np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])


def _nearest(
    positions: Float[np.ndarray, "time 2"], path: Float[np.ndarray, "point column"]
) -> np.ndarray:
    """The closest path point of each position; of one that is not finite, the first."""
    gaps = positions[:, None] - path[None, :, :2]
    return np.argmin(np.nan_to_num(np.sum(gaps**2, axis=-1)), axis=1)
