"""What experiments/simulator.sh found, as a line: `python -m experiments.simulator ROOT`."""

import json
import sys
from pathlib import Path

NAMES = {
    ("sfkd_path", "measured"): "",
    ("sfkd_path", "estimated"): "estimated_",
    ("law_stanley", "measured"): "stanley_",
    ("law_pure_pursuit", "measured"): "pure_pursuit_",
    ("nominal", "none"): "nominal_mppi_",
}
"""Rows by system and source of e."""


def read(run, name):
    """A document of a run."""
    return json.loads(next(run.glob(f"*/seed=0/{name}.json")).read_text("utf-8"))


def main():
    """Print it."""
    root = Path(sys.argv[1])
    corridor = (certificate := read(root / "highway", "certificate"))["corridor"]
    found = {
        "law": corridor["conditions"]["law_model"],
        "corridor_m": round(corridor["corridor_m"], 3),
        "coverage": round(corridor["coverage"], 3),
        "coverage_ci95": [round(end, 3) for end in corridor["coverage_ci95"]],
        "coverage_s3": round(corridor["by_scenario"]["s3"]["coverage"], 3),
        "alpha": round(certificate["outputs"]["position"]["alpha"], 3),
    }
    rows = read(root / "highway", "results")["rows"]
    rows += read(root / "highway_nominal", "results")["rows"]
    for row in rows:
        name = NAMES[row["system"], row["env"]]
        found[f"{name}rmse_mm"] = round(1e3 * row["rmse_m"]["mean"], 1)
        found[f"{name}departures"] = row["departures"]
    print(json.dumps(found))


if __name__ == "__main__":
    main()
