"""Rows trained from several seeds: what every single training drove, in figures and in a table."""

from __future__ import annotations

import statistics

from sfkd_jax.reporting._benchmark_rows import Contest, Line, Row, scenarios, title
from sfkd_jax.reporting._benchmark_tables import millimetres
from sfkd_jax.reporting._blocks import Block, Heading, Table, Text
from sfkd_jax.reporting._numbers import DASH, is_number, number, plain
from sfkd_jax.reporting._style import scenario_label

_NOTE = (
    "Mean lateral RMSE of every single training over the same episodes, and behind ± the standard deviation between "
    "trainings. A row that learns nothing has one number. Intervals elsewhere on this page draw trainings and "
    "episodes anew, both."
)


def trainings(row: Row | None) -> list[float]:
    """Mean RMSE of every training of a row [m], in the order of its seeds; equal ones, of what learns nothing, once."""
    found = (row or {}).get("rmse_trainings_m") or []
    return list(dict.fromkeys(found)) if all(map(is_number, found)) else []


def has_trainings(group: list[Contest]) -> bool:
    """Whether a row of these contests was trained from several seeds."""
    rows = (
        row for contest in group for line in contest.lines for row in line.rows.values()
    )
    return any(len(trainings(row)) > 1 for row in rows)


def apart(contest: Contest) -> list[Block]:
    """A table of the trainings, where rows have several."""
    if not has_trainings([contest]):
        return []
    rows, names = (
        [row for line in contest.lines for row in line.rows.values()],
        scenarios(contest),
    )
    seeds = sorted(
        {seed for row in rows for seed in row.get("seeds") or [] if is_number(seed)}
    )
    head = [
        f"{scenario_label(name)} [mm],\nseed {', '.join(map(plain, seeds))}"
        for name in names
    ]
    lines = [
        [line.name, *(_shown(line, name) for name in names)] for line in contest.lines
    ]
    strong = tuple(
        place for place, line in enumerate(contest.lines) if line.system == "sfkd"
    )
    return [
        Heading(3, f"Trainings apart: {title(contest)}"),
        Table(["Row", *head], lines, strong),
        Text(_NOTE, kind="note"),
    ]


def _shown(line: Line, name: str) -> str:
    found = trainings(line.rows.get(name))
    behind = f" ± {number(1e3 * statistics.stdev(found), 1)}" if len(found) > 1 else ""
    return ", ".join(millimetres(value) for value in found) + behind if found else DASH
