"""The figures of `benchmarks.recovery`: basin of attraction, film of a wrong position.

    python -m benchmarks.recovery_figures

Writes docs/recovery.png from recovery.json, and docs/recovery.gif from two runs.
"""

import jax
import numpy as np
from matplotlib.colors import ListedColormap

from benchmarks.pages import CARS, ROOT, measured
from benchmarks.recovery import HEADINGS, KINDS, OFFSETS, PERIOD, Car, roads, runs_on
from sfkd_jax.report import film, style
from sfkd_jax.report.episodes import Episodes

SECONDS, BEGIN, LENGTH, SIZE = 7.0, 2.0, 0.5, 1.0
"""Of the film; when the position is wrong, for how long [s], and by how much [m]."""


def basin():
    """Time until a car is back, by its start, for the law of the box and the policy."""
    figure, rows = style.canvas(4.6), measured()
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    colours = style.matplotlib.colormaps["Blues_r"](np.linspace(0.1, 0.85, 20))
    look = {"cmap": ListedColormap(colours), "vmin": 0, "vmax": 20}
    for across, car in enumerate(CARS):
        for down, way in enumerate(("law of the box", "planner in the guard")):
            letters = np.frombuffer(rows[car, f"basin: {way}"]["s"].encode(), np.uint8)
            times = np.reshape(letters - ord("a"), (len(OFFSETS), -1)).T
            times, panel = np.ma.masked_greater(times, 20), axes[down, across]
            drawn = panel.pcolormesh(OFFSETS, np.rad2deg(HEADINGS), times, **look)
            panel.set_facecolor(style.SECOND)
            panel.set_title(f"{car}, {('before', 'after')[down]}")
            panel.set(yticks=(-180, -90, 0, 90, 180), xticks=(-20, -10, 0, 10, 20))
            panel.grid(visible=False)
    figure.supxlabel("start beside the path [m]", fontsize=10)
    figure.supylabel("start heading [degrees]", fontsize=10)
    figure.colorbar(drawn, ax=axes, label="back after [s]; orange: never in 20 s")
    return figure


def jump(path):
    """Write a film of the dynamic car: the policy, and its law without a gate."""
    car, steps = Car("dynamic", 300, 1), round(SECONDS / PERIOD)
    road, time_ = roads(1, 11), PERIOD * np.arange(steps)
    wrong = (time_ >= BEGIN) & (time_ < BEGIN + LENGTH)
    offset = SIZE * wrong[:, None] * np.eye(3)[1]
    runs = runs_on(car, road, steps, 11, offset=offset, kind=KINDS.index("linear"))
    cars = []
    for name, drive in (("sfkd", car.policy), ("no gate", car.bare)):
        made = jax.tree.map(lambda leaf: leaf[0], drive(runs))
        row = {"system": name, "scenario": f"GPS {SIZE:.0f} m off for {LENGTH} s"}
        about = made["left"][None, 1:], made["state"], runs.now.env[0], runs.road[0]
        cars.append(Episodes(row, PERIOD, *about))
    film.write(path, film.Film(cars, steps - 1, car.corridor))


if __name__ == "__main__":
    style.save(ROOT / "docs" / "recovery.png", basin)
    jump(ROOT / "docs" / "recovery.gif")
