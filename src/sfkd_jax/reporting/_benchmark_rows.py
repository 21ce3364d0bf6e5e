"""Rows of a comparison as contests: who may be held against whom, what each row is called, what the paper has."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

from sfkd_jax.artefacts import identity
from sfkd_jax.reporting._numbers import dig, is_number
from sfkd_jax.reporting._style import SYSTEMS, family, label, ordered

Row: TypeAlias = dict[str, Any]

VARIANTS = {"icode_mppi_one_step": "icode_mppi", "icode_mppi_reads_env": "icode_mppi"}
"""Systems that the paper has under one name."""
OFF_THE_ROAD_M = 1.0
"""A mean deviation beyond it is not driving: figures write it, so that the rows that
drive share the axis.
"""
SELF_EVIDENT = ("nominal", "oracle", "law")
"""Systems whose name says what they are told; so do those of SFKD and its parts."""
_SAMPLINGS = {
    "feedback": "sampling around a feedback law",
    "plain": "plain sampling",
    "law": "path coordinates, sampling around their law",
}
_VEHICLES = ("kinematic", "dynamic")
_LEVELS = ("seen", "interpolated", "extrapolated")


class Line(NamedTuple):
    """One system with one access to the environment, its rows by scenario."""

    name: str
    system: str
    env: str
    rows: dict[str, Row]


class Contest(NamedTuple):
    """Lines that may be compared: one vehicle, one inner loop, one way of sampling."""

    vehicle: str
    inner_loop: str
    sampling: str | None
    lines: list[Line]


def name_of(row: Row) -> str:
    """What a reader sees for a row: its system, and what it is told of the environment where that is not plain."""
    system, env = family(str(row.get("system"))), str(row.get("env"))
    shown = label(system)
    if env == "estimated":
        return f"{shown} (e estimated)"
    if system in SELF_EVIDENT or system.startswith("sfkd"):
        return shown
    return (
        f"{shown} (e)"
        if env == "measured"
        else f"{shown} (no e)"
        if env == "none"
        else shown
    )


def search_words(row: Row) -> str:
    """How the controls of a row were searched; controller and planner where they are not the usual ones."""
    sampling, controller = row.get("sampling"), row.get("controller")
    words = [_SAMPLINGS.get(str(sampling), str(sampling))] if sampling else []
    words += [f"controller {controller}"] if controller not in (None, "mppi") else []
    planner = identity(row)["planner"]
    words += (
        [f"planner {planner}"]
        if planner != identity({"controller": controller})["planner"]
        else []
    )
    return ", ".join(words)


def contests(rows: list[Row]) -> list[Contest]:
    """The rows of the plain protocol, sorted; a row whose controller samples nothing stands in every contest."""
    plain = [row for row in rows if row.get("variation") is None]
    places = {
        (str(row.get("vehicle")), str(row.get("inner_loop"))): None for row in plain
    }
    found = []
    for place in sorted(places, key=lambda place: (_place(place[0], _VEHICLES), place)):
        here = [
            row
            for row in plain
            if (str(row.get("vehicle")), str(row.get("inner_loop"))) == place
        ]
        kinds = {str(row["sampling"]) for row in here if row.get("sampling")}
        for kind in sorted(
            kinds, key=lambda kind: (_place(kind, tuple(_SAMPLINGS)), kind)
        ) or [None]:
            found.append(
                Contest(
                    *place,
                    kind,
                    _lines(
                        [row for row in here if row.get("sampling") in (kind, None)]
                    ),
                )
            )
    return found


def _lines(rows: list[Row]) -> list[Line]:
    lines: dict[tuple[str, str], Line] = {}
    for row in rows:
        key = (family(str(row.get("system"))), str(row.get("env")))
        lines.setdefault(key, Line(name_of(row), *key, {})).rows.setdefault(
            str(row.get("scenario")), row
        )
    return [lines[key] for key in sorted(lines, key=lambda key: (rank(key[0]), key[1]))]


def drawn_for(contest: Contest, rows: list[Row]) -> list[Row]:
    """Rows for a figure of a contest: not those without sampling alone, which stand with feedback already."""
    own = contest.sampling in (None, "feedback") or any(
        row.get("sampling") == contest.sampling for row in rows
    )
    return rows if own else []


def together(group: list[Contest]) -> Contest:
    """The first contest of a group, with the lines that only others have."""
    union = {line.name: line for contest in reversed(group) for line in contest.lines}
    return group[0]._replace(
        lines=sorted(union.values(), key=lambda line: (rank(line.system), line.env))
    )


def rank(system: str) -> tuple[int, str]:
    """The place of a system in every table: the order of the house."""
    order = ordered([*SYSTEMS])
    return (order.index(system) if system in order else len(order), system)


def _place(name: str, known: tuple[str, ...]) -> int:
    return known.index(name) if name in known else len(known)


def title(contest: Contest) -> str:
    """What the lines of a contest have in common."""
    kind = _SAMPLINGS.get(str(contest.sampling), contest.sampling)
    return f"{vehicle_title(contest)}, {kind}" if kind else vehicle_title(contest)


def vehicle_title(contest: Contest) -> str:
    """The vehicle in words."""
    loop = " under a speed loop" if contest.inner_loop == "speed" else ""
    return f"{contest.vehicle.capitalize()} vehicle{loop}"


def stem(contest: Contest) -> str:
    """The vehicle as part of a file's name."""
    words = (
        contest.vehicle
        if contest.inner_loop in ("none", "None")
        else f"{contest.vehicle}_{contest.inner_loop}"
    )
    return "".join(letter if letter.isalnum() else "_" for letter in words)


def scenarios(contest: Contest) -> list[str]:
    """The scenarios of a contest, the hardest last; not those of a line alone that stands in other contests too."""
    rows = [(name, row) for line in contest.lines for name, row in line.rows.items()]
    return by_hardness(
        {name for name, row in rows if contest.sampling in (None, row.get("sampling"))}
    )


def by_hardness(names: set[str]) -> list[str]:
    """Scenarios by name, but steady levels by how far they lie from training."""
    return sorted(names, key=lambda name: (_place(name, _LEVELS) % len(_LEVELS), name))


def is_quoted(group: list[Contest], paper: dict[str, dict[str, float]]) -> bool:
    """Whether the paper has a number for any scenario of these contests."""
    driven = {name for contest in group for name in scenarios(contest)}
    return any(f"rmse_{name}_m" in row for name in driven for row in paper.values())


def measure(line: Line, scenario: str, *keys: str) -> float | None:
    """A finite number of a line's row, else None."""
    value = dig(line.rows.get(scenario), *keys)
    return value if is_number(value) else None


def known(line: Line, *keys: str) -> Any:
    """What no scenario changes: the first that is not null, from the hardest scenario down."""
    found = (dig(line.rows[name], *keys) for name in sorted(line.rows, reverse=True))
    return next((value for value in found if value is not None), None)


def line_of(contest: Contest, system: str, env: str = "measured") -> Line | None:
    """The line of a system, preferring one access to the environment."""
    lines = [line for line in contest.lines if line.system == system]
    return next(
        (line for line in lines if line.env == env), lines[0] if lines else None
    )


def difference(contest: Contest, line: Line, scenario: str) -> Row | None:
    """RMSE minus that of the contest's own SFKD, with its paired interval; None where it is about another SFKD.

    A row whose controller samples nothing stands in two contests but was compared in
    one.
    """
    own, found = (
        line_of(contest, "sfkd"),
        dig(line.rows.get(scenario), "difference_to_sfkd"),
    )
    if own is None or not is_number(dig(found, "mean")):
        return None
    return (
        found
        if _about(found["mean"], line, own, scenario, lambda a, b: a - b)
        else None
    )


def ratio(contest: Contest, line: Line, scenario: str) -> float | None:
    """RMSE over that of the contest's own oracle, None where it is about another oracle."""
    oracle, found = (
        line_of(contest, "oracle"),
        measure(line, scenario, "ratio_to_oracle"),
    )
    if found is None or oracle is None:
        return found
    return (
        found
        if _about(found, line, oracle, scenario, lambda a, b: a / b if b else 0.0)
        else None
    )


def _about(found: float, line: Line, other: Line, scenario: str, combine: Any) -> bool:
    """Whether a comparison is about this other line; only rows without sampling can be about another one."""
    if (line.rows.get(scenario) or {}).get("sampling"):
        return True
    ours, theirs = (measure(one, scenario, "rmse_m", "mean") for one in (line, other))
    return (
        ours is not None
        and theirs is not None
        and abs(combine(ours, theirs) - found) <= 1e-6 * max(1.0, abs(found))
    )


def side(bounds: Any) -> int:
    """Where an interval lies: 1 above zero, −1 below, 0 if it holds zero or is none."""
    if (
        not isinstance(bounds, list | tuple)
        or len(bounds) != 2
        or not all(map(is_number, bounds))
    ):
        return 0
    return 1 if min(bounds) > 0 else -1 if max(bounds) < 0 else 0


def paper_of(results: dict[str, Any]) -> dict[str, dict[str, float]]:
    """The paper's Table 1: system -> column -> number."""
    paper = dig(results, "config", "comparison", "paper") or {}
    columns = paper.get("columns") or []
    found = {
        name: values
        for name, values in paper.items()
        if name != "columns" and isinstance(values, list)
    }
    table = {
        name: dict(zip(columns, values, strict=False)) for name, values in found.items()
    }
    return {
        name: table[printed] for name, printed in VARIANTS.items() if printed in table
    } | table
