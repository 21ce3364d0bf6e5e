"""What experiments/simulator.sh found, in one line of JSON: `python -m experiments.simulator ROOT`."""

import json
import sys
from pathlib import Path


def rows(run):
    """The first row of results.json of a run, and its certificate if it has one."""
    folder = next(run.glob("*/seed=0"))
    results = json.loads((folder / "results.json").read_text("utf-8"))
    file = folder / "certificate.json"
    certificate = json.loads(file.read_text("utf-8")) if file.is_file() else {}
    return results["rows"][0], certificate


def main():
    """Print it."""
    root = Path(sys.argv[1])
    car, certificate = rows(root / "highway")
    corridor = certificate["corridor"]
    found = {
        "law": corridor["conditions"]["law_model"],
        "corridor_m": round(corridor["corridor_m"], 3),
        "coverage": round(corridor["coverage"], 3),
        "coverage_s3": round(corridor["by_scenario"]["s3"]["coverage"], 3),
        "departures": car["departures"],
        "rmse_mm": round(1e3 * car["rmse_m"]["mean"], 1),
    }
    for name, samples in (("nominal_mppi", 1500), ("hand_made_law", 1)):
        row, _ = rows(root / f"highway_nominal_{samples}")
        found[f"{name}_rmse_mm"] = round(1e3 * row["rmse_m"]["mean"], 1)
        found[f"{name}_departures"] = row["departures"]
    print(json.dumps(found))


if __name__ == "__main__":
    main()
