"""What a film shows, to what scale, and its strip: the deviation up to now over the weather."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from sfkd_jax.reporting._benchmark_figures import shade
from sfkd_jax.reporting._numbers import number
from sfkd_jax.reporting._scene import switches
from sfkd_jax.reporting._style import ACCENT
from sfkd_jax.reporting._track import EXAGGERATION

LANE = 0.85
"""Deviation at which a car of 1.8 m leaves a lane of 3.5 m [m]; who does sets no scale."""
HALF_LANE = 3.4
"""As drawn [m]."""
BAND: dict[str, Any] = {"facecolor": ACCENT, "alpha": 0.16, "linewidth": 0, "zorder": 1}
BAND_EDGE: dict[str, Any] = {"color": ACCENT, "linewidth": 1.0, "zorder": 2}

Move: TypeAlias = Callable[[int], None]
"""Draws what is there after a step."""


class Car(NamedTuple):
    """One that is shown.

    Attributes:
        name: beside it.
        colour: of it.
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
        title: above it.
        dt: sampling period [s].
        points: x, y, yaw, curvature along the road.
        envs: friction and wind [m/s] at every step.
        cars: the first one followed by the camera.
        corridor: half width that is certified [m].
    """

    title: str
    dt: float
    points: Float[np.ndarray, "point column"]
    envs: Float[np.ndarray, "time 2"] | None
    cars: list[Car]
    corridor: float | None = None


def until(values: np.ndarray, bound: float) -> int:
    """How many of the first values lie within ±bound; one that is not finite does not."""
    return int(np.argmin(np.append(np.abs(values) <= bound, False)))


def reach(film: Film, last: int) -> float:
    """Largest deviation up to a step of the cars that stay in their lanes, and of the corridor [m]."""
    shown = [car.lateral[:last] for car in film.cars]
    stay = [values for values in shown if until(values, LANE) == len(values)]
    known = [
        film.corridor or 0.0,
        *(float(np.max(np.abs(values), initial=0.0)) for values in stay),
    ]
    return max(known) or LANE


def widening(film: Film, last: int) -> int:
    """How many times deviations are drawn as wide: as many as keep the corridor and every car in its lane."""
    return int(np.clip(HALF_LANE / reach(film, last), 1, EXAGGERATION))


def strip(axes: Any, film: Film, last: int) -> Move:
    """Draw the deviation over time."""
    shown, top = (
        [car.lateral[:last] for car in film.cars],
        1.1 * max(1e-3, reach(film, last)),
    )
    if film.envs is not None:
        edges = [0, *(step for step in switches(film.envs) if step < last), last]
        for start, stop in pairwise(edges):
            axes.axvspan(
                start * film.dt,
                stop * film.dt,
                color=shade(film.envs[start, 0]),
                linewidth=0,
                zorder=0,
            )
    if film.corridor:
        top *= 1.35
        axes.axhspan(-film.corridor, film.corridor, **BAND)
        for side in (-film.corridor, film.corridor):
            axes.axhline(side, **BAND_EDGE)
        words: dict[str, Any] = {
            "fontsize": 8.5,
            "color": ACCENT,
            "va": "bottom",
            "ha": "right",
            "zorder": 6,
        }
        name = f"certified corridor ± {number(film.corridor)} m"
        axes.text(
            0.99, film.corridor, name, transform=axes.get_yaxis_transform(), **words
        )
    axes.axhline(0.0, color="#9aa1ab", linewidth=0.8)
    lines = [axes.plot([], [], color=car.colour, linewidth=1.8)[0] for car in film.cars]
    now = axes.axvline(0.0, color="#57606a", linewidth=0.8)
    axes.set(xlim=(0.0, last * film.dt), ylim=(-top, top))
    axes.set_xlabel("time [s]", fontsize=9.5, labelpad=1)
    axes.set_ylabel("deviation [m]", fontsize=9.5)
    axes.spines[["top", "right"]].set_visible(False)

    def move(step: int) -> None:
        for line, values in zip(lines, shown, strict=True):
            count = min(step, until(values, 2 * top)) + 1
            line.set_data(film.dt * np.arange(1, count + 1), values[:count])
        now.set_xdata([(step + 1) * film.dt] * 2)

    return move
