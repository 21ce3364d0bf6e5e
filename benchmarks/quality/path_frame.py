"""Write the tables and the figure of docs/results/path-frame.md from experiments/path_frame/ and experiments/tube_weight/.

python -m benchmarks.quality.path_frame [--root runs]: with --root, first take what both run.sh
left there.
"""

import argparse
import json
import shutil
from functools import reduce
from operator import getitem
from pathlib import Path

from benchmarks.markdown import put, table
from benchmarks.quality import path_figure

HOME = Path(__file__).resolve().parents[2]
KEPT = HOME / "experiments" / "path_frame"
WEIGHTS = HOME / "experiments" / "tube_weight"
CHOICES = Path(__file__).with_name("path_choices.json")
PAGE = HOME / "docs" / "results" / "path-frame.md"
PLANTS, SCENARIOS = ("dynamic", "kinematic"), ("s1", "s2", "s3")
NAMES = {
    "sfkd_path": "**SFKD**",
    "sfkd_path_no_contraction": "SFKD − contraction",
    "r2dn_path": "R2DN",
    "neural_ode_path": "Neural ODE",
    "law": "the law alone",
    "oracle": "oracle",
}
SHIPPED = [0.01]
"""`training.loss.tube`."""


def read(directory, name):
    """A committed document."""
    return json.loads((directory / f"{name}.json").read_text("utf-8"))


def rows_of(plant):
    """(system, scenario) -> row of the comparison on a plant."""
    result = read(KEPT, "results")["rows"]
    return {
        (row["system"], row["scenario"]): row
        for row in result
        if row["vehicle"] == plant
    }


def drive_options(plant):
    """RMSE of every row with its interval, and its difference to SFKD on the same
    episodes.
    """
    rows, lines = rows_of(plant), []
    for system, name in NAMES.items():
        mine = [
            rows[system, scenario]
            for scenario in SCENARIOS
            if (system, scenario) in rows
        ]
        if len(mine) == len(SCENARIOS):
            largest = f"{1e3 * max(row['max_deviation_m'] for row in mine):.0f}"
            lines.append(
                [
                    name,
                    *(millimetres(row["rmse_m"]) for row in mine),
                    *map(difference, mine),
                    largest,
                ]
            )
    heads = [f"{scenario.upper()} [mm]" for scenario in SCENARIOS]
    minus = [f"{scenario.upper()} minus SFKD [mm]" for scenario in SCENARIOS]
    return table([plant, *heads, *minus, "largest [mm]"], lines)


def millimetres(measure):
    """A mean with its 95 % interval."""
    low, high = (1e3 * end for end in measure["ci95"])
    return f"{1e3 * measure['mean']:.1f} ({low:.1f} to {high:.1f})"


def difference(row):
    """The paired difference to SFKD; * where SFKD is better for sure, † where it is
    worse.
    """
    result = row["difference_to_sfkd"]
    if result is None:
        return "–"
    low, high = result["ci95"]
    mark = " *" if low > 0 else " †" if high < 0 else ""
    return f"{1e3 * result['mean']:+.2f} ({1e3 * low:+.2f} to {1e3 * high:+.2f}){mark}".replace(
        "-", "−"
    )


def frames():
    """RMSE over that of the oracle of the same frame, in the paper's table and here."""
    paper = {
        (row["vehicle"], row["system"], row["scenario"]): row["ratio_to_oracle"]
        for row in read(HOME / "experiments" / "table1_closed_loop", "results")["rows"]
        if row["sampling"] == "feedback" and row["env"] == "measured"
    }
    lines = []
    for plant in PLANTS:
        here = rows_of(plant)
        for system, name in NAMES.items():
            result = [
                paper.get((plant, system.replace("_path", ""), scenario))
                for scenario in SCENARIOS
            ]
            if system != "oracle" and None not in result:
                result += [
                    here[system, scenario]["ratio_to_oracle"] for scenario in SCENARIOS
                ]
                lines.append(
                    [f"{plant}, {name}", *(f"{value:.2f}" for value in result)]
                )
    heads = [
        f"{scenario.upper()}, {frame}"
        for frame in ("body", "path")
        for scenario in SCENARIOS
    ]
    return table(["", *heads], lines)


def claims():
    """Prediction without feedback, and what is certified, of every row that learns."""
    lines = []
    for plant in PLANTS:
        rows = rows_of(plant)
        for system, name in NAMES.items():
            row = rows.get((system, "s3"))
            if row is None or not row["params"]:
                continue
            ahead = [
                f"{1e3 * row['open_loop_rmse_m'][step]:.2f}" for step in ("1", "20")
            ]
            lines.append(
                [f"{plant}, {name}", *ahead, *tubes(plant, system), row["params"]]
            )
    heads = ["", "e_y 1 ahead [mm]", "e_y 20 ahead [mm]", "α", *TUBES, "parameters"]
    return table(heads, lines)


TUBES = {
    "tube, 5 s drives, for ever [m]": ("tube", "for_ever"),
    "tube, class, followed [m]": ("bounds", "followed_position"),
    "corridor [m]": ("corridor_m",),
}
"""Head of a column -> where it lies in an entry of tubes.json."""


def tubes(plant, system, weight=SHIPPED):
    """α and the certified tubes of a policy, in the order of TUBES; dashes where
    nothing is certified.
    """
    made = (plant, system, weight)
    result = [
        one
        for one in read(KEPT, "tubes")
        if (one["vehicle"], one["system"], one["weight"]) == made
    ]
    if not result or result[0]["alpha"] is None:
        return ["–"] * (1 + len(TUBES))
    lengths = [reduce(getitem, path, result[0]) for path in TUBES.values()]
    return [f"{value:.3f}" for value in (result[0]["alpha"], *lengths)]


def weights():
    """What a larger weight of the tube buys and costs."""
    lines = []
    for plant, weight, rows in weighed():
        ahead = f"{1e3 * rows['s3']['open_loop_rmse_m']['20']:.2f}"
        certified = tubes(plant, "sfkd_path", [weight] if weight else [])
        lines.append(
            [
                plant,
                f"{weight:g}",
                ahead,
                *certified,
                *(millimetres(row["rmse_m"]) for row in rows.values()),
            ]
        )
    return table(
        [
            "",
            "weight",
            "e_y 20 ahead [mm]",
            "α",
            *TUBES,
            *(f"{name.upper()} [mm]" for name in rows),
        ],
        lines,
    )


def weighed():
    """(plant, weight, scenario -> row), the weights ascending."""
    result = {}
    for row in read(WEIGHTS, "results")["rows"]:
        result.setdefault((row["vehicle"], weight_of(row)), {})[row["scenario"]] = row
    order = sorted(result, key=lambda entry: (PLANTS.index(entry[0]), entry[1]))
    return [(*entry, dict(sorted(result[entry].items()))) for entry in order]


def weight_of(row):
    """The weight by the name of its variation; a row without one has what ships."""
    return (
        SHIPPED[0] if row["variation"] is None else float(row["variation"].split()[-1])
    )


def choices():
    """What the rivals were tried with."""
    result = json.loads(CHOICES.read_text("utf-8"))
    lines = []
    for name, entry in result.items():
        plant, steps, model, *overrides = name.split()
        shown = [f"{entry[part]:.4f}" for part in ("error", "prediction", "one_step")]
        lines.append([model, f"`{' '.join(overrides)}`", *shown, f"{plant}, {steps}"])
    return table(
        [
            "model",
            "settings",
            "validation error",
            "of it free-running",
            "one step",
            "plant, steps",
        ],
        lines,
    )


def take(root):
    """Copy both results, and of every certificate what the tables show."""
    for saved in (KEPT, WEIGHTS):
        shutil.copyfile(root / saved.name / "results.json", saved / "results.json")
    result = []
    for settings in sorted((root / KEPT.name).glob("*/*/**/settings.json")):
        made, file = (
            json.loads(settings.read_text()),
            settings.with_name("certificate.json"),
        )
        if not file.exists():
            continue
        certificate = json.loads(file.read_text())
        corridor = certificate.get("corridor") or {}
        entry = {
            "vehicle": made["vehicle"]["name"],
            "system": made["model"]["system"],
            "seed": made["seed"],
        }
        entry |= {
            "weight": made["training"]["loss"]["tube"],
            "alpha": certificate.get("alpha"),
        }
        entry |= {"reason": certificate.get("reason"), "tube": None}
        if certificate.get("outputs"):
            entry["tube"] = certificate["outputs"]["position"]["tube"]
        result.append(
            entry
            | {
                name: corridor.get(name)
                for name in ("bounds", "corridor_m", "coverage")
            }
        )
    (KEPT / "tubes.json").write_text(json.dumps(result, indent=1) + "\n", "utf-8")


TABLES = {
    "dynamic": lambda: drive_options("dynamic"),
    "kinematic": lambda: drive_options("kinematic"),
    "frames": frames,
    "claims": claims,
    "choices": choices,
    "weights": weights,
}


def main():
    """Take, draw, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--root", type=Path, default=None, help="where both run.sh left their runs"
    )
    root = parser.parse_args().root
    if root:
        take(root)
    put(PAGE, {name: build() for name, build in TABLES.items()})
    bounds = {
        (one["vehicle"], one["system"], *one["weight"]): one["bounds"]
        for one in read(KEPT, "tubes")
    }
    path_figure.draw(weighed(), bounds)


if __name__ == "__main__":
    main()
