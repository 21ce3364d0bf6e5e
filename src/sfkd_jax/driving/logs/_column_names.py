"""Columns that configured names stand for, and the units behind names of columns."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from functools import cache
from typing import Any, NamedTuple

SI_SYMBOLS = {
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
"""Symbols of SI units by dimension. Units of other dimensions count as unknown. No car
logs them, and pint takes many a remark in brackets for a unit: mu, for the friction,
would be a milli unified atomic mass.
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
"""Spellings of units that pint does not know, or takes for something else."""
_TERM = r"[A-Za-zµμ°%]+(?:\^?[1-4]|[²³])?"
UNIT_PATTERN = re.compile(rf"(?:1|{_TERM})(?:\s*[ */·]\s*{_TERM})*")
"""Pattern of texts that pint is asked about. It computes whatever is written, and
9**9**9 would take for ever.
"""


class Match(NamedTuple):
    """A column of a file that holds a configured column.

    Attributes:
        header: its name in the file.
        factor: by which its numbers are multiplied.
        conversion: text for the user, or None if the numbers are left as they are.
    """

    header: str
    factor: float = 1.0
    conversion: str | None = None


def among(headers: Iterable[str], wanted: Collection[str]) -> list[str]:
    """Return the headers that are a configured name, with or without a unit."""
    return [
        header
        for header in headers
        if header in wanted or split_unit(header)[0] in wanted
    ]


def find_column(
    name: str, headers: Collection[str], dimension: str | None
) -> Match | None:
    """Find the column of a file that a configured name stands for.

    A column of exactly this name is preferred to one with a unit behind the name. A
    column whose name holds a known unit is converted to SI units, even if that name is
    configured in full.

    Args:
        name: that is configured.
        headers: names of the columns of the file.
        dimension: that a unit must have, of `SI_SYMBOLS`; None for any.

    Returns:
        The column, or None if there is none.

    Raises:
        ValueError: two columns fit, a unit is unknown or of another dimension.
    """
    exact = name in headers
    if exact:
        fitting = [name]
    else:
        fitting = [
            header
            for header in headers
            if split_unit(header)[0] == name and name != header.strip()
        ]
    if len(fitting) > 1:
        raise ValueError(
            f"columns {' and '.join(fitting)} both fit {name}; configure one in full"
        )
    if not fitting:
        return None
    header = fitting[0]
    _, symbol = split_unit(header)
    unit = None if symbol is None else find_unit(symbol)
    if unit is None:
        if exact:
            return Match(name)
        raise ValueError(
            f"unknown unit {symbol!r} of column {header}; "
            "configure the name in full to read it without a conversion"
        )
    unit_dimension, factor = unit
    if dimension not in (None, unit_dimension):
        raise ValueError(
            f"column {header} has a unit of {unit_dimension}, {dimension} is needed"
        )
    if factor == 1.0:
        return Match(header)
    si_symbol = SI_SYMBOLS[unit_dimension]
    return Match(header, factor, f"{header} to {si_symbol} (x {factor:.6g})")


@cache
def find_unit(symbol: str) -> tuple[str, float] | None:
    """Return the dimension of a unit and its factor to SI; None if it is unknown."""
    # The unit as it is written comes first: mm and Mm differ in their capitals alone.
    for spelling in (symbol, symbol.lower()):
        written = SPELLINGS.get(spelling, spelling)
        if not UNIT_PATTERN.fullmatch(written) and written != "standard_gravity":
            continue
        # m/s2 means m/s^2.
        expression = re.sub(r"(?<=[A-Za-z])([1-4])", r"^\1", written)
        expression = expression.replace("·", "*")
        units, dimensions = _registry()
        try:
            factor, base = units.get_base_units(units.parse_units(expression))
        except Exception:  # The parser of pint may raise anything.
            continue
        if str(base) in dimensions:
            return dimensions[str(base)], float(factor)
    return None


@cache
def _registry() -> tuple[Any, dict[str, str]]:
    """Return pint's units, and the dimensions by the SI unit in base units."""
    import pint

    units = pint.UnitRegistry()
    dimensions = {}
    for dimension, symbol in SI_SYMBOLS.items():
        unit = units.parse_units(SPELLINGS.get(symbol, symbol))
        _, base = units.get_base_units(unit)
        dimensions[str(base)] = dimension
    return units, dimensions


def split_unit(header: str) -> tuple[str, str | None]:
    """Split "x(m)" or "x [m]" into name and unit; the unit is None without one."""
    parts = re.fullmatch(r"(.*?\S)\s*(?:\(([^()]*)\)|\[([^\[\]]*)\])", header.strip())
    if parts is None:
        return header, None
    name, in_round, in_square = parts.groups()
    unit = in_round if in_square is None else in_square
    return name, unit.strip()
