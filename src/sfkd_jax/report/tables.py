"""Rows of results.json as tables: their names, and which rows may be compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pandas as pd

from sfkd_jax.driving.simulation import identity
from sfkd_jax.driving.simulation.metrics import BY_NAME, METRICS, Metric, Row
from sfkd_jax.evaluation import formats
from sfkd_jax.evaluation.formats import DASH, dig, is_number, is_pair, millimetres
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
"""A difference counts as decided if its corrected p-value is smaller than this."""
MARKS = (
    "Lateral RMSE [mm], mean over trainings and episodes, with its 95 % interval. "
    "* more than SFKD, † less, each with p < 0.05 after Holm's correction; unmarked: "
    "undecided. (e): friction and wind are observed; (no e): they are not."
)
"""The caption of tables of `rmse_cell`."""
_SEARCH = ("controller", "planner", "sampling")
"""Columns that say how a row searches."""


def table(corner: str, columns: dict[Any, list[str]], names: list[str]) -> pd.DataFrame:
    """Return a table of text.

    Args:
        corner: head of the column with the names of the rows.
        columns: cells by head of the column.
        names: of the rows.
    """
    frame = pd.DataFrame(columns, index=pd.Index(names), dtype=object)
    return frame.rename_axis(columns=[*[""] * (frame.columns.nlevels - 1), corner])


def record_table(corner: str, record: dict[str, Any], *heads: str) -> pd.DataFrame:
    """Return a record as a table with a row for each entry.

    Args:
        corner: head of the column with the names of the entries.
        record: values by name; with several heads each value is a list of as many.
        heads: of the other columns.
    """
    rows = list(record.values())
    if len(heads) == 1:
        rows = [[value] for value in rows]
    columns = {
        head: [formats.plain(row[column]) for row in rows]
        for column, head in enumerate(heads)
    }
    return table(corner, columns, [*map(str, record)])


def name_of(row: Row) -> str:
    """Return the label of a row: its system and, where unclear, its access to e."""
    system = family(str(row.get("system")))
    env = str(row.get("env"))
    shown = label(system)
    if env == "estimated":
        return f"{shown} (e estimated)"
    says_so = env == "measured" and shown.endswith(" e")  # as in "reads e"
    # Where the label or the type of the system says it, brackets would only repeat it.
    if says_so or system.startswith((*NO_MODEL, "sfkd")):
        return shown
    access = {"measured": " (e)", "none": " (no e)"}
    return shown + access.get(env, "")


def grouped(rows: Iterable[Row], columns: Iterable[str]) -> list[list[Row]]:
    """Return the rows in the order of tables, by what they have in common.

    A row that does not sample fits a group whatever its controller is.
    """
    columns = [*columns]
    rows = sorted(rows, key=_order_of_tables)

    def key(row: Row) -> tuple[str, ...]:
        return tuple(str(identity(row)[name]) for name in columns)

    def fits(row: Row, group_key: tuple[str, ...]) -> bool:
        # A reference system without a search is comparable under any controller.
        free = () if row.get("sampling") else _SEARCH
        pairs = zip(columns, key(row), group_key, strict=True)
        return all(name in free or value == wanted for name, value, wanted in pairs)

    keys = sorted({key(row) for row in rows})
    groups = [[row for row in rows if fits(row, group_key)] for group_key in keys]
    members = [{id(row) for row in group} for group in groups]
    # Rows that do not sample make a group of their own only where none samples.
    return [
        group
        for number, group in enumerate(groups)
        if members[number] not in members[:number]
        and not any(members[number] < other for other in members)
    ]


def _order_of_tables(row: Row) -> tuple[Any, ...]:
    """Return the sort key of a row."""
    return rank(str(row.get("system"))), name_of(row)


def title_of(group: list[Row], columns: Iterable[str]) -> str:
    """Return what the rows of a group have in common, in words.

    Args:
        group: of rows.
        columns: those in which the rows agree.
    """
    common = identity(next((row for row in group if row.get("sampling")), group[0]))
    controller = common["controller"] or "mppi"
    planner = common["planner"]
    sampling = common["sampling"]
    words = {
        "scenario": scenario_label(str(common["scenario"])),
        "vehicle": f"{common['vehicle']} vehicle",
        "sampling": SAMPLINGS.get(str(sampling), sampling),
    }
    # Only what is unusual is worth a word.
    if common["inner_loop"] == "speed":
        words["inner_loop"] = "under a speed loop"
    if common["latency"] is not None:
        words["latency"] = f"latency of {common['latency']}"
    if controller != "mppi":
        words["controller"] = f"controller {controller}"
    if planner is not None:
        words["planner"] = f"planner {planner}"
    text = ", ".join(filter(None, map(words.get, columns))) or "all rows"
    return text[:1].upper() + text[1:]


def amount(rows: list[Row]) -> str:
    """Return how many episodes of which length, and from which seeds of training."""
    seeds = [seed for row in rows for seed in row.get("seeds") or []]
    episodes = _distinct(row.get("episodes") for row in rows)
    seconds = _distinct(row.get("episode_s") for row in rows)
    return (
        f"{episodes or DASH} episodes of {seconds or DASH} s; "
        f"training seeds: {_distinct(seeds)}."
    )


def _distinct(values: Iterable[Any]) -> str:
    """Return the different numbers among values, separated by commas."""
    return ", ".join(sorted({formats.short(x) for x in values if is_number(x)}))


def shown_metrics() -> list[Metric]:
    """Return the metrics that a reader sees: those with a label."""
    return [metric for metric in METRICS if metric.label]


def metric_tables(group: list[Row]) -> list[pd.DataFrame]:
    """Return all metrics that any row has: one table for each `Metric.table`."""
    columns_of: dict[str, dict[Any, list[str]]] = {}
    for metric in shown_metrics():
        cells = [metric.text(row) for row in group]
        # A metric that no row has would be a column of dashes.
        if set(cells) != {DASH}:
            columns_of.setdefault(metric.table, {})[metric.head()] = cells
    names = [name_of(row) for row in group]
    return [table("System", columns, names) for columns in columns_of.values()]


def text_table(rows: list[Row], *names: str) -> str:
    """Return metrics of rows as text for a terminal."""
    metrics = [BY_NAME[name] for name in names]
    columns = {metric.head(): [metric.text(row) for row in rows] for metric in metrics}
    return table("", columns, [str(row["system"]) for row in rows]).to_string()


def cross_table(group: list[Row], show: Callable[[Row], str]) -> pd.DataFrame | None:
    """Return one number of every system, by vehicle and scenario.

    Args:
        group: of rows.
        show: row -> the number as text.

    Returns:
        The table, or None if no row has this number.
    """
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in group:
        where = (str(row.get("vehicle")), scenario_label(str(row.get("scenario"))))
        # The first row of a place stays: later ones vary what the table does not show.
        cells.setdefault(where, {}).setdefault(name_of(row), show(row))
    names = [*dict.fromkeys(map(name_of, group))]
    columns = {
        where: [cells[where].get(name, DASH) for name in names]
        for where in sorted(cells)
    }
    if all(cell == DASH for column in columns.values() for cell in column):
        return None
    return table("System", columns, names)


def rmse_cell(row: Row) -> str:
    """Return the RMSE in mm, its 95 % interval and the mark of its difference to SFKD.

    `MARKS` explains the cell.
    """
    shown = millimetres(row.get("rmse_m"))
    ends = dig(row, "rmse_m", "ci95")
    if is_pair(ends):
        shown += f" ({formats.interval(ends, 1, scale=1e3)})"
    marks = {1: " *", 0: "", -1: " †"}
    return shown + marks[side(row.get("difference_to_sfkd"))]


def side(record: Any) -> int:
    """Return the sign of a difference to SFKD: 1 above 0, −1 below, 0 if undecided."""
    mean = dig(record, "mean")
    ends = dig(record, "ci95")
    p = dig(record, "p_holm")
    if not (is_number(mean) and is_pair(ends)):
        return 0
    # Rows that were not compared as a family have an interval, but no p-value.
    decided = p < LEVEL if is_number(p) else min(ends) * max(ends) > 0
    if not decided:
        return 0
    return 1 if mean > 0 else -1
