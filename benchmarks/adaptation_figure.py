"""One drive under a side force that nobody measures, with adaptation and without.

    python -m benchmarks.adaptation_figure drive    drives, and writes adaptation_run.json
    python -m benchmarks.adaptation_figure          draws docs/adaptation.png from that file

The drive is the first episode of the case "force, 3 s" of `benchmarks.adaptation`, on the
dynamic car.
"""

import argparse
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np

from benchmarks import adaptation, write
from benchmarks.device import PERIOD, SHIPPED, driving
from sfkd_jax import policy
from sfkd_jax.report import style

HOME = Path(__file__).parent
RUN = HOME / "adaptation_run.json"
PICTURE = HOME.parent / "docs" / "adaptation.png"
CAR = "dynamic"
CASE = "force, 3 s"
PROTOCOL = {"episodes": 16, "seconds": 30.0, "seed": 2027}
"""Of `benchmarks.adaptation`, so that the episode is one of those in its table."""
RECORDED = {
    "estimate": lambda info: info.adaptation.causes[0],
    "deviation": lambda info: info.adaptation.causes_std[0],
}
"""Side force and its standard deviation, relative to the largest one in E."""


def drive():
    """Drive the policy with adaptation and without, and write what the figure shows."""
    loaded = policy.load(SHIPPED / f"{CAR}_path")
    case = adaptation.CASES[CASE]
    plant = adaptation.changed_car(loaded, case)
    scenes, keys = adaptation.roads(plant, case, SimpleNamespace(**PROTOCOL))
    scene, key = jax.tree.map(lambda leaf: leaf[0], (scenes, keys))
    systems = adaptation.systems(loaded, case, plant)

    def episode(name, record):
        controller, params, _ = systems[name]
        run = driving(plant, controller, params, record=record)
        return jax.jit(run)(scene, key)

    def force(envs):
        wind = np.asarray(envs[:, 1], np.float64)
        return plant.wind_force * wind * np.abs(wind)

    def rounded(values, digits):
        return np.round(np.asarray(values, np.float64), digits).tolist()

    without = episode("SFKD", {})
    adapting = episode("SFKD, adaptive", RECORDED)
    # The policy observes the wind of the scenario; the force comes on top of it.
    unmeasured = force(scene.envs) - force(scene.observed_envs)
    largest = plant.wind_force * loaded.settings["environment"]["high"][1] ** 2
    signals = adapting.signals
    rows = [
        {
            "row": "SFKD",
            "lateral_mm": rounded(1e3 * without.lateral, 2),
        },
        {
            "row": "SFKD, adaptive",
            "lateral_mm": rounded(1e3 * adapting.lateral, 2),
            "estimate_n": rounded(largest * signals["estimate"], 1),
            "deviation_n": rounded(largest * signals["deviation"], 1),
        },
    ]
    head = {
        "car": CAR,
        "case": CASE,
        **PROTOCOL,
        "dt": PERIOD,
        "force_n": rounded(unmeasured, 1),
    }
    write(RUN, head, rows)


def draw(run):
    """Lateral errors above, and the side force with its estimate below."""
    figure = style.canvas(4.4)
    errors, forces = figure.subplots(2, 1, sharex=True, height_ratios=(1.2, 1.0))
    without, adapting = run["rows"]
    # A force lasts from one control step to the next; errors are those at its end.
    begin = run["dt"] * np.arange(len(run["force_n"]))
    time = begin + run["dt"]

    errors.axhline(0.0, color=style.AXIS, linewidth=0.8)
    errors.plot(
        time, without["lateral_mm"], color=style.SECOND, label="without adaptation"
    )
    errors.plot(
        time, adapting["lateral_mm"], color=style.ACCENT, label="with adaptation"
    )
    errors.set(ylabel="lateral error [mm]")

    estimate = np.asarray(adapting["estimate_n"])
    band = 2.0 * np.asarray(adapting["deviation_n"])
    # The force lies above its estimate and begins the legend.
    forces.step(
        begin,
        run["force_n"],
        where="post",
        color=style.DARK,
        zorder=3,
        label="true force",
    )
    forces.plot(begin, estimate, color=style.ACCENT, label="estimate")
    forces.fill_between(
        begin,
        estimate - band,
        estimate + band,
        color=style.ACCENT,
        alpha=0.16,
        linewidth=0,
        label="± 2 standard deviations",
    )
    forces.set(
        xlabel="time [s]",
        ylabel="side force\non the car [N]",
        xlim=(0.0, time[-1]),
    )
    for axes in (errors, forces):
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    figure.align_ylabels()
    return figure


def main():
    """Drive, or draw what was driven."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="?", choices=("drive", "draw"), default="draw")
    if parser.parse_args().what == "drive":
        drive()
    else:
        style.save(PICTURE, draw, json.loads(RUN.read_text("utf-8")))


if __name__ == "__main__":
    main()
