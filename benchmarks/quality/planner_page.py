"""Write the tables of docs/planner.md from feedback.json and obstacles.json.

python -m benchmarks.quality.planner_page
"""

import json
import statistics
from pathlib import Path

from benchmarks.harness import ROOT
from benchmarks.markdown import filled, table

PAGE = ROOT / "docs" / "planner.md"
HERE = Path(__file__).parent


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


TABLES = {"feedback": feedback, "obstacles": obstacles}
"""Marker on the page -> its table."""


def page(text):
    """The page with its tables written anew."""
    return filled(text, {name: build() for name, build in TABLES.items()})


def main():
    """Write the page."""
    PAGE.write_text(page(PAGE.read_text("utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
