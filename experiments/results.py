"""The committed results of comparisons, and the tables of docs/results.md.

    python -m experiments.results benchmark [RUN]  condenses runs/RUN/results.json
    python -m experiments.results bench3 [RUN]     adds the rows of a run to bench3.jsonl
    python -m experiments.results figure1 [RUN]    keeps an episode of runs/RUN (table1)
    python -m benchmarks.pages                     writes the tables
    python -m experiments.paper_figures            draws the figures

RUN is by default the name before it. A file has one line for each row. A row keeps the
lateral RMSE of every episode of every training, from which the intervals are computed here.
Holm's correction needs the whole comparison, so that `compare` made it. Condense results
with the code that drove them: every row is stamped with the code of this moment.
"""

import argparse
import json
import re
from functools import partial
from operator import itemgetter
from pathlib import Path

import numpy as np
import yaml

from benchmarks import digest, stamp, write
from benchmarks.tables import measured, table
from experiments import paper_figures
from sfkd_jax import evaluation
from sfkd_jax.report import style

HOME = Path(__file__).parent
TABLE1 = HOME.parent / "conf" / "comparison" / "table1.yaml"
BENCHMARKS = ("benchmark", "table1", "figure2", "corridor")
FIGURE1 = "figure1"
VEHICLES = {
    "kinematic": "kinematic",
    "kinematic_stiff": "stiff kinematic",
    "dynamic": "dynamic",
}
"""Car -> its name in a table."""
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
"""Of the tests whose results the tables mark."""
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


def condense(results, policy=None):
    """What is kept of the results of `compare` or `evaluate`: short settings and rows.

    Args:
        results: content of results.json.
        policy: file of the policy that drove in all rows; None if each row has a model of
            its own.
    """
    fields = stamp()
    if policy is not None:
        fields["weights"] = digest(policy)
    protocol = results.get("config", {}).get("evaluation", {})
    made_by = {row.get("provenance", {}).get("commit") for row in results["rows"]}
    return {
        "commits": sorted(made_by - {None}),
        "seed": protocol.get("seed"),
        "episode_s": results["rows"][0]["episode_s"],
        "rows": [_row(row) | fields for row in results["rows"]],
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
    name = kept["row"]
    errors = np.asarray(kept["rmse_mm"])
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
        **stamp(),
    }


def _row(row):
    """One line: who drove where, every episode's RMSE [mm] by training, extremes."""
    seeds = row["seeds"]
    errors = 1e3 * np.asarray(row["rmse_episodes_m"]).reshape(len(seeds), -1)
    compared = row["difference_to_sfkd"] or {}
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
        "p_holm": compared.get("p_holm"),
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


def mean_error(row, reference):
    """Mean error [mm]; † better, * worse than SFKD after Holm's correction."""
    if row["left_the_lane"]:
        return _left_the_lane(row)
    text = f"{np.mean(row['rmse_mm']):.1f}"
    if row["p_holm"] is not None and row["p_holm"] < LEVEL:
        text += " \\*" if difference(row, reference)["mean"] > 0 else " †"
    return measured(text, row)


def half_width(row):
    """Half of the 95 % interval of the mean error [mm]."""
    if row["left_the_lane"]:
        return "–"
    _, (low, high) = evaluation.mean_interval(np.asarray(row["rmse_mm"]))
    return measured(f"{(high - low) / 2:.1f}", row)


def _left_the_lane(row):
    """What a table says in place of a mean over runs that did not stay in their lane."""
    count = row["left_the_lane"]
    everywhere = count == np.size(row["rmse_mm"])
    text = "leaves the lane" if everywhere else f"{count} runs leave the lane"
    return measured(text, row)


def systems_table(rows, columns):
    """Mean errors, and in a second table how well they are known.

    Args:
        rows: row -> column -> results.
        columns: column -> its heading.
    """
    means, widths = [], []
    for label, driven in rows.items():
        mean_line, width_line = [LABELS[label]], [LABELS[label]]
        for place in columns:
            row = driven.get(place)
            mean_line.append(mean_error(row, rows["sfkd"][place]) if row else "–")
            width_line.append(half_width(row) if row else "–")
        means.append([*mean_line, _trainings(driven)])
        widths.append(width_line)
    headings = columns.values()
    parts = (
        table(["mean lateral RMSE [mm]", *headings, "trainings"], means),
        table(["half width of the 95 % interval [mm]", *headings], widths),
    )
    return "\n\n".join(parts)


def _trainings(driven):
    """How often the model of a row was trained, where it was trained least."""
    learned = any(row["parameters"] for row in driven.values())
    return min(len(row["seeds"]) for row in driven.values()) if learned else "–"


def paper_table():
    """The paper's rows: what it prints beside what was driven here, kinematic plant."""
    controllers = ("mppi", "koopman_mpc")
    settings = yaml.safe_load(TABLE1.read_text("utf-8"))["paper"]
    printed_at = {
        scenario: settings["columns"].index(f"rmse_{scenario}_m")
        for scenario in ("s2", "s3")
    }
    driven = {name: of_scenario("table1", name, controllers) for name in printed_at}
    lines = []
    for label in driven["s3"]:
        line = [LABELS[label]]
        printed = settings.get(label)
        for scenario, place in printed_at.items():
            row = driven[scenario][label]["kinematic"]
            line.append(measured(f"{np.mean(row['rmse_mm']):.1f}", row))
            line.append(f"{1e3 * printed[place]:.0f}" if printed else "–")
        lines.append(line)
    heads = ["lateral RMSE [mm]", "S2, here", "S2, paper", "S3, here", "S3, paper"]
    return table(heads, lines)


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
        policy = folder / "policy.safetensors"
        document = condense(results, policy if policy.exists() else None)
    write(HOME / f"{options.name}.json", document, document.pop("rows"))


if __name__ == "__main__":
    main()
