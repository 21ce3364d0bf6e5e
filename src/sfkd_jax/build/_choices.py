"""Look up names in registries and turn settings into keyword arguments."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Settings = Mapping[str, Any]


def choose(table: Mapping[str, Any], name: str, what: str) -> Any:
    """Return `table[name]`.

    Args:
        table: choices by name.
        name: of one of them.
        what: the name stands for, for the message.

    Raises:
        ValueError: no such name; the message lists the choices.
    """
    if name not in table:
        raise ValueError(
            f"unknown {what} {name!r}; choose one of {', '.join(sorted(table))}"
        )
    return table[name]


def as_kwargs(settings: Settings, *skip: str) -> dict[str, Any]:
    """Return settings as keyword arguments of a factory, with lists as tuples.

    Args:
        settings: by the names of the factory's arguments.
        skip: settings that are no arguments of it.
    """
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in settings.items()
        if name not in skip
    }


def floats(values: Any) -> tuple[float, ...] | None:
    """Numbers as a tuple; None stays None."""
    return None if values is None else tuple(map(float, values))
