"""Figures 1 and 2 of the paper, with what was driven here, on the kinematic car.

    python -m experiments.results figure1 [RUN]    condenses an episode of runs/RUN, by default table1
    python -m experiments.paper_figures            draws docs/figures/figure1.png and figure2.png

Both are drawn from the committed files figure1.json and figure2.json beside this one. They
show a few systems that one can tell apart; the tables have all of them.
"""

import json
from pathlib import Path

import numpy as np

from sfkd_jax.report import episodes, figures, style

HOME = Path(__file__).parent
PICTURES = HOME.parent / "docs" / "figures"
CAR = "kinematic"
SCENARIO = "s3"
SHOWN = ("sfkd", "koopman_mpc", "neural_ode", "icode_mppi", "oracle")


def condense_episode(folder, results):
    """The first stored episode of the systems that Figure 1 shows.

    Args:
        folder: of the comparison, in which its rows name their arrays.
        results: content of its results.json.

    Returns:
        Commits, period, friction and wind of every step, and a row a system.
    """
    rows = [
        row
        for row in results["rows"]
        if (row["vehicle"], row["scenario"]) == (CAR, SCENARIO)
        and row["system"] in SHOWN
        and row["sampling"] != "plain"
    ]
    stored = episodes.of_rows(folder, rows)
    stored.sort(key=lambda run: SHOWN.index(run.system))
    first = stored[0]
    for other in stored:
        np.testing.assert_array_equal(other.envs, first.envs)
    return {
        "commits": sorted({row["provenance"]["commit"] for row in rows}),
        "dt": first.dt,
        "friction": np.round(first.envs[:, 0], 3).tolist(),
        "wind_mps": np.round(first.envs[:, 1], 3).tolist(),
        "rows": [
            {
                "row": run.system,
                "lateral_mm": np.round(1e3 * run.lateral[0], 2).tolist(),
            }
            for run in stored
        ],
    }


def read(name):
    """A committed result."""
    return json.loads((HOME / f"{name}.json").read_text("utf-8"))


def figure1(document):
    """Lateral error, friction and wind over one run."""
    envs = np.column_stack([document["friction"], document["wind_mps"]])
    group = [
        episodes.Episodes(
            row={"system": row["row"]},
            dt=document["dt"],
            lateral=1e-3 * np.asarray(row["lateral_mm"])[None],
            states=None,
            envs=envs,
            path=None,
        )
        for row in document["rows"]
    ]
    figure = figures.first_episode(group)
    figure.axes[0].set_title("Lateral error in one run of S3, kinematic car")
    return figure


def figure2(document):
    """Lateral RMSE by the largest side force that nobody measures."""
    rows = [
        {
            "system": row["row"],
            "disturbed": [
                {
                    "force_n": run["force_n"],
                    "rmse_m": {"mean": 1e-3 * run["rmse_mm"]},
                }
                for run in row["forces"]
            ],
        }
        for row in document["rows"]
        if row["row"] in SHOWN
    ]
    rows.sort(key=lambda row: SHOWN.index(row["system"]))
    return figures.side_forces(rows)


def draw():
    """Draw both figures from their committed results."""
    style.save(PICTURES / "figure1.png", figure1, read("figure1"))
    style.save(PICTURES / "figure2.png", figure2, read("figure2"))


if __name__ == "__main__":
    draw()
