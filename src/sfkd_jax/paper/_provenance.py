"""The head of a results page, and how its results are reproduced."""

from __future__ import annotations

import shlex
from collections import Counter
from typing import Any

from sfkd_jax.evaluation.formats import DASH, dig, is_number, number, plain
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.paper._setups import Setup
from sfkd_jax.paper._study import Study
from sfkd_jax.paper._texts import text
from sfkd_jax.reporting.blocks import Block, Code, Heading, Table
from sfkd_jax.reporting.tables import named_values


def lead(results: dict[str, Any], setups: list[Setup], study: Study) -> str:
    """How much was simulated."""
    entries = [entry for setup in setups for entry in setup.entries]
    rows = _rows(setups)
    vehicles = list(dict.fromkeys(setup.vehicle for setup in setups))
    plural = "s" if len(vehicles) != 1 else ""
    amount = text(
        "page.amount",
        rows=str(len({entry.name for entry in entries})),
        vehicles=f"{len(vehicles)} vehicle{plural} ({', '.join(vehicles)})",
        episodes=_range(rows, "episodes"),
        seconds=_range(rows, "episode_s"),
        seeds=_seeds(rows),
    )
    seconds: Any = results.get("seconds")
    last = ""
    if is_number(seconds):
        last = text("page.last_run", minutes=number(seconds / 60, 1))
    return " ".join(filter(None, [study.intro, amount, last]))


def failures(results: dict[str, Any]) -> list[Block]:
    """The rows that failed, with the reason."""
    failed = results.get("failed")
    if not isinstance(failed, dict) or not failed:
        return []
    rows = [[str(name), plain(reason)] for name, reason in failed.items()]
    return [Heading(2, "Rows that failed"), Table(["Row", "Reason"], rows, prose=True)]


def provenance(results: dict[str, Any], setups: list[Setup]) -> list[Block]:
    """Command, episodes and seeds of every setup, settings and versions."""
    config = results.get("config") or {}
    counts = [
        [f"{one.vehicle}, {one.sampling or 'no sampling'}", name, *_counts(one, name)]
        for one in setups
        for name in one.scenarios
    ]
    head = ["Setup", "Scenario", "Episodes", "Seconds each", "Seeds"]
    versions = results.get("versions") or {}
    packages = [[str(name), plain(version)] for name, version in versions.items()]
    return [
        Heading(2, "How to reproduce"),
        Code(_command(config)),
        Heading(3, "Episodes"),
        Table(head, counts, prose=True),
        Heading(3, "Settings"),
        named_values(("Group", "Settings"), _without_page(config)),
        Heading(3, "Versions"),
        Table(["Package", "Version"], packages, prose=True),
        *_code(setups),
    ]


def _code(setups: list[Setup]) -> list[Block]:
    """Which code made how many rows; rows of earlier versions do not say."""
    counts: Counter[tuple[str, ...]] = Counter()
    for row in _rows(setups):
        about = row.get("provenance")
        if isinstance(about, dict):
            counts[_made_by(about)] += 1
    if not counts:
        return []
    head = ["Source", "Commit", "Version", "jax", "Device", "Rows"]
    rows = [[*about, str(count)] for about, count in counts.most_common()]
    return [Heading(3, "Code"), Table(head, rows, prose=True)]


def _made_by(about: dict[str, Any]) -> tuple[str, ...]:
    """Provenance of a row; "several" where its trainings differ."""
    short = {"source": 12, "commit": 10}
    return tuple(
        str(about.get(key) or "several")[: short.get(key)]
        for key in ("source", "commit", "version", "jax", "device")
    )


def _rows(setups: list[Setup]) -> list[Row]:
    """The rows of all setups."""
    entries = [entry for setup in setups for entry in setup.entries]
    return [row for entry in entries for row in entry.rows.values()]


def _counts(setup: Setup, scenario: str) -> list[str]:
    rows = setup.rows_on(scenario)
    return [_range(rows, "episodes"), _range(rows, "episode_s"), _seeds(rows)]


def _range(rows: list[Row], key: str) -> str:
    """The value of all rows, or the least and the largest."""
    values = sorted({row[key] for row in rows if is_number(row.get(key))})
    ends = [plain(values[0]), plain(values[-1])] if values else [DASH]
    return " to ".join(dict.fromkeys(ends))


def _seeds(rows: list[Row]) -> str:
    """All seeds of all rows."""
    seeds = {seed for row in rows for seed in row.get("seeds") or [] if is_number(seed)}
    return ", ".join(map(plain, sorted(seeds))) or DASH


def _command(config: dict[str, Any]) -> str:
    """The command as recorded, else the experiment of the same name."""
    if isinstance(config.get("command"), str):
        return config["command"]
    name = config.get("name")
    named = [f"+experiment={name}"] if name not in (None, "", "default") else []
    return shlex.join(["python", "-m", "sfkd_jax.compare", *named])


def _without_page(config: dict[str, Any]) -> dict[str, Any]:
    """Settings without the printed numbers and texts, which the page shows itself."""
    comparison = dig(config, "comparison")
    if not isinstance(comparison, dict):
        return config
    rest = {key: comparison[key] for key in comparison if key not in ("paper", "page")}
    return config | {"comparison": rest}
