"""Units in column names, such as x(m) or speed [km/h], and their conversion to SI."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from typing import Any, NamedTuple

DIMENSIONS = {
    "time": "s",
    "length": "m",
    "angle": "rad",
    "speed": "m/s",
    "angular rate": "rad/s",
    "acceleration": "m/s²",
    "curvature": "1/m",
    "force": "N",
    "torque": "Nm",
    "voltage": "V",
    "current": "A",
    "pressure": "Pa",
    "ratio": "-",
}
"""Symbols of SI units by dimension. Other dimensions are unknown: no car logs them, and
pint takes many a remark in brackets for a unit (mu: milli unified atomic mass).
"""
SPELLINGS = {
    "-": "dimensionless",
    "1": "dimensionless",
    "g": "standard_gravity",
    "G": "standard_gravity",
    "kmh": "km/h",
    "Nm": "N*m",
    "kNm": "kN*m",
}
"""Spellings in logs that pint does not know, or takes for something else."""
_TERM = r"[A-Za-zµμ°%]+(?:\^?[1-4]|[²³])?"
WRITTEN = re.compile(rf"(?:1|{_TERM})(?:\s*[ */·]\s*{_TERM})*")
"""What is shown to pint, which computes whatever is written: 9**9**9 takes for ever."""


class Unit(NamedTuple):
    """A known unit.

    Attributes:
        dimension: of `DIMENSIONS`.
        factor: to its SI unit.
    """

    dimension: str
    factor: float


class Match(NamedTuple):
    """A column of a file that holds a configured column.

    Attributes:
        header: its name in the file.
        factor: by which its numbers are multiplied.
        conversion: for the user, or None if the numbers are left as they are.
    """

    header: str
    factor: float = 1.0
    conversion: str | None = None


@cache
def _registry() -> tuple[Any, dict[str, str]]:
    """Pint's units, and the dimension of every SI unit in base units.

    Raises:
        ValueError: pint is not installed.
    """
    try:
        import pint
    except ImportError:
        raise ValueError(
            'units in column names need pint: pip install "sfkd-jax[train]"'
        ) from None
    units = pint.UnitRegistry()
    bases = {
        _base(units, SPELLINGS.get(symbol, symbol))[1]: name
        for name, symbol in DIMENSIONS.items()
    }
    return units, bases


def _base(units: Any, written: str) -> tuple[float, str]:
    """The factor of a unit to base units, and these."""
    factor, base = units.get_base_units(units.parse_units(written))
    return float(factor), str(base)


@cache
def find_unit(symbol: str) -> Unit | None:
    """Look a unit up by its symbol, as written or in small letters."""
    for spelling in (symbol, symbol.lower()):
        written = SPELLINGS.get(spelling, spelling)
        if not WRITTEN.fullmatch(written) and written != "standard_gravity":
            continue
        # m/s2 means m/s^2.
        power = re.sub(r"(?<=[A-Za-z])([1-4])", r"^\1", written).replace("·", "*")
        units, bases = _registry()
        try:
            factor, base = _base(units, power)
        except Exception:  # of pint's parser, nearly anything
            continue
        if base in bases:
            return Unit(bases[base], factor)
    return None


def split_unit(header: str) -> tuple[str, str] | None:
    """Split "x(m)" or "x [m]" into name and unit; None without a unit."""
    parts = re.fullmatch(r"(.*?\S)\s*(?:\(([^()]*)\)|\[([^\[\]]*)\])", header.strip())
    if parts is None:
        return None
    name, round_, square = parts.groups()
    return name, (round_ if square is None else square).strip()


def name_of(header: str) -> str:
    """Return the name of a column without its unit."""
    return (split_unit(header) or (header,))[0]


def with_unit_row(names: list[str], cells: list[str]) -> list[str] | None:
    """Return names with the units of the line below them; None if it has no units.

    Args:
        names: of the columns.
        cells: of the first line below.
    """
    symbols = [cell.strip("()[] ") for cell in cells]
    # A row of data has numbers; "1" and "-" alone do not make a line of units.
    if len(cells) != len(names) or any(symbol[:1].isdigit() for symbol in symbols):
        return None
    if not all(symbol == "" or find_unit(symbol) for symbol in symbols):
        return None
    if not any(symbol.strip("-") for symbol in symbols):
        return None
    return [
        f"{name} [{symbol}]" if symbol and not split_unit(name) else name
        for name, symbol in zip(names, symbols, strict=True)
    ]


def find_column(
    name: str, headers: Iterable[str], dimension: str | None
) -> Match | None:
    """Find the column of a file that a configured name stands for.

    A column of exactly this name comes first, then one that has a unit behind it. A
    configured name that holds the unit itself is converted if the unit is known.

    Args:
        name: as configured.
        headers: of the file.
        dimension: of `DIMENSIONS` that the column must have; None for any.

    Returns:
        The match, or None where there is no such column.

    Raises:
        ValueError: an unknown unit, one of another dimension, or two such columns.
    """
    headers = list(headers)
    if name in headers:
        split = split_unit(name)
        unit = split and find_unit(split[1])
        return _converted(name, unit, dimension) if unit else Match(name)
    fitting = [one for one in headers if name_of(one) == name != one.strip()]
    if not fitting:
        return None
    if len(fitting) > 1:
        raise ValueError(
            f"columns {' and '.join(fitting)} both fit {name}; configure one in full"
        )
    symbol = (split_unit(fitting[0]) or ("", ""))[1]
    if (unit := find_unit(symbol)) is None:
        raise ValueError(
            f"unknown unit {symbol!r} of column {fitting[0]}; "
            "configure the name in full to read it without a conversion"
        )
    return _converted(fitting[0], unit, dimension)


def _converted(header: str, unit: Unit, dimension: str | None) -> Match:
    """A match with its conversion to SI.

    Raises:
        ValueError: a unit of another dimension.
    """
    if dimension not in (None, unit.dimension):
        raise ValueError(
            f"column {header} has a unit of {unit.dimension}, {dimension} is needed"
        )
    if unit.factor == 1.0:
        return Match(header)
    conversion = f"{header} to {DIMENSIONS[unit.dimension]} (x {unit.factor:.6g})"
    return Match(header, unit.factor, conversion)
