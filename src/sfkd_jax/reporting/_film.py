"""Drives of an animation, their scale, and the strip of their deviation over time."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from sfkd_jax.evaluation.formats import number
from sfkd_jax.reporting import style
from sfkd_jax.reporting._track import EXAGGERATION, first_outside
from sfkd_jax.reporting.scene import switches

LANE = 0.85
"""Deviation at which a car of 1.8 m leaves a lane of 3.5 m [m]."""
HALF_LANE = 3.4
"""As drawn [m]."""
BAND: dict[str, Any] = dict(fc=style.ACCENT, alpha=0.16, linewidth=0, zorder=1)
EDGE: dict[str, Any] = dict(color=style.ACCENT, linewidth=1.0, zorder=2)
"""Of a certified corridor."""

Move: TypeAlias = Callable[[int], None]
"""Draws the situation after a step."""


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


class Film(NamedTuple):
    """Drives of one road.

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

    def reach(self, last: int) -> float:
        """Largest deviation of the corridor and of the cars in their lanes [m]."""
        shown = [np.abs(car.lateral[:last]) for car in self.cars]
        inside = [one for one in shown if first_outside(one, LANE) == len(one)]
        peaks = [float(np.max(one, initial=0.0)) for one in inside]
        return max([self.corridor or 0.0, *peaks]) or LANE

    def widening(self, last: int) -> int:
        """The factor of deviations with which the corridor and all cars fit."""
        return int(np.clip(HALF_LANE / self.reach(last), 1, EXAGGERATION))


def draw_strip(axes: Any, film: Film, last: int) -> Move:
    """Draw the deviation over time, with friction as shades."""
    shown = [car.lateral[:last] for car in film.cars]
    top = 1.1 * max(1e-3, film.reach(last)) * (1.35 if film.corridor else 1.0)
    if film.envs is not None:
        edges = [0, *(step for step in switches(film.envs) if step < last), last]
        for start, stop in pairwise(edges):
            look = {
                "color": style.shade(film.envs[start, 0]),
                "linewidth": 0,
                "zorder": 0,
            }
            axes.axvspan(start * film.dt, stop * film.dt, **look)
    if film.corridor:
        _draw_band(axes, film.corridor)
    axes.axhline(0.0, color=style.AXIS, linewidth=0.8)
    lines = [axes.plot([], [], color=car.colour, linewidth=1.8)[0] for car in film.cars]
    now = axes.axvline(0.0, color=style.SOFT, linewidth=0.8)
    axes.set(xlim=(0.0, last * film.dt), ylim=(-top, top))
    axes.set_xlabel("time [s]", fontsize=9.5, labelpad=1)
    axes.set_ylabel("deviation [m]", fontsize=9.5)
    axes.spines[["top", "right"]].set_visible(False)

    def move(step: int) -> None:
        for line, values in zip(lines, shown, strict=True):
            count = min(step, first_outside(values, 2 * top)) + 1
            line.set_data(film.dt * np.arange(1, count + 1), values[:count])
        now.set_xdata([(step + 1) * film.dt] * 2)

    return move


def _draw_band(axes: Any, corridor: float) -> None:
    """The certified corridor along the whole of the axis."""
    axes.axhspan(-corridor, corridor, **BAND)
    for side in (-corridor, corridor):
        axes.axhline(side, **EDGE)
    look = {"color": style.ACCENT, "va": "bottom", "ha": "right", "zorder": 6}
    look |= {"bbox": None, "transform": axes.get_yaxis_transform()}
    name = f"certified corridor ± {number(corridor)} m"
    style.note(axes, 0.99, corridor, name, **look)
