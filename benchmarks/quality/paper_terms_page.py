"""Write what the paper's latent cost and its fixed levels change into docs/results/paper-comparison.md.

python -m benchmarks.quality.paper_terms_page
"""

import json

import numpy as np

from benchmarks.harness import ROOT
from benchmarks.markdown import filled, table
from sfkd_jax.evaluation import mean_interval
from sfkd_jax.evaluation.formats import interval, millimetres, number

RESULTS = ROOT / "experiments" / "paper_terms" / "results.json"
PAGE = ROOT / "docs" / "results" / "paper-comparison.md"
SCENARIOS = ("s2", "s3")


def rows():
    """(vehicle, variation, scenario) -> its row; the variation None is neither."""
    stored = json.loads(RESULTS.read_text("utf-8"))["rows"]
    names = ("vehicle", "variation", "scenario")
    return {tuple(row[name] for name in names): row for row in stored}


def cell(row, plain):
    """Mean RMSE, and its paired difference to the row without a variation."""
    if row is plain:
        return millimetres(row["rmse_m"])
    gaps = np.subtract(row["rmse_episodes_m"], plain["rmse_episodes_m"])
    mean, bounds = mean_interval(1e3 * gaps)
    return f"{millimetres(row['rmse_m'])}: {number(mean, 1)} ({interval(bounds, 1)})"


def tables():
    """A line for every plant and variation."""
    found, lines = rows(), []
    for vehicle, variation in dict.fromkeys(key[:2] for key in found):
        cells = [
            cell(found[vehicle, variation, scenario], found[vehicle, None, scenario])
            for scenario in SCENARIOS
        ]
        lines.append([vehicle, variation or "neither", *cells])
    heads = [f"{scenario.upper()} [mm]: difference (95 %)" for scenario in SCENARIOS]
    return table(["plant", "SFKD with", *heads], lines)


def page():
    """The page with the table written anew."""
    return filled(PAGE.read_text("utf-8"), {"paper terms": tables()})


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
