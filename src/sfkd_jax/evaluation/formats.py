"""JSON values as text: numbers, bounds and records. What is missing is an en dash."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, Context, Decimal
from functools import partial
from typing import Any

DASH = "–"
"""Text of a value that is missing."""


def dig(record: Any, *keys: str) -> Any:
    """Return the entry under nested keys, or None where one of them is absent.

    A key of a list is an index.
    """
    for key in keys:
        if isinstance(record, list):
            # A key that is no index is treated like one that is out of range.
            index = int(key) if key.lstrip("-").isdigit() else len(record)
            record = record[index] if -len(record) <= index < len(record) else None
        elif isinstance(record, dict):
            record = record.get(key)
        else:
            record = None
    return record


def is_number(value: Any) -> bool:
    """Return whether a JSON value is a finite number."""
    # True is an int in Python, but no number of a report.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value)


def is_pair(value: Any) -> bool:
    """Return whether a JSON value is a list of two finite numbers."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        return False
    return all(map(is_number, value))


def number(value: Any, digits: int = 3, *, scale: float = 1.0) -> str:
    """Return a number, or the mean of a record, times `scale`, with fixed decimals."""
    if isinstance(value, dict):
        value = dig(value, "mean")
    # Both values are checked: 1e308 m is a number, but in mm it is infinite.
    if not is_number(value) or not is_number(scale * value):
        return DASH
    return f"{scale * value:.{digits}f}".replace("-", "−")


def short(value: Any, digits: int = 3) -> str:
    """Return a number with so many significant digits, and an integer in full."""
    if not is_number(value):
        return DASH
    text = str(value) if isinstance(value, int) else f"{value:.{digits}g}"
    return text.replace("-", "−")


def upper(value: Any, digits: int = 4) -> str:
    """Return an upper bound, rounded up; one below 1 is never rounded up to 1."""
    if not is_number(value):
        return DASH
    exact = Decimal(repr(float(value)))
    rounded = Context(prec=digits, rounding=ROUND_CEILING).create_decimal(exact)
    # α = 0.99999 claims that a step contracts; α = 1 would claim nothing.
    if exact < 1 <= rounded and digits < 15:
        return upper(value, digits + 1)
    return short(float(rounded), digits)


millimetres = partial(number, digits=1, scale=1e3)
"""A length in m, or the mean of a record of lengths, as millimetres."""


def percent(share: Any) -> str:
    """Return a share in percent; one that is not zero is not shown as zero."""
    if not is_number(share):
        return DASH
    if share == 0:
        return "0"
    # Rounded to 0.0, a rare event would read as one that never happened.
    if 0 < share < 5e-4:
        return "< 0.1"
    return number(100 * share, 1)


def interval(bounds: Any, digits: int = 3, *, scale: float = 1.0) -> str:
    """Return two bounds as "low to high"."""
    if not is_pair(bounds):
        return DASH
    return " to ".join(number(bound, digits, scale=scale) for bound in bounds)


def mean_std(record: Any, digits: int = 3, *, scale: float = 1.0) -> str:
    """Return mean ± standard deviation of a record; without one, the mean alone."""
    mean = number(record, digits, scale=scale)
    std = number(dig(record, "std"), digits, scale=scale)
    return mean if std == DASH else f"{mean} ± {std}"


def plain(value: Any) -> str:
    """Return any JSON value as text.

    A record is "key value; …", a list is shown by its first 12 entries.
    """
    match value:
        case None:
            return DASH
        # This case comes before int, because bool is a subclass of int.
        case bool():
            return "yes" if value else "no"
        case int() | float():
            return short(value, 6)
        case dict():
            entries = []
            for key, entry in value.items():
                text = plain(entry)
                nested = isinstance(entry, dict)
                entries.append(f"{key} ({text})" if nested else f"{key} {text}")
            return "; ".join(entries) if entries else DASH
        case list() | tuple():
            entries = [plain(entry) for entry in value[:12]]
            if len(value) > 12:
                entries.append("…")
            return f"[{', '.join(entries)}]"
    return str(value)
