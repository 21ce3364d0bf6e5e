"""Make an entry of the leaderboard from the results of a comparison.

python -m benchmarks.leaderboard.entry runs/mine mine --label "My model" --by "My group"
[--code https://…] --out benchmarks/leaderboard/entries/mine.json
Refuses results that were not obtained under sfkd-bench-2.
"""

import argparse
import hashlib
import json
from pathlib import Path

import jsonschema
import numpy as np

from sfkd_jax.artefacts import write_json

HERE = Path(__file__).parent
SCHEMA = json.loads((HERE / "schema.json").read_text("utf-8"))
PROTOCOL = {"seed": 108623979, "episodes": 16, "episode_s": 30.0}
"""Of `evaluation`, see docs/results/protocol-2.md."""
PLACE = ("vehicle", "scenario", "sampling")


def check(entry):
    """Raise a ValueError in one line if an entry does not have the schema."""
    try:
        jsonschema.validate(entry, SCHEMA)
    except jsonschema.ValidationError as reason:
        at = "/".join(map(str, reason.absolute_path)) or "entry"
        raise ValueError(f"{at}: {reason.message}") from None


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
        ValueError: other episodes than the protocol's, or no such row.
    """
    used = document["config"]["evaluation"]
    for name, value in PROTOCOL.items():
        if used[name] != value:
            raise ValueError(
                f"sfkd-bench-2 has evaluation.{name}={value}, the results {used[name]}"
            )
    rows = [one for one in document["rows"] if one["system"] == row]
    if not rows:
        names = sorted({one["system"] for one in document["rows"]})
        raise ValueError(f"no row {row}; there are {', '.join(names)}")
    entry = {
        "benchmark": "sfkd-bench-2",
        "row": row,
        "label": label,
        "by": by,
        "code": code,
        "parameters": max(one["params"] or 0 for one in rows) or None,
        "results": [result_of(one) for one in rows],
        "provenance": rows[0]["provenance"],
        "results_sha256": digest,
    }
    check(entry)
    return entry


def result_of(row):
    """One plant, scenario and sampling of an entry."""
    error = row["rmse_m"]
    return {name: row[name] for name in PLACE} | {
        "trainings": len(row["seeds"]),
        "episodes": row["episodes"],
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
        data = source.read_bytes()
        entry = entry_of(
            json.loads(data),
            given.row,
            label=given.label,
            by=given.by,
            code=given.code,
            digest=hashlib.sha256(data).hexdigest(),
        )
    except (OSError, ValueError, KeyError) as reason:
        raise SystemExit(f"{source}: {reason}") from None
    write_json(given.out, entry)


if __name__ == "__main__":
    main()
