"""JSON values as text: numbers, bounds and records; an en dash for what is missing."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, Context, Decimal
from functools import partial
from typing import Any

DASH = "–"


def dig(record: Any, *keys: str) -> Any:
    """The entry under nested keys (indices of lists), None where one is absent."""
    for key in keys:
        if isinstance(record, list):
            index = int(key) if key.lstrip("-").isdigit() else len(record)
            record = record[index] if -len(record) <= index < len(record) else None
        else:
            record = record.get(key) if isinstance(record, dict) else None
    return record


def is_number(value: Any) -> bool:
    """Whether a JSON value is a finite number."""
    # True is an int in Python and no number here.
    real = isinstance(value, int | float) and not isinstance(value, bool)
    return real and math.isfinite(value)


def is_pair(value: Any) -> bool:
    """Whether a JSON value is a list of two finite numbers."""
    pair = isinstance(value, list | tuple) and len(value) == 2
    return pair and all(map(is_number, value))


def number(value: Any, digits: int = 3, *, scale: float = 1.0) -> str:
    """A number, or the mean of a record, times `scale`, with fixed decimals."""
    value = dig(value, "mean") if isinstance(value, dict) else value
    # Scaled first: 1e308 m is a number, and in mm it is none.
    value = scale * value if is_number(value) else None
    return f"{value:.{digits}f}".replace("-", "−") if is_number(value) else DASH


def short(value: Any, digits: int = 3) -> str:
    """A number to so many significant digits, an integer in full."""
    if not is_number(value):
        return DASH
    text = str(value) if isinstance(value, int) else f"{value:.{digits}g}"
    return text.replace("-", "−")


def upper(value: Any, digits: int = 4) -> str:
    """An upper bound, rounded up, but never up to 1 from below."""
    if not is_number(value):
        return DASH
    exact = Decimal(repr(float(value)))
    rounded = Context(prec=digits, rounding=ROUND_CEILING).create_decimal(exact)
    # α = 0.99999 is a claim, 1 is none.
    if exact < 1 <= rounded and digits < 15:
        return upper(value, digits + 1)
    return short(float(rounded), digits)


millimetres = partial(number, digits=1, scale=1e3)
"""A length in m, or the mean of a record of lengths, as millimetres."""


def percent(share: Any) -> str:
    """A share in percent; one that is not zero is not shown as zero."""
    if not is_number(share):
        return DASH
    if share == 0:
        return "0"
    # Rounded to 0 it would read as if it never happened.
    return "< 0.1" if 0 < share < 5e-4 else number(100 * share, 1)


def interval(bounds: Any, digits: int = 3, *, scale: float = 1.0) -> str:
    """Two bounds as "low to high"."""
    if not is_pair(bounds):
        return DASH
    return " to ".join(number(bound, digits, scale=scale) for bound in bounds)


def mean_std(record: Any, digits: int = 3, *, scale: float = 1.0) -> str:
    """Mean ± standard deviation of a record."""
    mean = number(record, digits, scale=scale)
    std = number(dig(record, "std"), digits, scale=scale)
    return mean if std == DASH else f"{mean} ± {std}"


def plain(value: Any) -> str:
    """Any JSON value: a record as "key value; …", a list by its first 12 entries."""
    match value:
        case None:
            return DASH
        # Before int: bool is one.
        case bool():
            return "yes" if value else "no"
        case int() | float():
            return short(value, 6)
        case dict():
            shown = (
                f"{key} ({plain(one)})"
                if isinstance(one, dict)
                else f"{key} {plain(one)}"
                for key, one in value.items()
            )
            return "; ".join(shown) or DASH
        case list() | tuple():
            shown = ", ".join(plain(entry) for entry in value[:12])
            return f"[{shown}{', …' if len(value) > 12 else ''}]"
    return str(value)
