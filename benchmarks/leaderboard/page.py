"""Write the tables of docs/results/leaderboard.md from benchmarks/leaderboard/entries.

python -m benchmarks.leaderboard.page
"""

import json

from benchmarks.harness import ROOT
from benchmarks.leaderboard.entry import HERE, check
from benchmarks.markdown import filled, table

PAGE = ROOT / "docs" / "results" / "leaderboard.md"
VEHICLES = ("kinematic", "kinematic_stiff", "dynamic")
SCENARIOS = ("s1", "s2", "s3")
SAMPLING = {"feedback": "", "law": " (path)", "plain": " (plain)", None: " (QP)"}
NONE = "No entries yet."


def entries(folder=HERE / "entries"):
    """All entries, by file name.

    Raises:
        ValueError: a file that does not have the schema, named.
    """
    found = []
    for file in sorted(folder.glob("*.json")):
        entry = json.loads(file.read_text("utf-8"))
        try:
            check(entry)
        except ValueError as reason:
            raise ValueError(f"{file.name}: {reason}") from None
        found.append(entry)
    return found


def tables(found):
    """A table a plant, by the error on S3; entries without S3 come last."""
    if not found:
        return NONE
    return "\n\n".join(
        f"**{vehicle}**\n\n{table}"
        for vehicle in VEHICLES
        if (table := table_of(found, vehicle))
    )


def table_of(found, vehicle):
    """The table of a plant, or "" if nobody has driven it."""
    lines = []
    for entry in found:
        about = [one for one in entry["results"] if one["vehicle"] == vehicle]
        for sampling in dict.fromkeys(one["sampling"] for one in about):
            driven = {
                one["scenario"]: one for one in about if one["sampling"] == sampling
            }
            lines.append((rank(driven), line_of(entry, sampling, driven)))
    if not lines:
        return ""
    head = ["entry", "by", "S1", "S2", "S3 [mm]", "worst on S3", "left", "trainings"]
    return table([*head, "parameters", "source"], [line for _, line in sorted(lines)])


def rank(driven):
    """Error on S3, infinite without it."""
    return driven["s3"]["rmse_mm"] if "s3" in driven else float("inf")


def line_of(entry, sampling, driven):
    """A row of the table."""
    name = entry["label"] + SAMPLING[sampling]
    last = driven.get("s3")
    return [
        f"[{name}]({entry['code']})" if entry["code"] else name,
        entry["by"],
        *(error_of(driven.get(scenario)) for scenario in SCENARIOS),
        f"{last['worst_mm']:.1f}" if last else "–",
        sum(one["departures"] for one in driven.values()),
        min(one["trainings"] for one in driven.values()),
        entry["parameters"] or "–",
        f"`{entry['provenance']['source'][:12]}`",
    ]


def error_of(result):
    """RMSE and its interval."""
    if result is None:
        return "–"
    low, high = result["ci95_mm"]
    return f"{result['rmse_mm']:.1f} ({low:.1f} to {high:.1f})"


def page(text):
    """The page with its tables written anew."""
    return filled(text, {"entries": tables(entries())})


def main():
    """Write the page."""
    PAGE.write_text(page(PAGE.read_text("utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
