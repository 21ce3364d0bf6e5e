"""Write the tables of docs/planner.md and docs/which-planner.md from the measurements.

python -m benchmarks.quality.planner_page
"""

import json
import statistics
from pathlib import Path

from benchmarks.harness import ROOT
from benchmarks.markdown import filled, table
from benchmarks.quality.laws import CONTENDERS

HERE = Path(__file__).parent
DOCS = ROOT / "docs"
TIMES = ROOT / "benchmarks" / "timing" / "laws.json"
LAWS = {
    "feedback": "hand-made",
    "ancillary": "hand-made, the model's as one sample",
    "model": "the model's",
}
NOISES = {
    "curvature": "curvature",
    "rbf": "4 knots",
    "white": "white",
    "ar1": "AR(1)",
}
CARS = ("kinematic", "dynamic")


def stored(name):
    """The content of a file of measurements."""
    return json.loads((HERE / f"{name}.json").read_text("utf-8"))


def feedback():
    """RMSE of a car whose control is renewed between plans."""
    head = ["car", "plans", "RMSE [mm]", "worst", "minus plans at 50 Hz"]
    lines = []
    for vehicle, rows in stored("feedback")["vehicles"].items():
        for label, row in rows.items():
            errors, gap = row["rmse_mm"], row["minus_50_hz_mm"]
            low, high = gap["ci95"]
            difference = f"{gap['mean']:+.1f} ({low:+.1f} to {high:+.1f})"
            numbers = [f"{statistics.mean(errors):.1f}", f"{max(errors):.1f}"]
            numbers += ["" if label == "50 Hz" else difference]
            lines.append([vehicle, label, *numbers, f"{row['steering_rate']:.3f}"])
    return table([*head, "steering rate [rad/s]"], lines)


def obstacles():
    """Collisions with parked cars."""
    document = stored("obstacles")
    episodes = document["settings"]["episodes"]
    head = ["car", "path", "episodes with a collision", "smallest gap [m]"]
    lines = []
    for vehicle, found in document["vehicles"].items():
        for label, row in found["rows"].items():
            if label == "corridor counted":
                label = f"{label}, {found['corridor_m']:.3f} m"
            hit = f"{row['collisions']} of {episodes}"
            gap, away = row["smallest_gap_m"], row["largest_deviation_m"]
            lines.append([vehicle, label, hit, f"{gap:.3f}", f"{away:.3f}"])
    return table([*head, "largest deviation from the path [m]"], lines)


def laws():
    """Every law, noise and number of samples: mean and worst episode of each car."""
    drives, times = stored("laws")["rows"], json.loads(TIMES.read_text())["rows"]
    heads = [f"{car}, {what}" for car in CARS for what in ("mean", "worst")]
    heads = ["law", "noise", "samples, effective", *heads]
    lines = []
    for label, contender in CONTENDERS.items():
        cells = _choices(*contender)
        rates = []
        for car in CARS:
            rows = [
                row for row in drives if (row["vehicle"], row["label"]) == (car, label)
            ]
            errors = [error for row in rows for error in row["rmse_mm"]]
            cells += [f"{statistics.mean(errors):.1f}", f"{max(errors):.0f}"]
            rates += [row["steering_rate"] for row in rows]
        step = times[label]
        cells += [f"{min(rates):.3f} to {max(rates):.3f}", f"{step['best_ms']:.1f}"]
        lines.append([*cells, f"{step['compile_s']:.1f}"])
    return table([*heads, "steering rate [rad/s]", "step [ms]", "compile [s]"], lines)


def laws_again():
    """The recommended settings beside the paper's, on another seed."""
    heads = ["car, scenario", "law", "noise", "samples, effective"]
    lines = []
    for row in stored("laws_again")["rows"]:
        gap, errors = row["difference_mm"], row["rmse_mm"]
        low, high = gap["ci95"]
        cells = [f"{row['vehicle']}, {row['scenario'].upper()}"]
        cells += _choices(*CONTENDERS[row["label"]])
        cells += [f"{statistics.mean(errors):.1f}", f"{max(errors):.0f}"]
        lines.append([*cells, f"{gap['mean']:+.1f} ({low:+.1f} to {high:+.1f})"])
    return table([*heads, "mean [mm]", "worst", "difference"], lines)


def _choices(law, samples, options):
    """Law, noise and samples of a contender in words."""
    if samples == 1:
        return [LAWS[law], "none", "0"]
    noise = "curvature" if options.get("curvature") else options.get("noise", "ar1")
    effective = options.get("effective_samples")
    counted = f"{samples}, {effective:g}" if effective else f"{samples}"
    return [LAWS[law], NOISES[noise], counted]


PAGES = {
    "planner.md": {"feedback": feedback, "obstacles": obstacles},
    "which-planner.md": {"laws": laws, "laws again": laws_again},
}
"""Page -> marker -> its table."""


def page(name):
    """A page with its tables written anew."""
    text = (DOCS / name).read_text("utf-8")
    return filled(text, {marker: build() for marker, build in PAGES[name].items()})


def main():
    """Write the pages."""
    for name in PAGES:
        (DOCS / name).write_text(page(name), encoding="utf-8")


if __name__ == "__main__":
    main()
