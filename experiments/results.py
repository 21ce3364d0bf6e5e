"""Results in the repository: one JSON a benchmark, one line a row, and the tables of docs/results.md.

    python -m experiments.results benchmark [RUN]    takes runs/RUN/results.json; bench3 adds its rows
    python -m experiments.results figure1 [RUN]      keeps one episode of runs/RUN, by default table1
    python -m benchmarks.pages                       writes the tables
    python -m experiments.paper_figures              draws the figures

A row keeps the lateral RMSE of every episode of every training, from which intervals are
computed here; Holm's correction needs the whole comparison and was made by `compare`.
"""

import argparse
import json
import re
from functools import partial
from operator import itemgetter
from pathlib import Path

import numpy as np
import yaml

from benchmarks import write
from experiments import paper_figures
from sfkd_jax import evaluation
from sfkd_jax.report import style

HOME = Path(__file__).parent
TABLE1 = HOME.parent / "conf" / "comparison" / "table1.yaml"
BENCHMARKS = ("benchmark", "table1", "figure2", "corridor")
FIGURE1 = "figure1"
CARS = "kinematic", "kinematic_stiff", "dynamic"
VEHICLES = dict(zip(CARS, ("kinematic", "stiff kinematic", "dynamic"), strict=True))
LABELS = {name: look.label for name, look in style.SYSTEMS.items()} | {
    "sfkd_no_fiber": "SFKD without e (− fiber)",
    "icode_extrinsic": "ICODE, e extrinsic",
    "icode_mppi_extrinsic": "ICODE-MPPI, e extrinsic",
    "nominal": "Nominal bicycle",
    "law_learned": "Law of the learned model alone",
    "law_true": "Law of the true car alone",
    "law_nominal": "Law of the bicycle alone",
    "sfkd_alone": "SFKD without g",
}
"""Row of a comparison -> its name in a table, in the order of the tables."""
LEVEL = 0.05
BENCH3 = HOME / "bench3.jsonl"
PATH_ROWS = (
    *("sfkd", "sfkd_alone", "sfkd_no_contraction"),
    *("neural_ode", "icode", "control_synth", "nominal", "oracle"),
    *("law_learned", "law_true", "law_nominal", "law_stanley", "law_pure_pursuit"),
)
CELL = itemgetter("row", "frame", "plant", "scenario", "samples")
SAMPLES = 1500  # of a plan, in the tables
BENCH3_KEEPS = (
    "seeds",
    "parameters",
    "alpha",
    "largest_mm",
    "left_the_lane",
    "rmse_mm",
    "p_holm",
)


def condense(results):
    """What is kept of the results of `compare`: settings in short, rows in short.

    Args:
        results: content of results.json.
    """
    protocol = results.get("config", {}).get("evaluation", {})
    made_by = {row.get("provenance", {}).get("commit") for row in results["rows"]}
    return {
        "commits": sorted(made_by - {None}),
        "seed": protocol.get("seed"),
        "episode_s": results["rows"][0]["episode_s"],
        "rows": [_row(row) for row in results["rows"]],
    }


def add_to_bench3(results):
    """Rows of sfkd-bench-3, which is driven in parts, for those of before or beside."""
    samples = results["config"]["controller"]["mppi"]["num_samples"]
    added = [_bench3_row(row, samples) for row in results["rows"]]
    rows = {CELL(row): row for row in [*bench3(), *added]}
    for row in rows.values():
        oracle = rows.get(("oracle", *CELL(row)[1:4], SAMPLES))
        row["minus_oracle_mm"] = oracle and round(difference(row, oracle)["mean"], 3)
    lines = (json.dumps(row, ensure_ascii=False) for row in rows.values())
    BENCH3.write_text("\n".join([*lines, ""]), "utf-8")


def bench3():
    """The lines of sfkd-bench-3."""
    return [json.loads(line) for line in BENCH3.read_text("utf-8").splitlines()]


def along_path():
    """Row -> (plant, scenario) -> its line, in the order of the table."""
    found = {label: {} for label in PATH_ROWS}
    for row in bench3():
        if row["frame"] == "path" and row["samples"] in (1, SAMPLES):
            found[row["row"]][row["plant"], row["scenario"]] = row
    return found


def _bench3_row(row, samples):
    """One line: row, plant and scenario, errors by training and episode [mm]."""
    kept = _row(row)
    name, errors = kept["row"], np.asarray(kept["rmse_mm"])
    return {
        "row": {"law": "law_learned", "law_plant": "law_true"}.get(name, name),
        "frame": "path" if "path" in kept["controller"] else "body",
        "plant": kept["vehicle"],
        "scenario": kept["scenario"],
        "samples": 1 if name.startswith("law") else samples,
        "trainings": len(kept["seeds"]) if kept["parameters"] else 0,
        "interval_mm": np.round(evaluation.mean_interval(errors)[1], 3).tolist(),
        "commit": row["provenance"]["commit"],
        **{name: kept[name] for name in BENCH3_KEEPS},
    }


def _row(row):
    """One line: who drove where, every episode's RMSE [mm] by training, extremes."""
    seeds = row["seeds"]
    errors = 1e3 * np.asarray(row["rmse_episodes_m"]).reshape(len(seeds), -1)
    difference = row["difference_to_sfkd"] or {}
    controller = row["controller"]
    if controller == "mppi" and row["sampling"] == "plain":
        # The option keeps the name of the planner that it changes.
        controller = "mppi_plain"
    kept = {
        "row": re.sub("_path", "", row["system"]),
        "vehicle": row["vehicle"],
        "scenario": row["scenario"],
        "controller": controller,
        "seeds": seeds,
        "parameters": row["params"],
        "alpha": row["alpha"],
        "p_holm": difference.get("p_holm"),
        "largest_mm": round(1e3 * row["max_deviation_m"], 1),
        "steering_rad_per_s": round(row["smoothness_rad_per_s"], 4),
        "left_the_lane": row["departures"],
        "rmse_mm": np.round(errors, 3).tolist(),
    }
    if row.get("disturbed"):
        # Figure 2: side forces that nobody measures.
        kept["forces"] = [
            {
                "force_n": one["force_n"],
                "rmse_mm": round(1e3 * one["rmse_m"]["mean"], 3),
            }
            for one in row["disturbed"]
        ]
    return kept


def read(name):
    """The results of a benchmark."""
    return json.loads((HOME / f"{name}.json").read_text("utf-8"))


def of_scenario(name, scenario, controllers):
    """Row -> vehicle -> its results on one scenario, in the order of the tables."""
    found = {label: {} for label in LABELS}
    for row in read(name)["rows"]:
        if row["scenario"] == scenario and row["controller"] in controllers:
            found.setdefault(row["row"], {})[row["vehicle"]] = row
    return {label: rows for label, rows in found.items() if rows}


def difference(row, reference):
    """Mean of row − reference over equal episodes, with its 95 % interval [mm]."""
    errors = (np.asarray(one["rmse_mm"]) for one in (row, reference))
    return evaluation.paired_difference(*errors)


def cell(row, reference):
    """Mean and 95 % interval [mm]; † better, * worse than SFKD after Holm's correction."""
    errors = np.asarray(row["rmse_mm"])
    if left := row["left_the_lane"]:
        return f"{left} of {errors.size} leave the lane"
    mean, (low, high) = evaluation.mean_interval(errors)
    mark = ""
    if row["p_holm"] is not None and row["p_holm"] < LEVEL:
        mark = " \\*" if difference(row, reference)["mean"] > 0 else " †"
    return f"{mean:.1f} ({low:.1f} to {high:.1f}){mark}"


def markdown(heads, rows):
    """A table in Markdown; a bar in a cell does not end it."""
    lines = [heads, ["---"] * len(heads), *rows]
    escaped = ([str(cell).replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in escaped)


def systems_table(rows, columns):
    """Errors with intervals: row -> column -> results, and column -> its head."""
    lines = []
    for label, driven in rows.items():
        driven = {at: row for at, row in driven.items() if at in columns}
        cells = [
            cell(driven[at], rows["sfkd"][at]) if at in driven else "–"
            for at in columns
        ]
        trainings = min(len(row["seeds"]) for row in driven.values())
        learned = next(iter(driven.values()))["parameters"]
        lines.append([LABELS[label], *cells, trainings if learned else "–"])
    return markdown(["lateral RMSE [mm]", *columns.values(), "trainings"], lines)


def paper_table():
    """The paper's rows: what it prints beside what was driven here, kinematic plant."""
    controllers = ("mppi", "koopman_mpc")
    settings = yaml.safe_load(TABLE1.read_text("utf-8"))["paper"]
    at = [settings["columns"].index(f"rmse_{name}_m") for name in ("s2", "s3")]
    on = {name: of_scenario("table1", name, controllers) for name in ("s2", "s3")}
    lines = []
    for label in on["s3"]:
        cells = []
        for number, driven in enumerate(on.values()):
            mean = np.mean(driven[label]["kinematic"]["rmse_mm"])
            printed = settings.get(label)
            shown = f"{1e3 * printed[at[number]]:.0f}" if printed else "–"
            cells += [f"{mean:.1f}", shown]
        lines.append([LABELS[label], *cells])
    heads = ["lateral RMSE [mm]", "S2, here", "S2, paper", "S3, here", "S3, paper"]
    return markdown(heads, lines)


BODY = partial(of_scenario, "benchmark", "s3", ("mppi", "koopman_mpc"))
PLACES = {
    (car, scenario): f"{car}, {scenario.upper()}"
    for car in ("kinematic", "dynamic")
    for scenario in ("s2", "s3")
}
TABLES = {
    "body": lambda: systems_table(BODY(), VEHICLES),
    "path": lambda: systems_table(along_path(), PLACES),
    "paper": paper_table,
}
"""Place in docs/results.md -> its table."""


def main():
    """Take the results of a comparison."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", choices=(BENCH3.stem, FIGURE1, *BENCHMARKS))
    parser.add_argument("run", nargs="?", help="folder below runs/; the same name")
    options = parser.parse_args()
    # Figure 1 shows an episode of the comparison that makes the paper's table.
    usual = "table1" if options.name == FIGURE1 else options.name
    folder = HOME.parent / "runs" / (options.run or usual)
    results = json.loads((folder / "results.json").read_text("utf-8"))
    if options.name == BENCH3.stem:
        return add_to_bench3(results)
    if options.name == FIGURE1:
        document = paper_figures.condense_episode(folder, results)
    else:
        document = condense(results)
    write(HOME / f"{options.name}.json", document, document.pop("rows"))


if __name__ == "__main__":
    main()
