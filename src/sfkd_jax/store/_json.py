"""Parse JSON strictly; refuse documents that two parsers could read differently."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from typing import Any, NoReturn

MAX_DEPTH = 64
"""Levels of a document; documents of this package have at most 7. The limit lets code
that reads a document recurse.
"""
SMALLEST_INT, LARGEST_INT = -(2**63), 2**64 - 1
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")


def parse(text: bytes) -> Any:
    """Return the value in `text`, which is UTF-8 with or without a byte order mark.

    Raises:
        ValueError: no JSON; NaN or an infinity, also as a number that overflows; an
            integer beyond 64 bits; a duplicate key in one object; half of a surrogate
            pair; or more levels than MAX_DEPTH.
    """
    try:
        document = json.loads(
            text.decode("utf-8-sig"), parse_constant=_refuse, object_pairs_hook=_object
        )
    except RecursionError:
        raise ValueError(f"more than {MAX_DEPTH} levels") from None
    _check(document)
    if _SURROGATE.search(text):
        json.dumps(document, ensure_ascii=False).encode()
    return document


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice[:60]!r} occurs twice in one object")
    return document


def _check(document: Any) -> None:
    """Check all values, level by level and without recursion."""
    level: Iterable[Any] = [document]
    for _ in range(MAX_DEPTH + 1):
        inner: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                inner.extend(value.values())
            elif isinstance(value, list):
                inner.extend(value)
            elif isinstance(value, float) and not math.isfinite(value):
                raise ValueError("a number is larger than float64 holds")
            elif isinstance(value, int) and not SMALLEST_INT <= value <= LARGEST_INT:
                raise ValueError("an integer does not fit into 64 bits")
        if not inner:
            return
        level = inner
    raise ValueError(f"more than {MAX_DEPTH} levels")
