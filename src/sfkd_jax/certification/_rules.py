"""Rules for the entries of a document from an untrusted source, and their application.

A proved entry only has to be made of numbers here: the trusted core checks it, in
another file. An entry that follows is derived again. A measured entry lies in a range,
within which only a signature could bind it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sfkd_jax.certification._weights import require

REPEATED = 1e-9
"""Relative tolerance of values that are computed again. The order of summation may be
another one.
"""
LARGEST = 1e6
"""Largest measured length, angle or time, far beyond any vehicle."""


class Proved:
    """An entry that the trusted core checks with its witness."""


class Follows(NamedTuple):
    """An entry that is derived again.

    Attributes:
        value: derived value. A dictionary must have exactly these keys.
        tolerance: relative tolerance of numbers.
    """

    value: Any
    tolerance: float = REPEATED


class Measured(NamedTuple):
    """An entry that nothing binds within its range, since the document is not signed.

    Attributes:
        low: smallest value, or one per component.
        high: largest value, or one per component.
        value_type: float, int or str.
        share_of: n if the value is a share of n, else 0.
    """

    low: Any = 0.0
    high: Any = LARGEST
    value_type: type = float
    share_of: int = 0


Rule: TypeAlias = Proved | Follows | Measured | dict[str, Any] | list[Any]
"""The rule of an entry, or the rules of all entries of an object or a list."""


def require_entry(where: str, stated: Any, rule: Rule) -> None:
    """Refuse the first entry that its rule does not allow.

    Args:
        where: name of the entry; "" for the whole document.
        stated: value of the entry.
        rule: that it has to obey.

    Raises:
        CertificationRefused: names the entry.
    """
    if isinstance(rule, dict):
        require(isinstance(stated, dict), f"{where or 'it'} is not an object")
        # Keys without a rule are refused, because somebody might read what nothing
        # checks.
        for key in dict.fromkeys([*rule, *stated]):
            name = f"{where}.{key}".removeprefix(".")
            require(key in stated, f"{name} is missing")
            require(key in rule, f"{name!a} is not an entry of a certificate")
            require_entry(name, stated[key], rule[key])
    elif isinstance(rule, list):
        fits = isinstance(stated, list) and len(stated) == len(rule)
        require(fits, f"{where} is not a list of {len(rule)}")
        for index, (entry, entry_rule) in enumerate(zip(stated, rule, strict=True)):
            require_entry(f"{where}.{index}", entry, entry_rule)
    elif isinstance(rule, Follows):
        follows = _equal(stated, rule.value, rule.tolerance)
        require(follows, f"{where} does not follow from the policy and other entries")
    elif isinstance(rule, Measured):
        low = np.asarray(rule.low).tolist()
        high = np.asarray(rule.high).tolist()
        within = f"{rule.value_type.__name__} from {low} to {high}"
        require(_in_range(stated, rule), f"{where} = {stated!a:.60} is no {within}")
    else:
        require(_is_finite(stated), f"{where} is not made of finite numbers")


def _is_finite(value: Any) -> bool:
    """Return whether a value is a finite number, or lists of nothing else."""
    if isinstance(value, list):
        return all(map(_is_finite, value))
    # True is an int in Python, and "1" is a number to numpy. Neither may pass.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value)


def _in_range(stated: Any, rule: Measured) -> bool:
    """Return whether a measured entry is of its type and between its limits."""
    if rule.value_type is str:
        return isinstance(stated, str) and stated.isprintable() and len(stated) < 200
    if rule.value_type is int and type(stated) is not int:
        return False
    if not _is_finite(stated) or np.shape(stated) != np.shape(rule.low):
        return False
    # A share of n is a whole number divided by n.
    count = rule.share_of * stated if rule.share_of else 0.0
    is_share = abs(count - round(count)) <= REPEATED * max(count, 1.0)
    values = np.asarray(stated)
    inside = np.all((rule.low <= values) & (values <= np.asarray(rule.high)))
    return bool(inside) and is_share


def _equal(stated: Any, derived: Any, tolerance: float) -> bool:
    """Return whether an entry is what is derived: numbers nearly, all else exactly."""
    if isinstance(derived, dict):
        # All keys: nothing else would check a value that is left out here.
        return (
            isinstance(stated, dict)
            and set(stated) == set(derived)
            and all(_equal(stated[key], derived[key], tolerance) for key in derived)
        )
    expected = np.asarray(derived)
    if isinstance(derived, int) or expected.dtype.kind not in "if":
        return type(stated) is type(derived) and stated == derived
    # Both must be finite: any number is within a share of an infinite one.
    if not (_is_finite(stated) and _is_finite(expected.tolist())):
        return False
    actual = np.asarray(stated)
    # Relative to the derived value, which a forger cannot choose.
    near = np.abs(actual - expected) <= tolerance * np.abs(expected)
    return actual.shape == expected.shape and bool(np.all(near))
