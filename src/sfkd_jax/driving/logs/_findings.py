"""Findings about recorded runs: lines for the user, and whether a run is refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from sfkd_jax.driving.logs._logs import Log


class Finding(NamedTuple):
    """One line about a log, and whether the log is refused for it."""

    line: str
    refused: bool = True


def warning(line: str) -> Finding:
    """Return a line for which the log is not refused."""
    return Finding(line, refused=False)


def first_of(
    log: Log,
    bad: Bool[np.ndarray, " row"],
    text: Callable[[int], str],
    *,
    hint: str = "",
    refused: bool = True,
) -> Iterator[Finding]:
    """Yield one line about the first bad row or step, with their number; or nothing.

    Args:
        log: the run.
        bad: one entry per row, or one per step. A step is named by the row after it.
        text: says what is wrong at an index of `bad`.
        hint: is appended to the line.
        refused: whether the log is refused.
    """
    if bad.any():
        index = int(bad.argmax())
        row = index + len(log.time) - len(bad)
        line = f"{log.at(row)}: {text(index)}{more(bad)}{hint}"
        yield Finding(line, refused)


def more(bad: Bool[np.ndarray, " row"]) -> str:
    """Return how many bad rows there are, for messages; "" for a single one."""
    return f" ({bad.sum()} rows like this)" if bad.sum() > 1 else ""
