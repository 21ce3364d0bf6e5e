"""Write what sfkd-bench-2 found into README.md and docs/results/index.md.

python -m benchmarks.quality.protocol2_page
From the results on S3 in experiments/protocol2 and experiments/protocol2_path. A part
that is not there yet is left alone; one whose cells are not all there is refused.
"""

import json
from collections import Counter

import numpy as np

from benchmarks.harness import ROOT
from benchmarks.markdown import put, table
from benchmarks.quality.protocol2_tuning import settings_of
from sfkd_jax.evaluation.formats import interval, millimetres, number
from sfkd_jax.pipeline import grid
from sfkd_jax.reporting.style import family, label, rank

LEVEL = 0.05
"""A difference counts if its p-value with Holm's correction is smaller."""
SCENARIO = "s3"
VEHICLES = {
    "kinematic": "kinematic",
    "kinematic_stiff": "kinematic, constant stiffness",
    "dynamic": "dynamic",
}
NOT_TRAINED = ("oracle", "nominal", "law")
README = ROOT / "README.md"
IN_SHORT = ROOT / "docs" / "results" / "index.md"
PATH, BODY = ("protocol2_path", "law"), ("protocol2", "feedback")
"""Part of the benchmark, and the sampling that its table shows."""


def results_of(part):
    """The file of a part."""
    return ROOT / "experiments" / part / "results.json"


def missing(part, rows):
    """Cells of a part that no row covers, and those that it should not have."""
    comparison = settings_of(f"+experiment={part}")["comparison"]
    asked = Counter(
        (cell.vehicle, cell.label, cell.controller, cell.scenario)
        for cell in grid.list_cells(comparison)
    )
    names = ("vehicle", "system", "controller", "scenario")
    found = {tuple(row[name] for name in names): len(row["seeds"]) for row in rows}
    return sorted(set(asked.items()) ^ set(found.items()))


def rows_of(part, sampling):
    """System -> vehicle -> its row on S3, in the order of every table.

    Raises:
        SystemExit: cells are missing.
    """
    rows = json.loads(results_of(part).read_text("utf-8"))["rows"]
    if gaps := missing(part, rows):
        raise SystemExit(
            f"{part}: {len(gaps)} rows are not complete, such as {gaps[0]}"
        )
    found = {}
    for row in rows:
        if (row["scenario"], row["sampling"] or sampling) == (SCENARIO, sampling):
            found.setdefault(family(row["system"]), {})[row["vehicle"]] = row
    return dict(sorted(found.items(), key=lambda entry: rank(entry[0])))


def verdict(row):
    """1 if a row is worse than SFKD, −1 if it is better, 0 if that is undecided."""
    record = row["difference_to_sfkd"] or {}
    if record.get("p_holm", 1.0) >= LEVEL:
        return 0
    return 1 if record["mean"] > 0 else -1


def worst(row):
    """The worst episode [m], averaged over trainings."""
    errors = np.reshape(row["rmse_episodes_m"], (len(row["seeds"]), -1))
    return float(np.mean(errors.max(axis=1)))


def errors(rows):
    """Mean RMSE with its interval, then the worst episode, of every row and plant."""
    head = ["S3, RMSE [mm] (95 %); worst", *VEHICLES.values()]
    lines = []
    for system, driven in rows.items():
        learned = system not in NOT_TRAINED
        sizes = [row["params"] for row in driven.values()] if learned else []
        cells = [
            label(system),
            *(error_of(driven[vehicle]) for vehicle in VEHICLES),
            min(len(row["seeds"]) for row in driven.values()) if learned else "–",
            f"{min(sizes):,} to {max(sizes):,}" if learned else "–",
        ]
        lines.append(cells)
    return table([*head, "trainings", "parameters"], lines)


def error_of(row):
    """The cell of a row: marked where it is better (†) or worse (*) than SFKD."""
    bounds = interval([1e3 * bound for bound in row["rmse_m"]["ci95"]], 1)
    mark = {1: " *", 0: "", -1: " †"}[verdict(row)]
    shown = f"{millimetres(row['rmse_m'])} ({bounds}){mark}"
    return f"{shown}; {millimetres(worst(row), 0)}"


def claim(rows):
    """SFKD beside the oracle on every plant, then all rows that differ from it."""
    lines = []
    for vehicle, words in VEHICLES.items():
        row, gap = rows["sfkd"][vehicle], rows["oracle"][vehicle]["difference_to_sfkd"]
        low, high = (-1e3 * bound for bound in reversed(gap["ci95"]))
        lines.append(
            f"{number(-1e3 * gap['mean'], 1)} mm ({number(low, 1)} to {number(high, 1)}) "
            f"behind the oracle's {millimetres(rows['oracle'][vehicle]['rmse_m'])} mm, "
            f"worst episode {millimetres(worst(row), 0)} mm ({words})"
        )
    return f"SFKD is {'; '.join(lines)}. {sides(rows)}"


def sides(rows):
    """The rows that are better than SFKD, and those that are worse."""
    found = {-1: [], 1: []}
    for system, driven in rows.items():
        for vehicle, row in driven.items():
            side = 0 if system in ("oracle", "sfkd") else verdict(row)
            if side:
                gap = number(abs(1e3 * row["difference_to_sfkd"]["mean"]), 1)
                words = f"{label(system)} ({VEHICLES[vehicle]}, {gap} mm)"
                found[side].append(words)
    better, worse = ("; ".join(found[side]) or "none" for side in (-1, 1))
    return f"Better than SFKD: {better}. Worse: {worse}."


def pages():
    """Page -> marker -> its table or sentences, of the parts that are there."""
    made = {README: {}, IN_SHORT: {}}
    if results_of(PATH[0]).exists():
        rows = rows_of(*PATH)
        made[README] |= {"bench": claim(rows)}
        made[IN_SHORT] |= {"bench path": errors(rows), "bench claim": claim(rows)}
    if results_of(BODY[0]).exists():
        rows = rows_of(*BODY)
        made[IN_SHORT] |= {"bench body": errors(rows), "bench sides": sides(rows)}
    return made


def main():
    """Write the pages."""
    for page, made in pages().items():
        put(page, made)


if __name__ == "__main__":
    main()
