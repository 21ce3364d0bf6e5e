"""Rows of results.json: their names, which may be compared, and tables of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from sfkd_jax.evaluation import formats, identity
from sfkd_jax.evaluation.formats import DASH, dig, is_number, is_pair, millimetres
from sfkd_jax.evaluation.metrics import METRICS, Metric, Row
from sfkd_jax.report.style import family, label, rank, scenario_label

NO_MODEL = ("nominal", "oracle", "law")
"""Systems without a learned model; their names imply whether they observe e."""
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


class Table(NamedTuple):
    """A table of strings.

    Attributes:
        corner: head of the first column, which names the rows.
        columns: (group, name) of the others; equal neighbouring groups are one head.
        rows: name and cells.
        prose: whether cells hold left-aligned text instead of right-aligned numbers.
        strong: name of the row to stress.
    """

    corner: str
    columns: list[tuple[str, str]]
    rows: list[tuple[str, list[str]]]
    prose: bool = False
    strong: str = "SFKD"

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The heads above neighbouring columns, with their widths; empty for none."""
        spans: list[tuple[str, int]] = []
        for group, _ in self.columns:
            same = bool(spans) and spans[-1][0] == group
            spans.append((group, 1 + (spans.pop()[1] if same else 0)))
        return spans if any(group for group, _ in spans) else []


def record_table(corner: str, record: dict[str, Any], *heads: str) -> Table:
    """A record as a table of text; a value is one cell, or a list of cells."""
    cells = {
        name: value if isinstance(value, list) and heads[1:] else [value]
        for name, value in record.items()
    }
    rows = [(str(name), [*map(formats.plain, own)]) for name, own in cells.items()]
    return Table(corner, [("", head) for head in heads], rows, prose=True)


def name_of(row: Row) -> str:
    """Name a row by its system and, where it is not obvious, by its access to e."""
    system, env = family(str(row.get("system"))), str(row.get("env"))
    shown = label(system)
    if env == "estimated":
        return f"{shown} (e estimated)"
    in_name = env == "measured" and shown.endswith(" e")  # as in "reads e"
    # Where the name or the kind of system says it, brackets would only repeat it.
    if in_name or system in NO_MODEL or system.startswith("sfkd"):
        return shown
    return shown + {"measured": " (e)", "none": " (no e)"}.get(env, "")


def grouped(rows: Iterable[Row], columns: Iterable[str]) -> list[list[Row]]:
    """Rows in the order of tables, by what they have in common.

    Args:
        rows: of results.json.
        columns: of their identity; a row that does not sample has no controller of
            which others must have the same.
    """
    rows = sorted(rows, key=lambda row: (rank(str(row.get("system"))), name_of(row)))

    def key(row: Row) -> tuple[str, ...]:
        return tuple(str(identity(row)[name]) for name in columns)

    def fits(row: Row, wanted: tuple[str, ...]) -> bool:
        # A reference system without a search is comparable under any controller.
        search = () if row.get("sampling") else ("controller", "planner", "sampling")
        pairs = zip(columns, key(row), wanted, strict=True)
        return all(own == one or name in search for name, own, one in pairs)

    columns = [*columns]
    found: list[list[Row]] = []
    for wanted in sorted(set(map(key, rows))):
        group = [row for row in rows if fits(row, wanted)]
        ids = {id(row) for row in group}
        # Rows that do not sample make a group of their own only where none samples.
        found = [one for one in found if not {id(row) for row in one} < ids]
        if not any(ids <= {id(row) for row in one} for one in found):
            found.append(group)
    return found


def title_of(group: list[Row], columns: Iterable[str]) -> str:
    """What the rows of a group have in common, in words."""
    known = identity(next((row for row in group if row.get("sampling")), group[0]))
    controller = known["controller"]
    usual = identity({"controller": controller})["planner"]
    # Only what is unusual is worth a word.
    words = {
        "scenario": scenario_label(str(known["scenario"])),
        "vehicle": f"{known['vehicle']} vehicle",
        "inner_loop": "under a speed loop" * (known["inner_loop"] == "speed"),
        "sampling": SAMPLINGS.get(str(known["sampling"]), known["sampling"]),
        "controller": controller
        and f"controller {controller}" * (controller != "mppi"),
        "planner": f"planner {known['planner']}" * (known["planner"] != usual),
        "variation": known["variation"],
    }
    text = ", ".join(filter(None, (words[name] for name in columns))) or "all rows"
    return text[:1].upper() + text[1:]


def row_of(group: list[Row], system: str) -> Row:
    """The row of a system, preferably the one that measures e; empty if none."""
    rows = [row for row in group if row.get("system") == system]
    return min(rows, key=lambda row: row.get("env") != "measured", default={})


def model_of(config: dict[str, Any]) -> str:
    """Name of the system that settings train, as in results.json."""
    model = config.get("model")
    return str(dig(model, "system") or dig(model, "name") or "sfkd")


def amount(rows: list[Row]) -> str:
    """How many episodes of which length, and from which seeds of the training."""
    known = {key: {row.get(key) for row in rows} for key in ("episodes", "episode_s")}
    known["seeds"] = {seed for row in rows for seed in row.get("seeds") or []}
    several = ([*filter(is_number, values)] for values in known.values())
    many, long, seeds = (
        ", ".join(sorted(map(formats.short, one))) or DASH for one in several
    )
    return f"{many} episodes of {long} s; training seeds: {seeds}."


def shown_metrics() -> list[Metric]:
    """The metrics that a reader sees: those with a label."""
    return [metric for metric in METRICS if metric.label]


def metric_tables(group: list[tuple[str, Row]], corner: str = "System") -> list[Table]:
    """All metrics of named rows that any has: one table for each `Metric.table`."""
    kinds: dict[str, list[Metric]] = {}
    for metric in shown_metrics():
        # A metric that no row has would be a column of dashes.
        if any(metric.text(row) != DASH for _, row in group):
            kinds.setdefault(metric.table, []).append(metric)
    return [
        Table(
            corner,
            [("", metric.head()) for metric in metrics],
            [(name, [metric.text(row) for metric in metrics]) for name, row in group],
        )
        for metrics in kinds.values()
    ]


def cross_table(group: list[Row], show: Callable[[Row], str]) -> Table | None:
    """One number of every system, by vehicle and scenario; None if there is none."""
    cells: dict[str, dict[tuple[str, str], str]] = {}
    for row in group:
        where = str(row.get("vehicle")), str(row.get("scenario"))
        # The first row of a place stays: later ones vary what the table does not show.
        cells.setdefault(name_of(row), {}).setdefault(where, show(row))
    places = sorted({where for row in cells.values() for where in row})
    columns = [(vehicle, scenario_label(scenario)) for vehicle, scenario in places]
    rows = [(name, [row.get(w, DASH) for w in places]) for name, row in cells.items()]
    known = any(cell != DASH for _, row in rows for cell in row)
    return Table("System", columns, rows) if known else None


def rmse_cell(row: Row) -> str:
    """RMSE in mm with its 95 % interval and the mark of its difference to SFKD."""
    ends, shown = dig(row, "rmse_m", "ci95"), millimetres(row.get("rmse_m"))
    if is_pair(ends):
        shown += f" ({formats.interval([1e3 * end for end in ends], 1)})"
    return shown + {1: " *", 0: "", -1: " †"}[side(row.get("difference_to_sfkd"))]


def side(record: Any) -> int:
    """Sign of a difference to SFKD: 1 above zero, −1 below, 0 if it is undecided."""
    mean, ends, p = (dig(record, key) for key in ("mean", "ci95", "p_holm"))
    if not (is_number(mean) and is_pair(ends)):
        return 0
    # Rows that were not compared as a family have an interval, but no p-value.
    decided = p < LEVEL if is_number(p) else min(ends) * max(ends) > 0
    return (1 if mean > 0 else -1) if decided else 0


def printed_table(rows: list[Row], options: dict[str, Any]) -> Table | None:
    """What the paper prints beside ours, from `comparison.paper`; None if nothing is.

    Args:
        rows: of one vehicle that may be compared.
        options: `comparison`: `paper` has `columns` and a list of numbers by system.
    """
    paper = options.get("paper") or {}
    scenarios = sorted({str(row.get("scenario")) for row in rows})
    # Column of the paper -> head, scenario, place in our rows, how it is written.
    ours: dict[str, tuple[str, str, str, Callable[[Any], str]]] = {
        f"rmse_{name}_m": ("RMSE [mm]", name, "rmse_m", millimetres)
        for name in scenarios
    }
    rate, left = "smoothness_rad_per_s", "violation.v2"
    ours[rate] = ("steering rate [rad/s]", scenarios[-1], rate, formats.number)
    ours["violation_rate"] = ("violations [%]", scenarios[-1], left, formats.percent)
    names = [name for name in paper.get("columns") or [] if name in ours]
    table: dict[str, list[str]] = {}
    for row in rows:
        printed = paper.get(family(str(row.get("system"))))
        # A system that the paper does not print has no line in this table.
        if printed and names:
            quoted = dict(zip(paper["columns"], printed, strict=False))
            own = {str(r["scenario"]): r for r in rows if name_of(r) == name_of(row)}
            table[name_of(row)] = [
                write(value)
                for name in names
                for _, where, place, write in [ours[name]]
                for value in (dig(own.get(where), *place.split(".")), quoted[name])
            ]
    heads = [f"{scenario_label(ours[name][1])} {ours[name][0]}" for name in names]
    columns = [(head, kind) for head in heads for kind in ("ours", "paper")]
    return Table("System", columns, [*table.items()]) if table else None
