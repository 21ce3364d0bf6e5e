"""What experiments/simulator.sh and slipx.sh found, as one line of JSON.

    python -m experiments.simulator ROOT NAME

ROOT is the folder of the runs, and NAME what their names begin with. The scripts call
this at their end.
"""

import json
import sys
from pathlib import Path

import numpy as np

from benchmarks import stamp
from sfkd_jax import certificate
from sfkd_jax.driving.certificate import DrivingCertificate

PREFIXES = {
    "nominal": "nominal_mppi_",
    "law_stanley": "stanley_",
    "law_pure_pursuit": "pure_pursuit_",
}
"""System -> beginning of the names of its numbers; those of the policy have none."""
ESTIMATED = "estimated_"
"""That of the policy where it estimates the environment."""
LAW = "law_"
"""That of the law of the policy, which drives alone where one sample is drawn."""


def main():
    """Print the line."""
    root, name = sys.argv[1:]
    runs = sorted(Path(root).glob(f"{name}*/*/*/"))
    claimed = certificate.read(runs[0] / "certificate.json", DrivingCertificate)
    corridor = claimed.corridor
    found = {
        "corridor_m": corridor.corridor_m,
        "coverage": corridor.coverage.share,
        "coverage_ci95": corridor.coverage.ci95,
        "coverage_s3": corridor.by_scenario["s3"].share,
        "alpha": claimed.proof.outputs["position"].alpha,
    }
    for run in runs:
        for row in json.loads((run / "results.json").read_text("utf-8"))["rows"]:
            name = prefix(row)
            found[f"{name}rmse_mm"] = round(1e3 * row["rmse_m"]["mean"], 1)
            found[f"{name}departures"] = row["departures"]
            # There is none of runs that are not finite.
            if row["max_deviation_m"] is not None:
                found[f"{name}worst_m"] = row["max_deviation_m"]
    rounded = {name: np.round(value, 3).tolist() for name, value in found.items()}
    law = {"law": corridor.conditions.law_model}
    print(json.dumps(law | rounded | stamp()))


def prefix(row):
    """The beginning of the names of the numbers of a row."""
    if row["system"] in PREFIXES:
        return PREFIXES[row["system"]]
    if row["env"] == "estimated":
        return ESTIMATED
    return LAW if "mppi.num_samples=1" in row["controller"].split(",") else ""


if __name__ == "__main__":
    main()
