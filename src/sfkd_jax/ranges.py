"""Ranges that annotate settings, and objects that settings name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, TypeAlias, get_args, get_type_hints


@dataclass(frozen=True)
class Interval:
    """The numbers between two ends: "(0, 1]" excludes 0 and includes 1."""

    text: str

    @property
    def ends(self) -> tuple[float, float]:
        """Both ends."""
        low, high = map(float, self.text[1:-1].split(","))
        return low, high

    def contains(self, value: int | float) -> bool:
        """Return whether the value lies in the interval."""
        low, high = self.ends
        above = low < value if self.text[0] == "(" else low <= value
        below = value < high if self.text[-1] == ")" else value <= high
        return above and below


class MayBeEmpty:
    """The sequence may have no entries; without it, it has at least one."""


class Ascending:
    """The entries of a sequence are in ascending order."""


Real: TypeAlias = Annotated[float, Interval("(-inf, inf)")]
Positive: TypeAlias = Annotated[float, Interval("(0, inf)")]
Fraction: TypeAlias = Annotated[float, Interval("(0, 1)")]
NonNegative: TypeAlias = Annotated[float, Interval("[0, inf)")]
UnitInterval: TypeAlias = Annotated[float, Interval("[0, 1]")]
NonNegativeInt: TypeAlias = Annotated[int, Interval("[0, inf)")]
AtLeastOne: TypeAlias = Annotated[int, Interval("[1, inf)")]
AtLeastTwo: TypeAlias = Annotated[int, Interval("[2, inf)")]
Span: TypeAlias = Annotated[tuple[Positive, Positive], Ascending()]
Numbers: TypeAlias = Annotated[tuple[float, ...], MayBeEmpty()]
"""Any number of numbers, none included."""
Names: TypeAlias = Annotated[tuple[str, ...], MayBeEmpty()]
"""Any number of names, none included."""
Bounds: TypeAlias = Annotated[tuple[Real, ...], MayBeEmpty()]
"""Lower or upper ends of intervals; no entries if they are unknown."""


def check_choice(setting: str, value: str, known: Iterable[str]) -> None:
    """Raise ValueError unless the value of a setting is one of the known words."""
    words = tuple(known)
    if value not in words:
        raise ValueError(f"{setting} must be one of {', '.join(words)}, got {value!r}")


def check_intervals(settings: object) -> None:
    """Raise a ValueError for a number of a dataclass outside its annotated interval.

    Every entry of a sequence must lie in the interval. None is accepted.
    """
    for name, hint in get_type_hints(type(settings), include_extras=True).items():
        value = getattr(settings, name, None)
        entries = value if isinstance(value, tuple) else (value,)
        for interval in _intervals(hint):
            if not all(entry is None or interval.contains(entry) for entry in entries):
                raise ValueError(f"{name} must be in {interval.text}, got {value}")


def _intervals(hint: Any) -> Iterator[Interval]:
    """Yield the intervals inside an annotation, as of `tuple[Positive, ...] | None`."""
    for part in get_args(hint):
        if isinstance(part, Interval):
            yield part
        else:
            yield from _intervals(part)


def imported(name: str, setting: str) -> Any:
    """Import and return "package.module:name"; the message names the setting."""
    module, _, attribute = name.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as reason:
        raise ValueError(
            f"{setting}={name}: {reason}; name it as package.module:function"
        ) from None


def in_words(names: Iterable[str], low: Iterable[float], high: Iterable[float]) -> str:
    """Return names with their limits for a person, as in "v [m/s] 3 to 12, …".

    They are printed, also where the output is ASCII alone.
    """
    rows = zip(names, low, high, strict=False)
    return ", ".join(f"{name} {least:.3g} to {most:.3g}" for name, least, most in rows)
