"""Make an entry of the leaderboard from the results of a comparison.

python -m benchmarks.leaderboard.entry runs/mine mine --label "My model" --by "My group"
[--code https://…] --out benchmarks/leaderboard/entries/mine.json
Refuses results that were not obtained under sfkd-bench-2.
"""

import argparse
import hashlib
import json
from collections import Counter
from pathlib import Path

import jsonschema
import numpy as np

from benchmarks.quality.protocol2_tuning import settings_of
from sfkd_jax import store

HERE = Path(__file__).parent
SCHEMA = json.loads((HERE / "schema.json").read_text("utf-8"))
PARTS = ("protocol2", "protocol2_path")
"""Of the protocol: experiments whose planners and scenarios an entry may have."""
FROZEN = ("vehicle", "scenario", "dataset", "controller", "training", "evaluation")
"""Groups of settings in which all rows of a part agree, but for the row's own words."""
EPISODES = 16
OWN = ("model=", "model.", "training=", "training.")
"""How the words of an entered row may begin."""
NOT_OWN = ("training.steps", "training.batch", "training.window")
"""The budget of a training."""
PLACE = ("vehicle", "scenario", "sampling")


def check(entry):
    """Raise a ValueError in one line if an entry lacks the schema or cannot be true."""
    try:
        jsonschema.validate(entry, SCHEMA)
    except jsonschema.ValidationError as reason:
        at = "/".join(map(str, reason.absolute_path)) or "entry"
        raise ValueError(f"{at}: {reason.message}") from None
    count = Counter(tuple(one[name] for name in PLACE) for one in entry["results"])
    if twice := [place for place, number in count.items() if number > 1]:
        raise ValueError(f"results: {twice[0]} is there twice")
    for one in entry["results"]:
        (low, high), mean = one["ci95_mm"], one["rmse_mm"]
        if not low <= mean <= high or one["worst_mm"] < mean:
            about = " ".join(str(one[name]) for name in PLACE)
            raise ValueError(f"{about}: the numbers contradict each other")


def part_of(document, row):
    """The part of the protocol that a row was driven under.

    Raises:
        ValueError: naming the setting that is not the protocol's.
    """
    used = document["config"]
    comparison = used["comparison"]
    parts = [settings_of(f"+experiment={part}") for part in PARTS]
    same = [
        part
        for part in parts
        if part["comparison"]["controllers"] == comparison["controllers"]
    ]
    if not same:
        raise ValueError("comparison.controllers are not those of sfkd-bench-2")
    (asked,) = same
    check_settings(used, asked)
    check_words(row, comparison, asked["comparison"])
    return asked


def check_settings(used, asked):
    """Raise a ValueError if results were driven under other settings.

    Args:
        used: settings of the results.
        asked: those of a part of the protocol.
    """
    for group in FROZEN:
        # `systems` is of the row.
        theirs, ours = (
            {key: value for key, value in one[group].items() if key != "systems"}
            for one in (used, asked)
        )
        if changed := store.differences(ours, theirs):
            raise ValueError(f"not driven as sfkd-bench-2 asks: {group}.{changed[0]}")
    if used["comparison"]["older"] or used["env_source"] != asked["env_source"]:
        raise ValueError(
            "not driven as sfkd-bench-2 asks: comparison.older or env_source"
        )


def check_words(row, used, asked):
    """Raise a ValueError if a row chose more than its model and its training.

    Args:
        row: label of the row.
        used: `comparison` of the results.
        asked: that of the protocol, whose own rows may have what they have.
    """
    here, there = (
        (one["rows"].get(row), one["tuned"], one["own_controllers"].get(row))
        for one in (used, asked)
    )
    if here == there:
        return
    tuned = [settings.get(row) for settings in used["tuned"].values()]
    words = " ".join(filter(None, [here[0], *tuned])).split()
    others = [
        word
        for word in words
        if not word.startswith(OWN) or word.partition("=")[0] in NOT_OWN
    ]
    if others or here[2]:
        what = others[0] if others else "its controller"
        raise ValueError(f"a row chooses its model and its training, not {what}")


def entry_of(document, row, *, label, by, code, digest):
    """The entry of a row.

    Args:
        document: content of results.json.
        row: label of the row in `comparison.rows`.
        label: name on the page.
        by: who enters it.
        code: address of the published model, or None.
        digest: SHA-256 of results.json.

    Raises:
        ValueError: not driven as the protocol asks, or no such row.
    """
    asked = part_of(document, row)
    rows = [one for one in document["rows"] if one["system"] == row]
    if not rows:
        names = sorted({one["system"] for one in document["rows"]})
        raise ValueError(f"no row {row}; there are {', '.join(names)}")
    sources = {one["provenance"]["source"] for one in rows}
    if len(sources) > 1 or None in sources:
        raise ValueError("cells were made by several versions of the code")
    entry = {
        "benchmark": "sfkd-bench-2",
        "row": row,
        "label": label,
        "by": by,
        "code": code,
        "results": [result_of(one) for one in rows],
        "provenance": rows[0]["provenance"],
        "results_sha256": digest,
    }
    check(entry)
    complete(entry, asked["comparison"])
    return entry


def complete(entry, comparison):
    """Raise a ValueError if a plant or a scenario was left out."""
    asked = {
        (vehicle, scenario)
        for vehicle in comparison["vehicles"]
        for scenarios in comparison["controllers"].values()
        for scenario in scenarios
    }
    driven = {(one["vehicle"], one["scenario"]) for one in entry["results"]}
    if left_out := sorted(asked - driven):
        raise ValueError(f"{' '.join(left_out[0])} was not driven")


def result_of(row):
    """One plant, scenario and sampling of an entry."""
    error, seeds = row["rmse_m"], row["seeds"]
    if row["variation"] is not None or row["episodes"] != EPISODES:
        raise ValueError(f"a row has {EPISODES} episodes and no variation")
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds {seeds} repeat a training")
    return {name: row[name] for name in PLACE} | {
        "trainings": len(seeds),
        "episodes": row["episodes"],
        "parameters": row["params"] or None,
        "rmse_mm": 1e3 * error["mean"],
        "ci95_mm": [1e3 * end for end in error["ci95"]],
        "worst_mm": 1e3 * worst_episode(row),
        "departures": row["departures"],
        "ratio_to_oracle": row["ratio_to_oracle"],
    }


def worst_episode(row):
    """The worst episode [m], averaged over trainings."""
    errors = np.reshape(row["rmse_episodes_m"], (len(row["seeds"]), -1))
    return float(np.mean(errors.max(axis=1)))


def main():
    """Parse, convert, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("directory", type=Path, help="of a comparison")
    parser.add_argument("row")
    for name in ("label", "by"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--code")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    source = given.directory / "results.json"
    try:
        document = store.read_json(source, keys=("config", "rows"))
        with store.as_artefact_error(source):
            entry = entry_of(
                document,
                given.row,
                label=given.label,
                by=given.by,
                code=given.code,
                digest=hashlib.sha256(source.read_bytes()).hexdigest(),
            )
        store.write_json(given.out, entry)
    except store.ArtefactError as reason:
        raise SystemExit(str(reason)) from None
    except ValueError as reason:
        raise SystemExit(f"{source}: {reason}") from None


if __name__ == "__main__":
    main()
