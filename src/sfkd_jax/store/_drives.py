"""Identify the drives of a run: their rows, arrays and figures."""

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
"""Columns that identify a row of results.json; a new row replaces the old row of the
same identity.
"""
ROAD = ("envs", "path")
"""Arrays that describe the environment and the path of a drive."""
SHARED = tuple(name for name in IDENTITY if name not in ("system", "env"))
"""Columns that systems must share to be compared."""


def identity(row: Mapping[str, Any]) -> dict[str, str | None]:
    """Return the identity of a row.

    Rows of earlier versions have no planner; their controller is named after it.
    """
    columns = {name: row.get(name) for name in IDENTITY}
    if "planner" not in row and row.get("controller"):
        columns["planner"] = (
            "mppi" if str(row["controller"]).startswith("mppi") else row["controller"]
        )
    if "inner_loop" not in row and "vehicle" in row:
        columns["inner_loop"] = "none"
    return {
        name: None if value is None else str(value) for name, value in columns.items()
    }


def merge(
    old: Iterable[Mapping[str, Any]], new: Iterable[Mapping[str, Any]]
) -> list[Any]:
    """Return old and new rows; a new row replaces the old row of the same identity."""
    fresh = list(new)
    replaced = [identity(row) for row in fresh]
    return [row for row in old if identity(row) not in replaced] + fresh


def drive_name(row: Mapping[str, Any]) -> str:
    """Return the prefix of a row's arrays, such as "system=sfkd&scenario=s3"."""
    return urlencode(
        {name: value for name, value in identity(row).items() if value is not None}
    )


def parse_drive_name(name: str) -> dict[str, str]:
    """Return the identity in a name; earlier versions wrote system/scenario."""
    return (
        dict(parse_qsl(name))
        if "=" in name
        else dict(zip(IDENTITY, name.split("/"), strict=False))
    )


def with_current_names(
    arrays: Mapping[str, Any], rows: Iterable[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return the arrays of episodes.npz under the names of this version.

    An earlier version named them system/scenario/part, and those of the path and the
    environment scenario/part. Where several rows share system and scenario, the arrays
    belong to the last one.
    """
    current = {f"{row['system']}/{row['scenario']}": drive_name(row) for row in rows}
    result = {}
    for name, values in arrays.items():
        drive, _, part = name.rpartition("/")
        result[f"{current.get(drive, drive)}/{part}" if drive else part] = values
        if drive in current:
            scenario = drive.partition("/")[2]
            roads = {part: arrays.get(f"{scenario}/{part}") for part in ROAD}
            result |= {
                f"{current[drive]}/{part}": road
                for part, road in roads.items()
                if road is not None
            }
    return result
