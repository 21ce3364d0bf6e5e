"""Write the tables of docs/results/leaderboard.md from benchmarks/leaderboard/entries.

python -m benchmarks.leaderboard.page
"""

from benchmarks.harness import ROOT
from benchmarks.leaderboard.entry import HERE, check
from benchmarks.markdown import filled, table
from sfkd_jax import store

PAGE = ROOT / "docs" / "results" / "leaderboard.md"
VEHICLES = ("kinematic", "kinematic_stiff", "dynamic")
SCENARIOS = ("s1", "s2", "s3")
BLOCKS = {
    "in path coordinates, around one law": ("law",),
    "in the body frame, around feedback": ("feedback", None),
    "in the body frame, plain sampling": ("plain",),
}
"""What is comparable -> its sampling; a quadratic program does not sample."""
NONE = "No entries yet."


def entries(folder=HERE / "entries"):
    """All entries, by file name.

    Raises:
        ValueError: a file that is damaged or no entry, named.
    """
    found = []
    for file in sorted(folder.glob("*.json")):
        entry = store.read_json(file)
        try:
            check(entry)
        except ValueError as reason:
            raise ValueError(f"{file.name}: {reason}") from None
        found.append(entry)
    return found


def tables(found):
    """A table a block and plant, by the error on S3."""
    made = [
        f"**{vehicle}, {words}**\n\n{table}"
        for words, sampling in BLOCKS.items()
        for vehicle in VEHICLES
        if (table := table_of(found, vehicle, sampling))
    ]
    return "\n\n".join(made) or NONE


def table_of(found, vehicle, sampling):
    """The table of a plant and a block, or "" if nobody has driven it."""
    lines = []
    for entry in found:
        driven = {
            one["scenario"]: one
            for one in entry["results"]
            if one["vehicle"] == vehicle and one["sampling"] in sampling
        }
        if driven:
            lines.append((rank(driven), line_of(entry, driven)))
    if not lines:
        return ""
    lines.sort(key=lambda line: line[0])
    head = ["entry", "by", "S1", "S2", "S3 [mm]", "worst on S3", "left", "trainings"]
    return table([*head, "parameters", "source"], [line for _, line in lines])


def rank(driven):
    """Error on S3, infinite without it."""
    return driven["s3"]["rmse_mm"] if "s3" in driven else float("inf")


def line_of(entry, driven):
    """A row of the table."""
    last, results = driven.get("s3"), driven.values()
    learned = [one["parameters"] for one in results if one["parameters"]]
    name = entry["label"]
    return [
        f"[{name}]({entry['code']})" if entry["code"] else name,
        entry["by"],
        *(error_of(driven.get(scenario)) for scenario in SCENARIOS),
        f"{last['worst_mm']:.1f}" if last else "–",
        sum(one["departures"] for one in results),
        min(one["trainings"] for one in results) if learned else "–",
        f"{max(learned):,}" if learned else "–",
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
    try:
        PAGE.write_text(page(PAGE.read_text("utf-8")), encoding="utf-8")
    except (ValueError, store.ArtefactError) as reason:
        raise SystemExit(str(reason)) from None


if __name__ == "__main__":
    main()
