"""Units in column names, such as x(m) or speed [km/h], and their conversion to SI."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import NamedTuple

UNITS: dict[str, dict[str, float]] = {
    "time": {
        "s": 1.0,
        "sec": 1.0,
        "ms": 1e-3,
        "us": 1e-6,
        "µs": 1e-6,
        "ns": 1e-9,
        "min": 60.0,
        "h": 3600.0,
    },
    "length": {
        "m": 1.0,
        "km": 1e3,
        "cm": 1e-2,
        "mm": 1e-3,
        "ft": 0.3048,
        "in": 0.0254,
        "mi": 1609.344,
    },
    "angle": {
        "rad": 1.0,
        "mrad": 1e-3,
        "deg": math.pi / 180,
        "degrees": math.pi / 180,
        "°": math.pi / 180,
    },
    "speed": {
        "m/s": 1.0,
        "km/h": 1 / 3.6,
        "kph": 1 / 3.6,
        "kmh": 1 / 3.6,
        "cm/s": 1e-2,
        "mm/s": 1e-3,
        "mph": 0.44704,
        "ft/s": 0.3048,
        "kn": 1852 / 3600,
    },
    "angular rate": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": math.pi / 180,
        "°/s": math.pi / 180,
        "rpm": math.pi / 30,
    },
    "acceleration": {
        "m/s²": 1.0,
        "m/s^2": 1.0,
        "m/s2": 1.0,
        "g": 9.80665,
        "ft/s²": 0.3048,
        "ft/s^2": 0.3048,
    },
    "curvature": {"1/m": 1.0, "1/km": 1e-3},
    "force": {"N": 1.0, "kN": 1e3},
    "torque": {"Nm": 1.0, "N m": 1.0, "kNm": 1e3},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "pressure": {"Pa": 1.0, "kPa": 1e3, "bar": 1e5},
    "ratio": {"-": 1.0, "1": 1.0, "%": 1e-2},
}
"""Units by dimension, each with its factor to the SI unit, which comes first."""


class Unit(NamedTuple):
    """A known unit.

    Attributes:
        dimension: of `UNITS`.
        symbol: of its SI unit.
        factor: to SI.
    """

    dimension: str
    symbol: str
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


def split_unit(header: str) -> tuple[str, str] | None:
    """Split "x(m)" or "x [m]" into name and unit; None without a unit."""
    parts = re.fullmatch(r"(.*?\S)\s*(?:\(([^()]*)\)|\[([^\[\]]*)\])", header.strip())
    if parts is None:
        return None
    name, round_, square = parts.groups()
    return name, (round_ if square is None else square).strip()


def find_unit(symbol: str) -> Unit | None:
    """Look a unit up by its symbol, as written or in small letters."""
    for spelling in (symbol, symbol.lower()):
        for dimension, units in UNITS.items():
            if spelling in units:
                return Unit(dimension, next(iter(units)), units[spelling])
    return None


def find_column(
    name: str, headers: Iterable[str], dimension: str | None
) -> Match | None:
    """Find the column of a file that a configured name stands for.

    A column of exactly this name comes first, then one that has a unit behind it. A
    configured name that holds the unit itself is converted if the unit is known.

    Args:
        name: as configured.
        headers: of the file.
        dimension: of `UNITS` that the column must have; None for any.

    Returns:
        The match, or None where there is no such column.

    Raises:
        ValueError: an unknown unit, one of another dimension, or two such columns.
    """
    headers = list(headers)
    if name in headers:
        split = split_unit(name)
        unit = split and find_unit(split[1])
        if split is None or unit is None:
            return Match(name)
        return _converted(name, split[1], unit, dimension)
    symbols = {
        header: split[1]
        for header in headers
        if (split := split_unit(header)) and split[0] == name
    }
    fitting = list(symbols)
    if not fitting:
        return None
    if len(fitting) > 1:
        raise ValueError(
            f"columns {' and '.join(fitting)} both fit {name}; configure one in full"
        )
    symbol = symbols[fitting[0]]
    unit = find_unit(symbol)
    if unit is None:
        raise ValueError(
            f"unknown unit {symbol!r} of column {fitting[0]}; "
            "configure the name in full to read it without a conversion"
        )
    return _converted(fitting[0], symbol, unit, dimension)


def _converted(header: str, symbol: str, unit: Unit, dimension: str | None) -> Match:
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
    conversion = f"{header} to {unit.symbol} (x {unit.factor:.6g})"
    return Match(header, unit.factor, conversion)
