"""A film of a drive: cars from above, deviations widened, over a strip of the deviation and the weather they meet."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from sfkd_jax.reporting._benchmark_figures import FIGURED, conditions, look, shade
from sfkd_jax.reporting._benchmark_rows import SELF_EVIDENT, Contest, Row, contests, stem
from sfkd_jax.reporting._drives import Drive, drives
from sfkd_jax.reporting._scene import switches
from sfkd_jax.reporting._style import PLATE, literal, scenario_label
from sfkd_jax.reporting._track import EXAGGERATION, _projected, _widened

MOST_BYTES = 2_000_000
SECONDS = 13.5
_COLOURS = 48
_AHEAD, _BEHIND = 28.0, 14.0  # of the picture around the first car [m]
_LANE, _SPACING = 3.4, 7.6  # half a lane, and between two copies of the road [m]
_CAR = np.array([[2.4, 0.0], [1.8, 0.85], [-2.2, 0.85], [-2.2, -0.85], [1.8, -0.85]]).T  # nose to tail [m]


class _Writer(PillowWriter):
    """One palette for all frames, that of the last, whose strip has every shade: half the bytes, and no flicker."""

    def finish(self) -> None:
        palette = self._frames[-1].quantize(colors=_COLOURS, kmeans=1)
        self._frames = [frame.quantize(palette=palette, dither=0) for frame in self._frames]
        super().finish()


class _Cast(NamedTuple):
    """Who is shown, the first one followed by the camera.

    Attributes:
        drives: of the cars. near: closest path point of each car at each step. offset: left of it [m].
    """

    drives: list[Drive]
    near: list[np.ndarray]
    offset: list[np.ndarray]


def animate(directory: Path, rows: list[Row], scenario: str) -> Path | None:
    """Write `scenario`_`vehicle`.gif of rows whose arrays lie in a directory; None where no states and path do."""
    contest = contests(rows)[0]
    made = film(directory, contest, directory / f"{scenario}_{stem(contest)}.gif", scenario=scenario)
    return made and made[0]


def film(
    directory: Path, contest: Contest, path: Path, *, seconds: float = SECONDS, scenario: str = FIGURED
) -> tuple[Path, list[str]] | None:
    """Write a GIF of at most MOST_BYTES in real time, dropping frames until it fits.

    Returns:
        The file and the names of the cars; None where nobody's states and path are there.
    """
    cast = _cast(drives(directory, contest, scenario)[0])
    if not cast.drives:
        return None
    last = min([round(seconds / cast.drives[0].dt), *(len(one.lateral) for one in cast.drives)])
    for stride in (1, 2, 5):
        _write(cast, scenario, range(0, last, stride), path, rate=1 / (stride * cast.drives[0].dt))
        if path.stat().st_size <= MOST_BYTES:
            break
    return path, [one.line.name for one in cast.drives]


def _cast(found: list[Drive]) -> _Cast:
    """SFKD, nominal and one learned rival: ICODE-MPPI, else the first there is."""
    whole = [one for one in found if one.states is not None and one.path is not None]
    rivals = [one for one in whole if not one.line.system.startswith("sfkd") and one.line.system not in SELF_EVIDENT]
    rivals.sort(key=lambda one: (one.line.system != "icode_mppi", one.line.env != "measured"))
    named = [[one for one in whole if one.line.system in names] for names in (("sfkd", "sfkd_path"), ("nominal",))]
    chosen = [group[0] for group in (*named, rivals) if group] or whole[:1]
    pairs = [_projected(np.asarray(one.states)[:, :2], np.asarray(one.path)) for one in chosen]
    return _Cast(chosen, [near for near, _ in pairs], [offset for _, offset in pairs])


def _write(cast: _Cast, scenario: str, steps: range, path: Path, rate: float) -> None:
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        figure = Figure(figsize=(6.0, 4.9))
        FigureCanvasAgg(figure)
        above, strip = figure.subplots(2, 1, height_ratios=[2.4, 1])
        figure.subplots_adjust(left=0.125, right=0.985, top=0.94, bottom=0.1, hspace=0.08)
        above.set_title(
            f"{scenario_label(scenario)}, deviations × {_widening(cast, steps.stop)}", fontsize=9.5, loc="right", pad=4
        )
        moving = [*_road(above, cast, steps.stop), *_strip(strip, cast, steps.stop)]
        writer = _Writer(fps=max(1, round(rate)))
        with writer.saving(figure, str(path), dpi=90):
            for step in steps:
                for move in moving:
                    move(step)
                writer.grab_frame()


def _road(axes: Any, cast: _Cast, last: int) -> list[Any]:
    """One copy of the road a car, all in the frame of the first car's path point, and how everything on it moves."""
    factor, first, path = _widening(cast, last), cast.drives[0], np.asarray(cast.drives[0].path)
    shifts = _SPACING * np.arange(len(cast.drives) - 1, -1, -1.0)
    edge: dict[str, Any] = {"color": "#aab1ba", "linewidth": 1.3, "zorder": 2}
    sides = [[axes.plot([], [], **edge)[0] for _ in range(2)] for _ in shifts]
    middles = [axes.plot([], [], **edge | {"linewidth": 0.9, "linestyle": (0, (6, 5))})[0] for _ in shifts]
    cars, trails, names = [], [], []
    for one, shift in zip(cast.drives, shifts, strict=True):
        colour = look(one.line)["color"]
        cars.append(axes.add_patch(Polygon(_CAR.T, facecolor=colour, edgecolor="#30363d", linewidth=0.8, zorder=6)))
        trails.append(axes.plot([], [], color=colour, linewidth=1.8, zorder=4)[0])
        words: dict[str, Any] = {"color": colour, "fontsize": 10, "fontweight": "bold", "va": "center", "zorder": 8}
        names.append(axes.text(3.2, shift, literal(one.line.name), bbox=PLATE | {"alpha": 0.75}, **words))
    axes.set(xlim=(-_BEHIND, _AHEAD), ylim=(-0.5 * _SPACING, shifts[0] + 0.5 * _SPACING), xticks=[], yticks=[])
    axes.set_aspect("equal")
    weather = axes.set_title("", fontsize=10.5, loc="left", pad=4)
    arrow: dict[str, Any] = {"arrowstyle": "-|>", "color": "#30363d", "lw": 2.5}
    wind = axes.annotate("", (0.0, 0.0), (0.0, 0.0), arrowprops=arrow, zorder=9)

    def move(step: int) -> None:
        centre = int(cast.near[0][step + 1])
        turn, origin = _frame(path[centre])
        points = path[max(centre - 120, 0) : centre + 160]
        for place, (one, shift) in enumerate(zip(cast.drives, shifts, strict=True)):
            lift = np.array([[0.0], [shift]])
            for line, width in zip((*sides[place], middles[place]), (_LANE, -_LANE, 0.0), strict=True):
                line.set_data(*turn @ (_widened(points, np.full(len(points), width), 1) - origin) + lift)
            here = slice(max(step - 20, 0), step + 2)
            own = np.asarray(one.path)[cast.near[place][here]]
            track = turn @ (_widened(own, cast.offset[place][here], factor) - origin) + lift
            yaw = np.asarray(one.states)[step + 1, 2] - path[centre, 2]
            rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            trails[place].set_data(*track)
            names[place].set_y(track[1, -1])
            cars[place].set_xy((rotation @ _CAR + track[:, -1:]).T)
        if first.envs is not None:
            friction, speed = first.envs[min(step, len(first.envs) - 1)]
            axes.set_facecolor(shade(friction))
            weather.set_text(conditions(friction, speed))
            wind.set_visible(bool(abs(speed) > 1e-3))
            middle = 0.5 * shifts[0]
            wind.set_position((0.93 * _AHEAD, middle - 0.5 * speed))
            wind.xy = (0.93 * _AHEAD, middle + 0.5 * speed)

    return [move]


def _widening(cast: _Cast, last: int) -> int:
    """How many times deviations are drawn as wide: as many as keep every car in its lane."""
    peak = max(float(np.nanmax(np.abs(offset[: last + 1]), initial=0.0)) for offset in cast.offset)
    return int(np.clip(_LANE / max(peak, 1e-6), 1, EXAGGERATION))


def _frame(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The turn into a path point's frame, and its place."""
    x, y, yaw = point[:3]
    return np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]), np.array([[x], [y]])


def _strip(axes: Any, cast: _Cast, last: int) -> list[Any]:
    """Deviation over time, drawn up to now."""
    first, dt = cast.drives[0], cast.drives[0].dt
    shown = [one.lateral[:last] for one in cast.drives]
    reach = 1.1 * max(1e-3, *(float(np.nanmax(np.abs(values), initial=0.0)) for values in shown))
    if first.envs is not None:
        edges = [0, *(step for step in switches(first.envs) if step < last), last]
        for start, stop in pairwise(edges):
            axes.axvspan(start * dt, stop * dt, color=shade(first.envs[start, 0]), linewidth=0)
    axes.axhline(0.0, color="#9aa1ab", linewidth=0.8)
    lines = [axes.plot([], [], color=look(one.line)["color"], linewidth=1.8)[0] for one in cast.drives]
    now = axes.axvline(0.0, color="#57606a", linewidth=0.8)
    axes.set(xlim=(0.0, last * dt), ylim=(-reach, reach))
    axes.set_xlabel("time [s]", fontsize=9.5, labelpad=1)
    axes.set_ylabel("deviation [m]", fontsize=9.5)
    axes.spines[["top", "right"]].set_visible(False)

    def move(step: int) -> None:
        for line, values in zip(lines, shown, strict=True):
            line.set_data(dt * np.arange(1, step + 2), values[: step + 1])
        now.set_xdata([(step + 1) * dt] * 2)

    return [move]
