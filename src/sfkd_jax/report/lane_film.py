"""A film of a car in its lane, among obstacles."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.text import Text
from PIL import Image

from sfkd_jax.driving.simulation import Episode
from sfkd_jax.report import style
from sfkd_jax.report.frames import (
    EVERY,
    SECONDS,
    TRAIL,
    area_between,
    draw_frames,
    draw_once,
    draw_wind,
    into_view,
    seen_from,
    surface_colour,
)
from sfkd_jax.report.lane_scene import scene_of

_SIGHT = (-8.0, 34.0)
"""What is seen of a lane behind and ahead of the car [m]."""
_SIDE = 6.6
"""What is seen of a lane to either side of its middle [m]."""
_OBSTACLE: dict[str, Any] = dict(fc=style.SOFT, ec=style.DARK, lw=0.8)
_NEEDED: dict[str, Any] = dict(fc=style.SECOND, alpha=0.3, lw=0)
_CORRIDOR: dict[str, Any] = dict(fc=style.ACCENT, alpha=0.45, lw=0)
_REFERENCE: dict[str, Any] = dict(color=style.ACCENT, lw=0.9)
_CAR: Any = (
    dict(fc=style.CAR, ec=style.DARK, lw=1.0),
    dict(fc=style.DARK),
    dict(fc=style.DARK),
)
"""Looks of the parts of the car."""


class LaneFilm:
    """A car in its lane, and the reference that it has committed to.

    The view is along the road at the car. The signals `corridor`, `reference` and
    `clearance` of the episode must have been recorded.
    """

    def __init__(
        self, scenario: Any, episode: Episode, *, dt: float, car: tuple[float, float]
    ) -> None:
        """Take an episode on a course; `car` is half of length and width [m]."""
        self.dt = dt
        self.envs = np.asarray(scenario.envs)
        lane, obstacles = scenario.course[:2]
        self.path = np.asarray(lane.path.points)
        self.spacing = float(lane.path.spacing)
        # To the left of the middle [m].
        self.edges = (np.asarray(lane.left), -np.asarray(lane.right))
        self.obstacles = obstacles
        self.states = np.asarray(episode.states)
        self.car = car
        self.along = np.append(0.0, episode.progress)
        self.signals = episode.signals
        self.corridor = np.asarray(episode.signals["corridor"])
        # The film begins where the road fills the view: the road begins at the start.
        self.first = int(np.argmax(self.along >= -_SIGHT[0]))
        self.last = min(round(SECONDS / dt), len(self.corridor))

    def frames(self) -> Iterator[Image.Image]:
        """Yield the frames."""
        figure = style.canvas(3.5)
        # No layout engine: axes that shift between frames would make the film shake.
        figure.set_layout_engine("none")
        figure.set(figwidth=8.0, dpi=100)
        axes = figure.add_axes((0.07, 0.225, 0.92, 0.68))
        axes.set(xlim=_SIGHT, ylim=(-_SIDE, _SIDE), aspect="equal")
        axes.set_facecolor(style.ROADSIDE)
        axes.set_xlabel("ahead of the car [m]", labelpad=1)
        axes.set_ylabel("left of the middle [m]")
        narrowest = np.nan_to_num(self.corridor).min()
        corridor = f"certified corridor, ± {narrowest:.2f} m"
        handles = [
            Line2D([], [], **_REFERENCE, label="committed reference"),
            Polygon([[0, 0]], **_CORRIDOR, label=corridor),
            Polygon([[0, 0]], **_OBSTACLE, label="obstacle"),
            Polygon([[0, 0]], **_NEEDED, label="plus half the car and corridor"),
        ]
        figure.legend(
            handles=handles,
            loc="lower center",
            ncols=4,
            fontsize=9,
            frameon=False,
            columnspacing=1.4,
        )
        steps = range(self.first, self.last, EVERY)
        return draw_frames(figure, steps, partial(self._draw, axes))

    def _draw(self, axes: Any, step: int) -> None:
        """Draw road, obstacles, corridor and car at a step."""
        state = self.states[step]
        index, share = divmod(self.along[step] / self.spacing, 1.0)
        first = int(index)
        centre = (1.0 - share) * self.path[first] + share * self.path[first + 1]
        seen = partial(into_view, centre)
        friction, wind = self.envs[step]
        self._draw_road(axes, partial(seen_from, centre), first, friction)
        references = np.asarray(self.signals["reference"])
        # What it has followed, and what it follows next.
        past = references[max(step - TRAIL, 0) : step, 0]
        scene = scene_of(
            state,
            np.concatenate([past, references[step]]),
            float(self.corridor[step]),
            self.obstacles,
            half=self.car,
        )
        for outlines, look in ((scene.needed, _NEEDED), (scene.obstacles, _OBSTACLE)):
            for outline in outlines:
                draw_once(axes, Polygon(seen(outline).T, **look))
        if scene.corridor is not None:
            draw_once(axes, area_between(*map(seen, scene.corridor), **_CORRIDOR))
        draw_once(axes, Line2D(*seen(scene.reference), **_REFERENCE))
        for part, look in zip(scene.car, _CAR, strict=True):
            draw_once(axes, Polygon(seen(part).T, **look))
        draw_wind(axes, wind, 0.93 * _SIGHT[1])
        clear = max(float(self.signals["clearance"][step]), 0.0)
        text = "   ".join(
            [
                f"{step * self.dt:4.1f} s",
                f"{state[3]:4.1f} m/s",
                f"friction {friction:.1f}",
                f"wind {round(wind)} m/s",
                f"keeps {clear:.2f} m clear",
            ]
        )
        above: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False}
        draw_once(axes, Text(0, 1.04, text, fontsize=11, **above))
        speed_in_half_a_second = references[step, round(0.5 / self.dt) - 1, 3]
        if speed_in_half_a_second < state[3] - 0.3:
            look = {"ha": "right", "fontweight": "bold", "color": "#d55e00"}
            draw_once(axes, Text(0.96, 1.04, "brakes", fontsize=11, **look, **above))

    def _draw_road(self, axes: Any, seen: Any, first: int, friction: Any) -> None:
        """Draw surface, edges and middle of the road.

        Args:
            axes: to draw on.
            seen: (points, offset) -> places in the view.
            first: index of the point of the road at the car.
            friction: of the road.
        """
        around = slice(max(first - 40, 0), first + 120)
        road = self.path[around]
        edges = [seen(road, edge[around]) for edge in self.edges]
        surface = area_between(*edges, fc=surface_colour(friction), ec="none")
        draw_once(axes, surface)
        for edge in edges:
            draw_once(axes, Line2D(*edge, color=style.DARK, lw=1.4))
        middle = Line2D(*seen(road), color=style.MARKING, lw=1.0, ls=(0, (6, 5)))
        draw_once(axes, middle)
