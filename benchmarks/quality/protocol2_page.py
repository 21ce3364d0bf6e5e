"""Write what sfkd-bench-2 found into README.md and docs/results/index.md.

python -m benchmarks.quality.protocol2_page
From the results in experiments/protocol2 and experiments/protocol2_path. A part
that is not there yet is left alone; one whose cells are not all there is refused. A part
may be driven for the first trainings or for some of its rows only, and more of its rows
may be trained once than the protocol asks: what is said of it then ends with what is left.
"""

import json
from collections import Counter

import numpy as np

from benchmarks.harness import ROOT
from benchmarks.leaderboard.entry import check_settings, worst_episode
from benchmarks.markdown import put, table
from benchmarks.quality.protocol2_tuning import settings_of
from sfkd_jax.evaluation.formats import interval, millimetres, number
from sfkd_jax.pipeline import grid
from sfkd_jax.reporting.style import family, label, rank

LEVEL = 0.05
"""A difference counts if its p-value with Holm's correction is smaller."""
SHOWN = ("s1", "s2", "s3")
"""Scenarios of the tables."""
VEHICLES = {
    "kinematic": "kinematic",
    "kinematic_stiff": "stiff kinematic",
    "dynamic": "dynamic",
}
SHORT = VEHICLES | {"kinematic_stiff": "stiff"}
NOT_TRAINED = ("oracle", "nominal", "law")
BESIDE = {
    "law": "The law alone, which knows the true plant and learns nothing,",
    "sfkd_no_contraction": "SFKD without its contraction bound",
    "sfkd_soft": "SFKD with the soft hinge instead of the bound",
    "sfkd_no_transport": "SFKD without transport",
    "sfkd_no_residual": "SFKD without its residual",
    "sfkd_no_fiber": "SFKD that does not observe e",
}
"""Rows that say what planning brings and what the parts of SFKD do."""
SMALLEST = 5e-5
"""Differences that the first page names [m]; smaller ones round to 0.0 mm."""
NOT_MODELS = ("oracle", "sfkd", *BESIDE)
README = ROOT / "README.md"
IN_SHORT = ROOT / "docs" / "results" / "index.md"
PATH, BODY = ("protocol2_path", "law"), ("protocol2", "feedback")
"""Part of the benchmark, and the sampling that its table shows."""


def results_of(part):
    """The file of a part."""
    return ROOT / "experiments" / part / "results.json"


def document_of(part):
    """The results of a part."""
    return json.loads(results_of(part).read_text("utf-8"))


def protocol_of(part):
    """Settings that the protocol asks for."""
    return settings_of(f"+experiment={part}")


def collected(part, results):
    """The protocol's comparison, cut to the rows and the trainings of the results.

    Raises:
        SystemExit: other episodes, other trainings than the protocol's first ones, cells
            of other settings, or no row to compare with.
    """
    asked, used = protocol_of(part), results["config"]
    try:
        check_settings(used, asked)
    except ValueError as reason:
        raise SystemExit(f"{part}: {reason}") from None
    comparison, seeds = asked["comparison"], used["comparison"]["seeds"]
    once = comparison["trained_once"]
    once = once + [row for row in used["comparison"]["trained_once"] if row not in once]
    if not seeds or seeds != comparison["seeds"][: len(seeds)]:
        first = comparison["seeds"]
        raise SystemExit(f"{part}: seeds {seeds} are not the first of {first}")
    driven = {row["system"] for row in results["rows"]}
    labels = [label for label in comparison["rows"] if label in driven]
    if not {"oracle", "sfkd"} <= set(map(family, labels)):
        raise SystemExit(f"{part}: there is no row of SFKD or of the oracle")
    return comparison | {"seeds": seeds, "trained_once": once, "only": labels}


def missing(part, results):
    """Cells of rows that are not complete, and those that they should not have."""
    asked = Counter(
        (cell.vehicle, cell.label, cell.controller, cell.scenario)
        for cell in grid.list_cells(collected(part, results))
    )
    names = ("vehicle", "system", "controller", "scenario")
    found = {
        tuple(row[name] for name in names): len(row["seeds"]) for row in results["rows"]
    }
    return sorted(set(asked.items()) ^ set(found.items()))


def left(part):
    """Rows and trainings of the protocol that are not driven yet, in sentences."""
    asked, now = protocol_of(part)["comparison"], collected(part, document_of(part))
    rows = [label(row) for row in asked["rows"] if row not in now["only"]]
    sentences = [f"Not driven yet: {'; '.join(rows)}."] if rows else []
    once = [
        label(row) for row in now["trained_once"] if row not in asked["trained_once"]
    ]
    if once:
        sentences.append(
            f"Trained once so far, not {len(asked['seeds'])} times: {'; '.join(once)}."
        )
    if len(now["seeds"]) < len(asked["seeds"]):
        sentences.append(
            f"Trainings so far: {len(now['seeds'])} of {len(asked['seeds'])}; intervals "
            "and marks are about other episodes alone."
        )
    return " ".join(sentences)


def rows_of(part, sampling):
    """System -> vehicle -> scenario -> its row, in the order of every table.

    Raises:
        SystemExit: cells are missing.
    """
    document = document_of(part)
    if gaps := missing(part, document):
        raise SystemExit(
            f"{part}: {len(gaps)} rows are not complete, such as {gaps[0]}"
        )
    found = {}
    for row in document["rows"]:
        if (row["sampling"] or sampling) == sampling:
            driven = found.setdefault(family(row["system"]), {})
            driven.setdefault(row["vehicle"], {})[row["scenario"]] = row
    return dict(sorted(found.items(), key=lambda entry: rank(entry[0])))


def verdict(row):
    """1 if a row is worse than SFKD, −1 if it is better, 0 if that is undecided."""
    record = row["difference_to_sfkd"] or {}
    if record.get("p_holm", 1.0) >= LEVEL:
        return 0
    return 1 if record["mean"] > 0 else -1


def errors(rows):
    """Mean RMSE with its interval, then the worst episode, of every row and plant."""
    head = ["RMSE [mm] (95 %); worst", *VEHICLES.values()]
    lines = []
    for scenario in SHOWN:
        for system, driven in rows.items():
            learned = system not in NOT_TRAINED
            about = [driven[vehicle][scenario] for vehicle in VEHICLES]
            sizes = [row["params"] for row in about] if learned else []
            cells = [
                f"{scenario.upper()}: {label(system)}",
                *map(error_of, about),
                min(len(row["seeds"]) for row in about) if learned else "–",
                f"{min(sizes):,} to {max(sizes):,}" if learned else "–",
            ]
            lines.append(cells)
    return table([*head, "trainings", "parameters"], lines)


def error_of(row):
    """The cell of a row: marked where it is better (†) or worse (*) than SFKD."""
    bounds = interval([1e3 * bound for bound in row["rmse_m"]["ci95"]], 1)
    mark = {1: " *", 0: "", -1: " †"}[verdict(row)]
    shown = f"{millimetres(row['rmse_m'])} ({bounds}){mark}"
    return f"{shown}; {millimetres(worst_episode(row), 0)}"


def claim(rows):
    """What a part found, in a few bullets.

    SFKD beside the oracle where it is furthest behind on every plant, the extremes, how
    its trainings differ, the rows of `BESIDE`, then the other models.
    """
    (worst, its_worst), (peak, its_peak) = (
        extremes(rows, of) for of in (worst_episode, lambda row: row["max_deviation_m"])
    )
    bullets = [
        f"Where SFKD is furthest behind the oracle [mm]: {gaps(rows)}.",
        f"Worst RMSE of an episode: {worst} mm, the oracle's {its_worst} mm; "
        f"largest deviation at any time: {peak} mm, the oracle's {its_peak} mm.",
    ]
    bullets += trainings(rows, VEHICLES)
    bullets += [
        by_interval(who, rows[row]) for row, who in BESIDE.items() if row in rows
    ]
    bullets += sides({row: rows[row] for row in rows if row not in NOT_MODELS})
    return "\n".join(f"- {bullet}" for bullet in bullets)


def first_page(rows):
    """The same in short: SFKD beside the oracle, its trainings, and who is better."""
    worst, its_worst = extremes(rows, worst_episode)
    better = []
    for system, driven in rows.items():
        if system in ("oracle", "sfkd"):
            continue
        judge = apart if system in BESIDE else verdict
        places = places_of(
            driven,
            lambda row, judge=judge: (
                judge(row) == -1 and row["difference_to_sfkd"]["mean"] <= -SMALLEST
            ),
            names=SHORT,
            shown=lambda difference: number(-1e3 * difference["mean"], 1),
        )
        if places:
            better.append(f"{label(system)} on {', '.join(places)}")
    bullets = [
        f"Where SFKD is furthest behind the oracle [mm]: {gaps(rows, SHORT)}; worst "
        f"RMSE of an episode {worst}, the oracle's {its_worst}.",
        f"Better than SFKD [mm]: {'; '.join(better) or 'none'}.",
        *trainings(rows, SHORT),
    ]
    return "\n".join(f"- {bullet}" for bullet in bullets)


def gaps(rows, names=VEHICLES):
    """How far SFKD is behind the oracle where it is furthest behind, on every plant."""
    found = []
    for vehicle, words in names.items():
        driven = rows["oracle"][vehicle]
        scenario = min(
            driven, key=lambda one: driven[one]["difference_to_sfkd"]["mean"]
        )
        found.append(
            f"{size_of(driven[scenario]['difference_to_sfkd'])} of "
            f"{millimetres(driven[scenario]['rmse_m'])} on {words} {scenario.upper()}"
        )
    return ", ".join(found)


def trainings(rows, names):
    """A sentence about where SFKD's trainings differ most, if there are several.

    It has the error of each one and of each one without the contraction bound, and how
    many learned rows have a smaller mean error there: where trainings differ, even large
    differences are not marked.
    """
    several = {
        (vehicle, scenario): row["rmse_trainings_m"]
        for vehicle, one in rows["sfkd"].items()
        for scenario, row in one.items()
        if len(row["seeds"]) > 1
    }
    if not several:
        return []
    vehicle, scenario = max(several, key=lambda place: np.ptp(several[place]))

    def each(row):
        errors = rows[row][vehicle][scenario]["rmse_trainings_m"] or []
        return ", ".join(number(1e3 * error, 1) for error in errors)

    free = each("sfkd_no_contraction") if "sfkd_no_contraction" in rows else ""
    beside = f"; without its bound: {free}" if free else ""
    others = [
        rows[row][vehicle][scenario]["difference_to_sfkd"]["mean"]
        for row in rows
        if row not in (*NOT_TRAINED, "sfkd")
    ]
    ahead = sum(mean < 0 for mean in others)
    return [
        f"SFKD's trainings differ most on {names[vehicle]} {scenario.upper()} [mm]: "
        f"{each('sfkd')}{beside}; {ahead} of the {len(others)} other learned rows have "
        "a smaller mean there."
    ]


def extremes(rows, of):
    """The largest value of a measure for SFKD and for the oracle [mm]."""
    return [
        millimetres(max(of(row) for one in driven.values() for row in one.values()), 0)
        for driven in (rows["sfkd"], rows["oracle"])
    ]


def size_of(difference):
    """The size of a difference with its interval [mm]."""
    sign = 1e3 if difference["mean"] > 0 else -1e3
    low, high = sorted(sign * bound for bound in difference["ci95"])
    return f"{number(sign * difference['mean'], 1)} ({number(low, 1)} to {number(high, 1)})"


def places_of(driven, chosen, *, names=VEHICLES, shown=size_of):
    """Plants and scenarios where a row's difference to SFKD is chosen, with its size."""
    return [
        f"{names[vehicle]} {scenario.upper()} {shown(row['difference_to_sfkd'])}"
        for vehicle, one in driven.items()
        for scenario, row in one.items()
        if chosen(row)
    ]


def by_interval(who, driven):
    """Where a row is better than SFKD and where worse, by its interval alone."""
    better, worse = (
        ", ".join(places_of(driven, lambda row, side=side: apart(row) == side))
        for side in (-1, 1)
    )
    return (
        f"{who} is better than SFKD on [mm]: {better or 'none'}; "
        f"worse on: {worse or 'none'}; elsewhere the interval holds zero."
    )


def apart(row):
    """1 if the interval of a row's difference to SFKD is above zero, −1 if below."""
    low, high = row["difference_to_sfkd"]["ci95"]
    return int(low > 0) - int(high < 0)


def sides(rows):
    """The rows that are better than SFKD, with the sizes, and how often rows are worse."""
    better, worse = [], []
    for system, driven in rows.items():
        verdicts = [verdict(row) for one in driven.values() for row in one.values()]
        if -1 in verdicts:
            places = places_of(driven, lambda row: verdict(row) == -1)
            better.append(f"{label(system)} on {', '.join(places)}")
        if count := verdicts.count(1):
            worse.append(f"{label(system)} ({count})")
    size = len(VEHICLES) * len(SHOWN)
    return (
        "Other models that are better, after Holm's correction [mm]: "
        f"{'; '.join(better) or 'none'}.",
        f"Worse, on so many of {size} plants and scenarios: {'; '.join(worse) or 'none'}.",
    )


def with_left(bullets, part):
    """Bullets, and one more about what is left of a part."""
    rest = left(part)
    return f"{bullets}\n- {rest}" if rest else bullets


def pages():
    """Page -> marker -> its table or sentences, of the parts that are there."""
    made = {README: {}, IN_SHORT: {}}
    for part, marker in ((PATH, "bench path"), (BODY, "bench body")):
        if results_of(part[0]).exists():
            rows, name = rows_of(*part), part[0]
            made[README] |= {marker: with_left(first_page(rows), name)}
            claims = with_left(claim(rows), name)
            made[IN_SHORT] |= {marker: errors(rows), f"{marker} claim": claims}
    return made


def main():
    """Write the pages."""
    for page, made in pages().items():
        put(page, made)


if __name__ == "__main__":
    main()
