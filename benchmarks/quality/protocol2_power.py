"""Write what sfkd-bench-2 can tell into docs/results/protocol-2.md.

python -m benchmarks.quality.protocol2_power
From the differences between rows in experiments/seeds/results.json (three trainings,
six episodes, protocol 1), whose variances have few degrees of freedom: a guide for the
size of the experiment, not a result.
"""

import json

import numpy as np
from scipy import stats

from benchmarks import markdown
from benchmarks.harness import ROOT
from sfkd_jax import evaluation

PAGE = ROOT / "docs" / "results" / "protocol-2.md"
MEASURED = ROOT / "experiments" / "seeds" / "results.json"
SIZES = {"1 x 6": (1, 6), "3 x 16": (3, 16), "10 x 200": (10, 200)}
"""Trainings and episodes of protocol 1, of this one, and with an accelerator."""
POWER = 0.8
REFERENCE = "sfkd"


def deviations(difference):
    """Standard deviations of trainings, of episodes and of the rest."""
    trainings, episodes = difference.shape
    of_trainings, of_episodes, rest = evaluation.mean_squares(difference)
    parts = (of_trainings - rest) / episodes, (of_episodes - rest) / trainings, rest
    return np.sqrt(np.maximum(parts, 0.0))


def detectable(spread, size):
    """The difference that is found with probability `POWER` at level 5 %.

    With one training its own deviation counts as part of the difference.
    """
    trainings, episodes = size
    by_training, by_episode, rest = np.square(spread) / (
        trainings,
        episodes,
        trainings * episodes,
    )
    if trainings == 1:
        by_training = 0.0
    total = by_training + by_episode + rest
    share = by_training / total
    freedom = max(trainings - 1, 1), episodes - 1
    quantiles = [
        stats.t.ppf(0.975, degrees) + stats.t.ppf(POWER, degrees) for degrees in freedom
    ]
    return float(np.sqrt(total) * np.dot((share, 1.0 - share), quantiles))


def table():
    """One line for each plant, scenario and rival of SFKD."""
    head = ["row − SFKD", "trainings", "episodes", "rest", *SIZES]
    lines = []
    rows = json.loads(MEASURED.read_text())["rows"]
    errors = {
        (row["vehicle"], row["scenario"], row["system"]): 1e3
        * np.reshape(row["rmse_episodes_m"], (len(row["seeds"]), -1))
        for row in rows
    }
    for (plant, scenario, system), values in errors.items():
        if system in (REFERENCE, "oracle"):
            continue
        spread = deviations(values - errors[plant, scenario, REFERENCE])
        found = [f"{detectable(spread, size):.1f}" for size in SIZES.values()]
        cells = [f"{plant}, {scenario.upper()}: {system}"]
        lines.append([*cells, *(f"{part:.2f}" for part in spread), *found])
    return markdown.table(head, lines)


def page(text):
    """The page with its table."""
    return markdown.filled(text, {"power": table()})


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
