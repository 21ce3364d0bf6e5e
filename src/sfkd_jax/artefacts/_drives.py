"""What tells two drives of a run apart: the one identity of their rows, their arrays and their figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any
from urllib.parse import parse_qsl, urlencode

IDENTITY = (
    "system",
    "scenario",
    "vehicle",
    "inner_loop",
    "controller",
    "planner",
    "sampling",
    "env",
    "variation",
)
"""Rows of results.json that agree in these are the same row, and the later one replaces
the earlier.
"""
ROAD = ("envs", "path")
"""Arrays of the road that a drive met, beside what was driven on it."""
SHARED = tuple(name for name in IDENTITY if name not in ("system", "env"))
"""What systems that may be compared have in common, besides their roads."""


def identity(row: Mapping[str, Any]) -> dict[str, str | None]:
    """What tells a row apart; a row of an earlier version has the search that its controller is named after."""
    found = {name: row.get(name) for name in IDENTITY}
    if "planner" not in row and row.get("controller"):
        found["planner"] = (
            "mppi" if str(row["controller"]).startswith("mppi") else row["controller"]
        )
    if "inner_loop" not in row and "vehicle" in row:
        found["inner_loop"] = "none"
    return {
        name: None if value is None else str(value) for name, value in found.items()
    }


def merge(
    old: Iterable[Mapping[str, Any]], new: Iterable[Mapping[str, Any]]
) -> list[Any]:
    """New rows replace old ones with the same identity; the others stay."""
    fresh = list(new)
    replaced = [identity(row) for row in fresh]
    return [row for row in old if identity(row) not in replaced] + fresh


def drive_name(row: Mapping[str, Any]) -> str:
    """The name of a row's arrays in episodes.npz, as in "system=sfkd&scenario=s3/lateral" before the slash."""
    return urlencode(
        {name: value for name, value in identity(row).items() if value is not None}
    )


def parse_drive_name(name: str) -> dict[str, str]:
    """The identity behind a name; an earlier version wrote system/scenario."""
    return (
        dict(parse_qsl(name))
        if "=" in name
        else dict(zip(IDENTITY, name.split("/"), strict=False))
    )


def with_current_names(
    arrays: Mapping[str, Any], rows: Iterable[Mapping[str, Any]]
) -> dict[str, Any]:
    """The arrays of episodes.npz under the names of today.

    An earlier version named them system/scenario/part and the roads scenario/part;
    where several rows share a system and a scenario, the arrays were those of the last
    one.
    """
    today = {f"{row['system']}/{row['scenario']}": drive_name(row) for row in rows}
    found = {}
    for name, values in arrays.items():
        drive, _, part = name.rpartition("/")
        found[f"{today.get(drive, drive)}/{part}" if drive else part] = values
        if drive in today:
            scenario = drive.partition("/")[2]
            roads = {part: arrays.get(f"{scenario}/{part}") for part in ROAD}
            found |= {
                f"{today[drive]}/{part}": road
                for part, road in roads.items()
                if road is not None
            }
    return found
