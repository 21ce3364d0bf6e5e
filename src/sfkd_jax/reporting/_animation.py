"""A film of a drive: cars from above, deviations widened, over a strip of the deviation and the weather they meet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sfkd_jax.reporting._benchmark_figures import FIGURED, look
from sfkd_jax.reporting._benchmark_rows import (
    SELF_EVIDENT,
    Contest,
    Row,
    contests,
    stem,
)
from sfkd_jax.reporting._drives import Drive, drives
from sfkd_jax.reporting._film import Car, Film, strip
from sfkd_jax.reporting._film_road import extent, road
from sfkd_jax.reporting._style import ACCENT, LEAVES, THIRD, family, scenario_label

MOST_BYTES = 2_000_000
SECONDS = 13.5
_COLOURS = 48
_METRE, _BESIDE = (
    0.123,
    2.1,
)  # of the road as drawn, and height of all but the road [in]
_DRIVES = (ACCENT, THIRD, LEAVES)
"""Of given drives."""


class _Writer(PillowWriter):
    """One palette for all frames, that of the last, whose strip has every shade: half the bytes, and no flicker."""

    def finish(self) -> None:
        palette = self._frames[-1].quantize(colors=_COLOURS, kmeans=1)
        self._frames = [
            frame.quantize(palette=palette, dither=0) for frame in self._frames
        ]
        super().finish()


def animate(
    directory: Path, rows: list[Row], scenario: str, *, corridor: float | None = None
) -> Path | None:
    """Write `scenario`_`vehicle`.gif of rows whose arrays lie in a directory; None where no states and path do.

    Args:
        directory: where the arrays of the rows lie, and the file will.
        rows: of a comparison, of one vehicle.
        scenario: that is shown.
        corridor: half width that is certified [m], drawn around the road's middle.
    """
    contest = contests(rows)[0]
    place = directory / f"{scenario}_{stem(contest)}.gif"
    made = film(directory, contest, place, scenario=scenario, corridor=corridor)
    return made and made[0]


def film(
    directory: Path,
    contest: Contest,
    path: Path,
    *,
    seconds: float = SECONDS,
    scenario: str = FIGURED,
    corridor: float | None = None,
) -> tuple[Path, list[str]] | None:
    """Write a GIF of SFKD, nominal and a rival.

    Returns:
        The file and the names of the cars; None where nobody's states and path are
        there.
    """
    chosen = _chosen(drives(directory, contest, scenario)[0])
    if not chosen:
        return None
    cars = [
        Car(one.line.name, look(one.line)["color"], one.lateral, np.asarray(one.states))
        for one in chosen
    ]
    first = chosen[0]
    shown = Film(
        scenario_label(scenario),
        first.dt,
        np.asarray(first.path),
        first.envs,
        cars,
        corridor,
    )
    return write(shown, path, seconds), [car.name for car in cars]


def draw_film(
    path: Path, cars: dict[str, tuple[np.ndarray, np.ndarray]], **about: Any
) -> Path:
    """Write a GIF of given drives of one road.

    Args:
        path: of the GIF.
        cars: name -> signed deviation of x_1 … x_T [m] and x_0 … x_T, at most as many
            as there are colours.
        about: the road and what is certified on it, as in `Film`.
    """
    drawn = [
        Car(name, colour, *driven)
        for (name, driven), colour in zip(cars.items(), _DRIVES, strict=False)
    ]
    return write(Film(cars=drawn, **about), path, SECONDS)


def _chosen(found: list[Drive]) -> list[Drive]:
    """SFKD, nominal and one learned rival: ICODE-MPPI, else the first there is."""
    whole = [one for one in found if one.states is not None and one.path is not None]
    rivals = [
        one
        for one in whole
        if not one.line.system.startswith("sfkd")
        and one.line.system not in SELF_EVIDENT
    ]
    rivals.sort(
        key=lambda one: (one.line.system != "icode_mppi", one.line.env != "measured")
    )
    named = [
        [one for one in whole if family(one.line.system) == name]
        for name in ("sfkd", "nominal")
    ]
    return [group[0] for group in (*named, rivals) if group] or whole[:1]


def write(shown: Film, path: Path, seconds: float) -> Path:
    """Write a GIF of at most MOST_BYTES in real time, dropping frames until it fits."""
    last = min([round(seconds / shown.dt), *(len(car.lateral) for car in shown.cars)])
    for stride in (1, 2, 5):
        _write(shown, range(0, last, stride), path, rate=1 / (stride * shown.dt))
        if path.stat().st_size <= MOST_BYTES:
            break
    return path


def _write(shown: Film, steps: range, path: Path, rate: float) -> None:
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        low, high = extent(shown)
        tall = _METRE * (high - low)
        height = tall + _BESIDE
        figure = Figure(figsize=(6.0, height))
        FigureCanvasAgg(figure)
        above = figure.add_axes(
            (0.125, 1.0 - (tall + 0.29) / height, 0.86, tall / height)
        )
        below = figure.add_axes((0.125, 0.49 / height, 0.86, 1.16 / height))
        moving = [road(above, shown, steps.stop), strip(below, shown, steps.stop)]
        writer = _Writer(fps=max(1, round(rate)))
        with writer.saving(figure, str(path), dpi=90):
            for step in steps:
                for move in moving:
                    move(step)
                writer.grab_frame()
