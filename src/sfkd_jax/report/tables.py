"""Rows of results.json as tables: their names, and which rows may be compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pandas as pd

from sfkd_jax.evaluation import formats, identity
from sfkd_jax.evaluation.formats import DASH, dig, is_number, is_pair, millimetres
from sfkd_jax.evaluation.metrics import BY_NAME, METRICS, Metric, Row
from sfkd_jax.report.style import family, label, rank, scenario_label

NO_MODEL = ("nominal", "oracle", "law")
"""Beginnings of systems without a learned model, whose names imply whether they observe
e; so do those of ours.
"""
SAMPLINGS = {
    "feedback": "sampling around a feedback law",
    "plain": "plain sampling",
    "law": "path coordinates, sampling around their law",
}
LEVEL = 0.05
"""A difference counts if its corrected p-value is smaller."""
MARKS = (
    "Lateral RMSE [mm], mean over trainings and episodes, with its 95 % interval. "
    "* more than SFKD, † less, each with p < 0.05 after Holm's correction; unmarked: "
    "undecided. (e): friction and wind are observed; (no e): they are not."
)
"""What the cells of `rmse_cell` are."""
_SEARCH = ("controller", "planner", "sampling")


def table(corner: str, columns: dict[Any, list[str]], names: list[str]) -> pd.DataFrame:
    """Text by column; `corner` is the head of the names of the rows."""
    frame = pd.DataFrame(columns, index=pd.Index(names), dtype=object)
    return frame.rename_axis(columns=[*[""] * (frame.columns.nlevels - 1), corner])


def record_table(corner: str, record: dict[str, Any], *heads: str) -> pd.DataFrame:
    """A record as a table; a value is one cell, or with several heads a list."""
    cells = [value if heads[1:] else [value] for value in record.values()]
    columns = {
        head: [formats.plain(own[column]) for own in cells]
        for column, head in enumerate(heads)
    }
    return table(corner, columns, [*map(str, record)])


def name_of(row: Row) -> str:
    """Name a row by its system and, where it is not obvious, by its access to e."""
    system, env = family(str(row.get("system"))), str(row.get("env"))
    shown = label(system)
    if env == "estimated":
        return f"{shown} (e estimated)"
    in_name = env == "measured" and shown.endswith(" e")  # as in "reads e"
    # Where the name or the kind of system says it, brackets would only repeat it.
    if in_name or system.startswith((*NO_MODEL, "sfkd")):
        return shown
    return shown + {"measured": " (e)", "none": " (no e)"}.get(env, "")


def grouped(rows: Iterable[Row], columns: Iterable[str]) -> list[list[Row]]:
    """Rows in the order of tables, by what they have in common.

    A row that does not sample has no controller of which others must have the same.
    """
    rows, columns = [*rows], [*columns]
    rows.sort(key=lambda row: (rank(str(row.get("system"))), name_of(row)))

    def key(row: Row) -> tuple[str, ...]:
        return tuple(str(identity(row)[name]) for name in columns)

    def fits(row: Row, wanted: tuple[str, ...]) -> bool:
        # A reference system without a search is comparable under any controller.
        free = () if row.get("sampling") else _SEARCH
        pairs = zip(columns, key(row), wanted, strict=True)
        return all(own == one or name in free for name, own, one in pairs)

    wanted = sorted({key(row) for row in rows})
    groups = [[row for row in rows if fits(row, one)] for one in wanted]
    ids = [{id(row) for row in group} for group in groups]
    # Rows that do not sample make a group of their own only where none samples.
    return [
        group
        for number, group in enumerate(groups)
        if ids[number] not in ids[:number]
        and not any(ids[number] < other for other in ids)
    ]


def title_of(group: list[Row], columns: Iterable[str]) -> str:
    """What the rows of a group have in common, in words."""
    known = identity(next((row for row in group if row.get("sampling")), group[0]))
    controller = known["controller"] or "mppi"
    # Only what is unusual is worth a word.
    words = {
        "scenario": scenario_label(str(known["scenario"])),
        "vehicle": f"{known['vehicle']} vehicle",
        "inner_loop": "under a speed loop" * (known["inner_loop"] == "speed"),
        "sampling": SAMPLINGS.get(str(known["sampling"]), known["sampling"]),
        "controller": f"controller {controller}" * (controller != "mppi"),
        "planner": f"planner {known['planner']}" * (known["planner"] is not None),
    }
    text = ", ".join(filter(None, (words[name] for name in columns))) or "all rows"
    return text[:1].upper() + text[1:]


def amount(rows: list[Row]) -> str:
    """How many episodes of which length, and from which seeds of the training."""
    known = [[row.get(key) for row in rows] for key in ("episodes", "episode_s")]
    known.append([seed for row in rows for seed in row.get("seeds") or []])
    many, long, seeds = (
        ", ".join(sorted({formats.short(one) for one in values if is_number(one)}))
        for values in known
    )
    return f"{many or DASH} episodes of {long or DASH} s; training seeds: {seeds}."


def shown_metrics() -> list[Metric]:
    """The metrics that a reader sees: those with a label."""
    return [metric for metric in METRICS if metric.label]


def metric_tables(group: list[Row]) -> list[pd.DataFrame]:
    """All metrics of rows that any has: one table for each `Metric.table`."""
    kinds: dict[str, dict[Any, list[str]]] = {}
    for metric in shown_metrics():
        cells = [metric.text(row) for row in group]
        # A metric that no row has would be a column of dashes.
        if set(cells) != {DASH}:
            kinds.setdefault(metric.table, {})[metric.head()] = cells
    names = [name_of(row) for row in group]
    return [table("System", columns, names) for columns in kinds.values()]


def text_table(rows: list[Row], *names: str) -> str:
    """Metrics of rows for a terminal."""
    metrics = [BY_NAME[name] for name in names]
    columns = {one.head(): [one.text(row) for row in rows] for one in metrics}
    return table("", columns, [str(row["system"]) for row in rows]).to_string()


def cross_table(group: list[Row], show: Callable[[Row], str]) -> pd.DataFrame | None:
    """One number of every system, by vehicle and scenario; None if there is none."""
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in group:
        where = str(row.get("vehicle")), scenario_label(str(row.get("scenario")))
        # The first row of a place stays: later ones vary what the table does not show.
        cells.setdefault(where, {}).setdefault(name_of(row), show(row))
    names = [*dict.fromkeys(map(name_of, group))]
    columns = {
        where: [cells[where].get(name, DASH) for name in names]
        for where in sorted(cells)
    }
    known = any(cell != DASH for column in columns.values() for cell in column)
    return table("System", columns, names) if known else None


def rmse_cell(row: Row) -> str:
    """RMSE in mm with its 95 % interval and the mark of its difference to SFKD."""
    ends, shown = dig(row, "rmse_m", "ci95"), millimetres(row.get("rmse_m"))
    if is_pair(ends):
        shown += f" ({formats.interval(ends, 1, scale=1e3)})"
    return shown + {1: " *", 0: "", -1: " †"}[side(row.get("difference_to_sfkd"))]


def side(record: Any) -> int:
    """Sign of a difference to SFKD: 1 above zero, −1 below, 0 if it is undecided."""
    mean, ends, p = (dig(record, key) for key in ("mean", "ci95", "p_holm"))
    if not (is_number(mean) and is_pair(ends)):
        return 0
    # Rows that were not compared as a family have an interval, but no p-value.
    decided = p < LEVEL if is_number(p) else min(ends) * max(ends) > 0
    return (1 if mean > 0 else -1) if decided else 0
