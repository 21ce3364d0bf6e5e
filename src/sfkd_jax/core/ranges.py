"""Ranges of settings, stated beside the argument: `temperature: Positive = 5.0`.

The command line reads them from the signatures of factories and refuses other values
before anything is built. Type checkers see `float`, `int` and `tuple`. Without an
annotation, a whole number is at least 1, any other number is finite and at least 0, and
a sequence has at least one entry.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, TypeAlias


@dataclass(frozen=True)
class Interval:
    """The numbers between two ends: "(0, 1]" excludes 0 and includes 1."""

    text: str

    def contains(self, value: int | float) -> bool:
        """Return whether the value lies in the interval."""
        low, high = map(float, self.text[1:-1].split(","))
        above = low < value if self.text[0] == "(" else low <= value
        below = value < high if self.text[-1] == ")" else value <= high
        return above and below


@dataclass(frozen=True)
class Entries:
    """The number of entries of a sequence: at least `least`, or exactly `exactly`."""

    least: int = 1
    exactly: int | None = None


@dataclass(frozen=True)
class Ascending:
    """The entries of a sequence are in ascending order."""


Real: TypeAlias = Annotated[float, Interval("(-inf, inf)")]
Positive: TypeAlias = Annotated[float, Interval("(0, inf)")]
Fraction: TypeAlias = Annotated[float, Interval("(0, 1)")]
PositiveFraction: TypeAlias = Annotated[float, Interval("(0, 1]")]
UnitInterval: TypeAlias = Annotated[float, Interval("[0, 1]")]
NonNegativeInt: TypeAlias = Annotated[int, Interval("[0, inf)")]
AtLeastTwo: TypeAlias = Annotated[int, Interval("[2, inf)")]
Span: TypeAlias = Annotated[tuple[Positive, Positive], Ascending()]
Numbers: TypeAlias = Annotated[tuple[float, ...], Entries(least=0)]
"""Any number of numbers, none included."""
Names: TypeAlias = Annotated[tuple[str, ...], Entries(least=0)]
"""Any number of names, none included."""
Bounds: TypeAlias = Annotated[tuple[Real, ...], Entries(least=0)]
"""Lower or upper ends of intervals; none where they are unknown."""
