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
from benchmarks.quality.protocol2_tuning import settings_of
from sfkd_jax import evaluation
from sfkd_jax.pipeline import grid

PAGE = ROOT / "docs" / "results" / "protocol-2.md"
MEASURED = ROOT / "experiments" / "seeds" / "results.json"
SIZES = {"1 x 6": (1, 6), "3 x 16": (3, 16), "10 x 200": (10, 200)}
"""Trainings and episodes of protocol 1, of this one, and with an accelerator."""
MARKED = (3, 16)
PART = "protocol2"
"""In the body frame, as the deviations; along a path they are far smaller."""
POWER = 0.8
REFERENCE = "sfkd"


def deviations(difference):
    """Standard deviations of trainings, of episodes and of the rest."""
    trainings, episodes = difference.shape
    of_trainings, of_episodes, rest = evaluation.mean_squares(difference)
    parts = (of_trainings - rest) / episodes, (of_episodes - rest) / trainings, rest
    return np.sqrt(np.maximum(parts, 0.0))


def detectable(spread, size, level=0.05):
    """The difference that is found with probability `POWER`.

    With one training its own deviation counts as part of the difference.

    Args:
        spread: of `deviations`.
        size: trainings and episodes.
        level: of the test; 5 % over the size of a family at Holm's first step.
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
        stats.t.ppf(1.0 - level / 2, degrees) + stats.t.ppf(POWER, degrees)
        for degrees in freedom
    ]
    return float(np.sqrt(total) * np.dot((share, 1.0 - share), quantiles))


def family(part):
    """The number of differences to SFKD in a part."""
    cells = grid.list_cells(settings_of(f"+experiment={part}")["comparison"])
    rows = {cell._replace(seed=0) for cell in cells}
    return sum(row.label not in ("sfkd", "sfkd_path") for row in rows)


def table():
    """One line for each plant, scenario and rival of SFKD."""
    head = ["row − SFKD", "trainings", "episodes", "rest", *SIZES]
    size = family(PART)
    head.append(f"mark, {size}")
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
        found = [f"{detectable(spread, one):.1f}" for one in SIZES.values()]
        found.append(f"{detectable(spread, MARKED, 0.05 / size):.1f}")
        cells = [f"{plant}, {scenario.upper()}: {system}"]
        lines.append([*cells, *(f"{part:.2f}" for part in spread), *found])
    return markdown.table(head, lines)


def page(text):
    """The page with its table."""
    return markdown.filled(text, {"power": table()})


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8")), "utf-8")
