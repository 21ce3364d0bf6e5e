"""Names and settings, looked up and cut to what a factory takes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Settings = Mapping[str, Any]


def choose(table: Mapping[str, Any], name: str, what: str) -> Any:
    """`table[name]`, or an error that lists the choices."""
    if name not in table:
        raise ValueError(
            f"unknown {what} {name!r}; choose one of {', '.join(sorted(table))}"
        )
    return table[name]


def without(settings: Settings, *names: str) -> dict[str, Any]:
    """Settings of a factory, sequences as tuples: the rest after the names that choose it."""
    rest = {name: value for name, value in settings.items() if name not in names}
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in rest.items()
    }


def floats(values: Any) -> tuple[float, ...] | None:
    """Numbers as a tuple; None stays None."""
    return None if values is None else tuple(map(float, values))
