"""Rows of a comparison, grouped into setups whose entries may be compared."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from sfkd_jax.evaluation.formats import dig, is_number, is_pair
from sfkd_jax.evaluation.metrics import Metric, Row
from sfkd_jax.reporting.rows import SAMPLINGS, name_of, vehicle_stem
from sfkd_jax.reporting.style import family, rank

LEVEL = 0.05
"""A difference counts if its corrected p-value is smaller."""
OFF_THE_ROAD_M = 1.0
"""Mean deviation from which a figure writes a number instead of drawing a mark."""
_VEHICLES = ("kinematic", "dynamic")
_LEVELS = {"seen": 0, "interpolated": 1, "extrapolated": 2}


class Entry(NamedTuple):
    """One system with one access to e.

    Attributes:
        name: what a reader sees.
        system: name of the system, without its coordinates.
        env: access to e: "measured", "estimated" or "none".
        rows: by scenario.
    """

    name: str
    system: str
    env: str
    rows: dict[str, Row]

    @property
    def is_main(self) -> bool:
        """Whether this is SFKD with e measured."""
        return self.system == "sfkd" and self.env == "measured"

    def row(self, scenario: str) -> Row:
        """The row on a scenario, empty if there is none."""
        return self.rows.get(scenario) or {}

    def value(self, scenario: str, *keys: str) -> float | None:
        """A finite number of the row on a scenario, else None."""
        value = dig(self.rows.get(scenario), *keys)
        return value if is_number(value) else None

    def row_with(self, metric: Metric) -> Row:
        """The last row, by scenario, that has a metric no scenario changes."""
        rows = (self.rows[name] for name in sorted(self.rows, reverse=True))
        return next((row for row in rows if metric.value(row) is not None), {})


class Setup(NamedTuple):
    """Entries with one vehicle, one inner loop and one way of sampling."""

    vehicle: str
    inner_loop: str
    sampling: str | None
    entries: list[Entry]

    @property
    def vehicle_title(self) -> str:
        """The vehicle as text."""
        loop = " under a speed loop" if self.inner_loop == "speed" else ""
        return f"{self.vehicle.replace('_', ' ').capitalize()} vehicle{loop}"

    @property
    def title(self) -> str:
        """The vehicle and the sampling as text."""
        kind = SAMPLINGS.get(str(self.sampling), self.sampling)
        return f"{self.vehicle_title}, {kind}" if kind else self.vehicle_title

    @property
    def stem(self) -> str:
        """The vehicle as part of a file name."""
        return vehicle_stem({"vehicle": self.vehicle, "inner_loop": self.inner_loop})

    @property
    def scenarios(self) -> list[str]:
        """The scenarios, hardest last; rows without sampling add none."""
        return by_hardness(
            name
            for entry in self.entries
            for name, row in entry.rows.items()
            if self.sampling in (None, row.get("sampling"))
        )

    @property
    def hardest(self) -> str:
        """The last scenario."""
        return self.scenarios[-1]

    def entry(self, system: str) -> Entry | None:
        """The entry of a system, the one with e measured if there are several."""
        entries = [entry for entry in self.entries if entry.system == system]
        measured = [entry for entry in entries if entry.env == "measured"]
        return next(iter(measured or entries), None)

    def rows_on(self, scenario: str) -> list[Row]:
        """The rows on a scenario."""
        return [one.rows[scenario] for one in self.entries if scenario in one.rows]

    def owns(self, rows: list[Row]) -> bool:
        """Whether rows belong to this setup and not only to its sibling.

        Rows without sampling are in every setup; alone they count in the one that
        samples around a feedback law.
        """
        shared = bool(rows) and self.sampling in (None, "feedback")
        return shared or any(row.get("sampling") == self.sampling for row in rows)


def setups(rows: list[Row]) -> list[Setup]:
    """Group the rows without a variation; a row without sampling is in every setup."""
    rows = [row for row in rows if row.get("variation") is None]
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault(plant_of(row), []).append(row)
    made = []
    for plant in sorted(groups, key=lambda plant: (_index(plant[0], _VEHICLES), plant)):
        kinds = {str(row["sampling"]) for row in groups[plant] if row.get("sampling")}
        known = tuple(SAMPLINGS)
        for kind in sorted(kinds, key=lambda kind: (_index(kind, known), kind)) or [
            None
        ]:
            mine = [row for row in groups[plant] if row.get("sampling") in (kind, None)]
            made.append(Setup(*plant, kind, _entries(mine)))
    return made


def plant_of(row: Row) -> tuple[str, str]:
    """Vehicle and inner loop of a row."""
    return str(row.get("vehicle")), str(row.get("inner_loop"))


def _entries(rows: list[Row]) -> list[Entry]:
    """Entries in the order of every table; of equal rows the first counts."""
    entries: dict[tuple[str, str], Entry] = {}
    for row in rows:
        key = (family(str(row.get("system"))), str(row.get("env")))
        entry = entries.setdefault(key, Entry(name_of(row), *key, {}))
        entry.rows.setdefault(str(row.get("scenario")), row)
    return sorted(entries.values(), key=_order)


def _order(entry: Entry) -> tuple[tuple[int, str], str]:
    return rank(entry.system), entry.env


def _index(name: str, known: tuple[str, ...]) -> int:
    return known.index(name) if name in known else len(known)


def merged(group: list[Setup]) -> Setup:
    """The first setup of a group, with the entries that only others have."""
    union = {entry.name: entry for one in reversed(group) for entry in one.entries}
    return group[0]._replace(entries=sorted(union.values(), key=_order))


def by_hardness(names: Iterable[str]) -> list[str]:
    """Scenarios by name; steady levels by their distance from the training data."""
    return sorted(set(names), key=lambda name: (_LEVELS.get(name, 0), name))


def difference(setup: Setup, entry: Entry, scenario: str) -> Row | None:
    """RMSE minus that of the SFKD of this setup, with its paired interval.

    A row without sampling is in two setups but was compared in one; in the other the
    result is None.
    """
    main = setup.entry("sfkd")
    record = dig(entry.rows.get(scenario), "difference_to_sfkd")
    mean = dig(record, "mean")
    if main is None or not is_number(mean):
        return None
    same = _is_about(mean, entry, main, scenario, lambda a, b: a - b)
    return record if same else None


def ratio(setup: Setup, entry: Entry, scenario: str) -> float | None:
    """RMSE over that of the oracle of this setup, None if it is about another one."""
    oracle, value = setup.entry("oracle"), entry.value(scenario, "ratio_to_oracle")
    if value is None or oracle is None:
        return value
    same = _is_about(value, entry, oracle, scenario, lambda a, b: a / b if b else 0.0)
    return value if same else None


def _is_about(
    value: float,
    entry: Entry,
    other: Entry,
    scenario: str,
    combine: Callable[[float, float], float],
) -> bool:
    """Whether a comparison of an entry without sampling is about this other entry."""
    if entry.row(scenario).get("sampling"):
        return True
    ours, theirs = (one.value(scenario, "rmse_m", "mean") for one in (entry, other))
    if ours is None or theirs is None:
        return False
    return abs(combine(ours, theirs) - value) <= 1e-6 * max(1.0, abs(value))


def side(record: Any) -> int:
    """Sign of a difference to SFKD: 1 above zero, −1 below, 0 if it is undecided.

    It is decided by its p-value with Holm's correction. Results of older versions have
    none; there its interval must exclude zero.
    """
    mean, bounds = dig(record, "mean"), dig(record, "ci95")
    if not (is_number(mean) and is_pair(bounds)):
        return 0
    p = dig(record, "p_holm")
    excluded = p < LEVEL if is_number(p) else min(bounds) * max(bounds) > 0
    return (1 if mean > 0 else -1) if excluded else 0
