"""From JSON of an untrusted source to dataclasses, as their annotations say."""

from __future__ import annotations

import math
import types
import typing
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

from sfkd_jax.certificate._proof import Corners
from sfkd_jax.ranges import Ascending, Interval

T = TypeVar("T")


def read_as(kind: type[T], value: Any, where: str = "") -> T:
    """Return a JSON value as an object of a dataclass, with lists as tuples.

    Numbers must be finite and in the interval of their annotation. An entry may only
    be left out if it has a default.

    Args:
        kind: the dataclass.
        value: what `json.loads` returned.
        where: name of the entry, for messages.

    Raises:
        ValueError: an entry is missing, unknown, or of another type or range; names it.
    """
    _require(isinstance(value, dict), f"{where or 'it'} is not an object")
    prefix = f"{where}." if where else ""
    hints = _hints(kind)
    for key in value:
        # Somebody might read what nothing has checked.
        _require(key in hints, f"{prefix}{key!a:.80} is not an entry of a certificate")
    entries = {}
    for name, (hint, has_default) in hints.items():
        _require(has_default or name in value, f"{prefix}{name} is missing")
        if name in value:
            entries[name] = _entry(hint, value[name], prefix + name)
    return kind(**entries)


@cache
def _hints(kind: type) -> dict[str, tuple[Any, bool]]:
    """Return the annotation of every field, and whether it has a default."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {
        entry.name: (hints[entry.name], entry.default is not MISSING)
        for entry in fields(typing.cast(Any, kind))
    }


def _entry(hint: Any, value: Any, where: str) -> Any:
    """Return a JSON value as its annotation says, or raise a ValueError."""
    origin = typing.get_origin(hint)
    parts = typing.get_args(hint)
    if hint is Any:
        return value
    if origin is typing.Annotated:
        entry = _entry(parts[0], value, where)
        for mark in parts[1:]:
            _check(mark, entry, where)
        return entry
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _entry(parts[0], value, where)
    if is_dataclass(hint):
        return read_as(typing.cast(type, hint), value, where)
    if origin is dict:
        _require(isinstance(value, dict), f"{where} is not an object")
        return {
            key: _entry(parts[1], each, f"{where}.{key:.80}")
            for key, each in value.items()
        }
    if origin is tuple:
        return _sequence(parts, value, where)
    if hint is float:
        return _number(value, where)
    # True is an int in Python, and an int may be a float to a reader.
    _require(type(value) is hint, f"{where} = {value!a:.60} is no {hint.__name__}")
    return value


def _sequence(parts: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    """Return a list as a tuple of any length, or of one entry per part."""
    _require(isinstance(value, list), f"{where} is not a list")
    if parts[-1] is not Ellipsis:
        _require(len(value) == len(parts), f"{where} is not a list of {len(parts)}")
    # Nearly all of a certificate are rows of numbers, which need no names.
    elif parts[0] is float and {*map(type, value)} == {float}:
        _require(
            all(map(math.isfinite, value)), f"{where} has numbers that are not finite"
        )
        return tuple(value)
    return tuple(
        _entry(parts[0], each, f"{where}.{number}") for number, each in enumerate(value)
    )


def _number(value: Any, where: str) -> float:
    """Return a finite number; other programs write 1.0 as 1."""
    is_number = type(value) in (int, float)
    # Larger integers have no float.
    is_finite = is_number and abs(value) < 2**1023 and math.isfinite(value)
    _require(is_finite, f"{where} = {value!a:.60} is not a finite number")
    return float(value)


def _check(mark: Any, entry: Any, where: str) -> None:
    """Refuse an entry that is not what the mark of its annotation says."""
    if isinstance(mark, Interval):
        _require(mark.contains(entry), f"{where} = {entry!a:.60} is not in {mark.text}")
    elif isinstance(mark, Corners):
        low, high = entry
        ordered = len(low) == len(high) and all(map(float.__le__, low, high))
        _require(ordered, f"{where} is not a lower and an upper corner")
    elif isinstance(mark, Ascending):
        ascending = all(a <= b for a, b in pairwise(entry))
        _require(ascending, f"{where} is not in ascending order")


def _require(holds: bool, reason: str) -> None:
    """Raise a ValueError with the reason unless a condition holds."""
    if not holds:
        raise ValueError(reason)
