"""The figures of `benchmarks.recovery`: basin of attraction, film of a wrong position.

    python -m benchmarks.recovery_figures [basin | film]

Writes docs/recovery.png from recovery.json, and docs/recovery.gif from two runs that it
drives with the policy that ships; by default both.
"""

import argparse
import json
from pathlib import Path

import jax
import numpy as np
from matplotlib.colors import ListedColormap

from benchmarks.device import CARS
from benchmarks.recovery import HEADINGS, KINDS, OFFSETS, PERIOD, Car, roads, runs_on
from sfkd_jax.report import film, style
from sfkd_jax.report.episodes import Episodes

ROOT = Path(__file__).parents[1]
LAWS = {
    "law of the box": "law of the certified box alone",
    "planner in the guard": "policy",
}
"""Row of recovery.json -> its name in the figure."""
SLOWEST = 20
"""Seconds after which a car that is not back counts as lost."""

SEED = 11
FOOT = 20.0
"""Where the film begins along the path [m], with some of the road behind the car."""
SECONDS = 7.0
"""Length of the film [s]."""
WRONG_FROM = 2.0
WRONG_FOR = 0.5
"""When the position begins to be wrong, and for how long [s]."""
WRONG_BY = 1.0
"""How far to the left the measured position lies [m]."""


def basin(document):
    """Time until a car is back, by its start, for the law of the box and the policy.

    Args:
        document: content of recovery.json; the times of a row are letters, a for 0 s.
    """
    rows = {(row["car"], row["row"]): row for row in document["rows"]}
    figure = style.canvas(4.9)
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    colours = style.matplotlib.colormaps["Blues_r"](np.linspace(0.1, 0.85, SLOWEST))
    for across, car in enumerate(CARS):
        for down, (row, name) in enumerate(LAWS.items()):
            letters = np.frombuffer(rows[car, f"basin: {row}"]["s"].encode(), np.uint8)
            times = np.reshape(letters - ord("a"), (len(OFFSETS), -1)).T
            axes = panels[down, across]
            drawn = axes.pcolormesh(
                OFFSETS,
                np.rad2deg(HEADINGS),
                np.ma.masked_greater(times, SLOWEST),
                cmap=ListedColormap(colours),
                vmin=0,
                vmax=SLOWEST,
            )
            axes.set_facecolor(style.SECOND)
            axes.set_title(f"{car} car:\n{name}", fontsize=9.5)
            axes.set(yticks=(-180, -90, 0, 90, 180), xticks=(-20, -10, 0, 10, 20))
            axes.grid(visible=False)
    figure.supxlabel("distance to the left of the path at the start [m]", fontsize=10)
    figure.supylabel("heading at the start [degrees]", fontsize=10)
    label = f"back after [s]; orange: never in {SLOWEST} s"
    figure.colorbar(drawn, ax=panels, label=label, ticks=range(0, SLOWEST + 1, 5))
    return figure


def jump(path):
    """Write a film of the dynamic car: the policy, and its law without a gate."""
    car = Car("dynamic", samples=300, batch=1)
    steps = round(SECONDS / PERIOD)
    time = PERIOD * np.arange(steps)
    wrong = (time >= WRONG_FROM) & (time < WRONG_FROM + WRONG_FOR)
    # Of the measured pose: ahead, to the left, yaw.
    offset = np.zeros((steps, 3))
    offset[wrong, 1] = WRONG_BY
    runs = runs_on(
        car,
        roads(1, SEED),
        steps,
        SEED,
        foot=FOOT,
        offset=offset,
        kind=KINDS.index("linear"),
    )
    scenario = f"The measured position is {WRONG_BY:.0f} m off for {WRONG_FOR} s"
    programs = {"sfkd": car.policy, "without the gate": car.bare}
    cars = []
    for name, program in programs.items():
        run = jax.tree.map(lambda leaf: leaf[0], program(runs))
        episodes = Episodes(
            row={"system": name, "scenario": scenario},
            dt=PERIOD,
            lateral=run["left"][None, 1:],
            states=run["state"],
            envs=runs.now.env[0],
            path=runs.road[0],
        )
        cars.append(episodes)
    # To scale: without the gate the car leaves the road.
    film.write(path, film.Film(cars, steps - 1, car.corridor, factor=1))


def main():
    """Draw what is named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("only", nargs="?", choices=("basin", "film"))
    only = parser.parse_args().only
    if only != "film":
        document = json.loads(
            (ROOT / "benchmarks" / "recovery.json").read_text("utf-8")
        )
        style.save(ROOT / "docs" / "recovery.png", basin, document)
    if only != "basin":
        jump(ROOT / "docs" / "recovery.gif")


if __name__ == "__main__":
    main()
