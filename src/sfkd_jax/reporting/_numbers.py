"""Values from JSON as finished strings: null and non-finite an en dash, upper bounds rounded up."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, Context, Decimal
from typing import Any

DASH = "–"


def dig(record: Any, *keys: str) -> Any:
    """The entry under nested keys, or None where any of them is absent."""
    for key in keys:
        record = record.get(key) if isinstance(record, dict) else None
    return record


def is_number(value: Any) -> bool:
    """Whether a JSON value is a finite number."""
    return (
        isinstance(value, int | float)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )


def number(value: Any, digits: int = 3) -> str:
    """A number with fixed decimals; the mean of a record; an en dash for null and the non-finite."""
    value = dig(value, "mean") if isinstance(value, dict) else value
    return f"{value:.{digits}f}".replace("-", "−") if is_number(value) else DASH


def short(value: Any, digits: int = 3) -> str:
    """A number to so many significant digits; whole numbers in full."""
    if not is_number(value):
        return DASH
    return (str(value) if isinstance(value, int) else f"{value:.{digits}g}").replace(
        "-", "−"
    )


def upper(value: Any, digits: int = 4) -> str:
    """An upper bound to so many significant digits, rounded up, but never up to 1 from below."""
    if not is_number(value):
        return DASH
    exact = Decimal(repr(float(value)))
    rounded = Context(prec=digits, rounding=ROUND_CEILING).create_decimal(exact)
    return (
        upper(value, digits + 1)
        if exact < 1 <= rounded and digits < 15
        else short(float(rounded), digits)
    )


def interval(bounds: Any, digits: int = 3) -> str:
    """Two bounds as "low to high"."""
    if (
        not isinstance(bounds, list | tuple)
        or len(bounds) != 2
        or not all(map(is_number, bounds))
    ):
        return DASH
    return f"{number(bounds[0], digits)} to {number(bounds[1], digits)}"


def mean_std(measure: Any, digits: int = 3) -> str:
    """Mean ± standard deviation."""
    mean, std = dig(measure, "mean"), dig(measure, "std")
    return (
        f"{number(mean, digits)} ± {number(std, digits)}"
        if is_number(std)
        else number(mean, digits)
    )


def plain(value: Any) -> str:
    """Any JSON value as words: records as "key value", lists by commas, null as an en dash."""
    match value:
        case None:
            return DASH
        case bool():
            return "yes" if value else "no"
        case int() | float():
            return short(value, 6)
        case dict():
            parts = [
                f"{key} ({plain(v)})" if isinstance(v, dict) else f"{key} {plain(v)}"
                for key, v in value.items()
            ]
            return "; ".join(parts) or DASH
        case list() | tuple():
            shown = ", ".join(plain(entry) for entry in value[:12])
            return f"[{shown}{', …' if len(value) > 12 else ''}]"
    return str(value)
