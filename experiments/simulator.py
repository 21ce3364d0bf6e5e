"""What experiments/simulator.sh found, as a line: `python -m experiments.simulator ROOT`."""

import json
import sys
from pathlib import Path

import numpy as np

PREFIXES = {"nominal": "nominal_mppi_", "law_stanley": "stanley_"}
PREFIXES |= {"law_pure_pursuit": "pure_pursuit_"}
"""Of what is printed of a system; ours has none, and "estimated_" where e is."""


def main():
    """Print it."""
    runs = sorted(Path(sys.argv[1]).glob("highway*/*/*/"))
    certificate = json.loads((runs[0] / "certificate.json").read_text("utf-8"))
    corridor = certificate["corridor"]
    found = {
        name: corridor[name] for name in ("corridor_m", "coverage", "coverage_ci95")
    }
    found["coverage_s3"] = corridor["by_scenario"]["s3"]["coverage"]
    found["alpha"] = certificate["outputs"]["position"]["alpha"]
    for run in runs:
        for row in json.loads((run / "results.json").read_text("utf-8"))["rows"]:
            estimated = row["env"] == "estimated"
            name = "estimated_" if estimated else PREFIXES.get(row["system"], "")
            found[f"{name}rmse_mm"] = round(1e3 * row["rmse_m"]["mean"], 1)
            found[f"{name}departures"] = row["departures"]
    rounded = {name: np.round(value, 3).tolist() for name, value in found.items()}
    print(json.dumps({"law": corridor["conditions"]["law_model"]} | rounded))


if __name__ == "__main__":
    main()
