"""Tables of csv, npz and parquet files in SI units; errors name file and line."""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from sfkd_jax.store import as_artefact_error, read_bytes

PREAMBLE = 50
"""Lines of a csv file among which its header is looked for."""
DROP = "; dataset.missing=drop leaves such rows out"
QUOTED = 64
"""Characters of a cell that a message quotes."""
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


class Table(NamedTuple):
    """Columns of equal length, as they stand in a file.

    Attributes:
        source: the file.
        columns: those that are configured, by name; text where the file holds text.
        headers: names of all its columns.
        rows: position of each row in the file.
        row_name: what `rows` counts: "line" (csv, from 1) or "row" (npz and parquet,
            from 0).
        run: the column that numbers its runs, if the file has several by its form.
    """

    source: str
    columns: Mapping[str, Shaped[np.ndarray, " time"]]
    headers: tuple[str, ...]
    rows: Int[np.ndarray, " time"]
    row_name: str = "row"
    run: str | None = None

    def numbers(self, name: str, factor: float = 1.0) -> Float[np.ndarray, " time"]:
        """Return a column, times the factor to its SI unit, as float64.

        Dates become seconds since the first.
        """
        values = self.columns[name]
        try:
            if values.dtype.kind == "M":
                return (values - values[0]) / np.timedelta64(1, "s")
            if values.dtype.kind in "biufSUO":
                numbers = values.astype(np.float64)
                # Without a conversion the very numbers of the file are kept.
                return numbers if factor == 1.0 else factor * numbers
        except (TypeError, ValueError, OverflowError):
            pass
        for row, value in zip(self.rows, values, strict=True):
            if not _is_number(value):
                text = repr(str(value)[:QUOTED])
                advice = ""
                if not str(value).strip():
                    text = "empty"
                    advice = DROP
                raise ValueError(
                    f"{self.source}, {self.row_name} {row}: {name} is {text}, "
                    f"not a number{advice}"
                )
        raise ValueError(f"{self.source}: {name} cannot be read as numbers")


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


def read_csv(file: Path, wanted: Collection[str], *, blanks: bool = False) -> Table:
    """Read the configured columns of a csv file.

    Cells are separated by commas, semicolons, tabs or blanks; # begins a comment. Lines
    before the header are skipped.

    Args:
        file: as UTF-8, or else Windows-1252.
        wanted: names of columns; the header is the line that has most of them.
        blanks: whether empty cells are NaN; otherwise they are text.
    """
    from pyarrow import csv  # quick to load for whoever reads none

    # A log may be half as large as the memory: no copy outlives its use.
    lines = _text(file).splitlines()
    filled = [k for k, line in enumerate(lines) if line.strip()]
    if not filled:
        raise ValueError(f"{file}: the file is empty")
    header = _header(file, lines, filled, wanted)
    names, between = _cells(lines[header].lstrip("# "))
    where = f"{file}, line {header + 1}"
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"{where}: the column {twice[0]} appears twice")
    kept = [k for k in filled if k > header and not lines[k].startswith("#")]
    if not kept:
        raise ValueError(f"{file}: no rows below the header")
    rows = np.array(kept) + 1
    body = [lines[k] for k in kept]
    del lines
    if between == " ":
        body = [" ".join(line.split()) for line in body]
    text = "\n".join([*body, ""])
    del body
    # The first rows may hold whole numbers only, so every line is looked at.
    if between != "," and re.search(rf"(?:^|{between}) *-?\d+,\d", text, re.MULTILINE):
        text = text.replace(",", ".")
    content = text.encode()
    del text
    odd: list[Any] = []

    def skip(row: Any) -> str:
        odd.append(row)
        return "skip"

    try:
        held = csv.read_csv(
            io.BytesIO(content),
            # One block: a later one may not change the type of a column.
            read_options=csv.ReadOptions(
                use_threads=False, column_names=names, block_size=len(content) + 1
            ),
            parse_options=csv.ParseOptions(
                delimiter=between, invalid_row_handler=skip, newlines_in_values=False
            ),
            # An empty cell is an error with a line, not a number. What nobody asked
            # for, such as text, would fill the memory.
            convert_options=csv.ConvertOptions(
                null_values=[""] if blanks else [], include_columns=among(names, wanted)
            ),
        )
    except (ValueError, OverflowError) as reason:
        raise ValueError(f"{file}: not a readable csv file ({reason})") from None
    if odd:
        raise ValueError(
            f"{file}, line {rows[odd[0].number - 1]}: {odd[0].actual_columns} cells "
            f"below a header of {len(names)}"
        )
    columns = {name: held.column(name).to_numpy() for name in held.column_names}
    return Table(str(file), columns, tuple(names), rows, "line")


def _header(
    file: Path, lines: list[str], filled: list[int], wanted: Collection[str]
) -> int:
    """The index of the line that has most of the configured names.

    Without any it is the first that is no comment, if it is as long as a row.
    """
    # numpy writes headers as comments.
    heads = {k: _cells(lines[k].lstrip("# "))[0] for k in filled[:PREAMBLE]}
    held = {k: len(among(cells, wanted)) for k, cells in heads.items()}
    if max(held.values()):
        return max(held, key=lambda k: held[k])
    first = next((k for k in heads if not lines[k].startswith("#")), filled[0])
    where = f"{file}, line {first + 1}"
    if all(map(_is_number, heads[first])):
        raise ValueError(f"{where}: numbers where the names of the columns should be")
    if len(heads[first]) != (cells := len(_cells(lines[filled[-1]])[0])):
        raise ValueError(
            f"{where} is no header: {len(heads[first])} cells above rows of {cells}, "
            f"and no line has one of the names {', '.join(wanted)}; set dataset.columns"
        )
    return first


def among(headers: Iterable[str], wanted: Collection[str]) -> list[str]:
    """Those headers that are a configured name, with or without a unit behind it."""
    return [one for one in headers if one in wanted or split_unit(one)[0] in wanted]


def _text(file: Path) -> str:
    """The text of a file as UTF-8, or else Windows-1252."""
    content = read_bytes(file)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Recorders on Windows write the degree sign as one byte.
        text = content.decode("cp1252", errors="replace")
    if "\0" in text:
        raise ValueError(f"{file}: not a text file")
    return text


def _cells(line: str) -> tuple[list[str], str]:
    """The cells of a line, and the separator, which it has most of."""
    most = max(",;\t", key=line.count)
    between = most if most in line else " "
    cells = line.split() if between == " " else line.split(between)
    return [cell.strip().strip('"').strip() for cell in cells], between


def _is_number(value: Any) -> bool:
    """Whether a cell is a number."""
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def read_npz(file: Path) -> dict[str, Shaped[np.ndarray, ...]]:
    """Return the arrays of an npz file, none of them objects."""
    # Pickles would run code.
    with _opened(file, "npz") as stream, np.load(stream, allow_pickle=False) as opened:
        return {name: opened[name] for name in opened.files}


def read_parquet(file: Path, wanted: Collection[str]) -> Table:
    """Read the configured columns of a parquet file."""
    from pyarrow import parquet

    with _opened(file, "parquet") as stream:
        opened = parquet.ParquetFile(stream)
        names = opened.schema_arrow.names
        held = opened.read(among(names, wanted))
    if not held.num_rows:
        raise ValueError(f"{file}: no rows")
    if len(set(names)) < len(names):
        raise ValueError(f"{file}: two columns have one name")
    arrays = {name: held.column(name).to_numpy() for name in held.column_names}
    return Table(str(file), arrays, tuple(names), np.arange(held.num_rows))


@contextmanager
def _opened(file: Path, kind: str) -> Iterator[BinaryIO]:
    """Open a file; a damaged one is one line, whatever its library raises."""
    with as_artefact_error(file), file.open("rb") as stream:
        try:
            yield stream
        except Exception as reason:  # a damaged file raises nearly anything
            first = (str(reason).splitlines() or [type(reason).__name__])[0]
            raise ValueError(f"{file}: not a readable {kind} file ({first})") from None


def find_column(
    name: str, headers: Collection[str], dimension: str | None
) -> Match | None:
    """Find the column of a file that a configured name stands for.

    A column of exactly this name comes first, then one that has a unit behind it. A
    configured name that holds the unit itself is converted if the unit is known. It
    must be of the dimension, of `DIMENSIONS`, unless that is None.
    """
    exact = name in headers
    fitting = [name]
    if not exact:
        fitting = [one for one in headers if split_unit(one)[0] == name != one.strip()]
    if len(fitting) > 1:
        raise ValueError(
            f"columns {' and '.join(fitting)} both fit {name}; configure one in full"
        )
    if not fitting:
        return None
    (header,) = fitting
    _, symbol = split_unit(header)
    unit = None if symbol is None else find_unit(symbol)
    if unit is None:
        if exact:
            return Match(name)
        raise ValueError(
            f"unknown unit {symbol!r} of column {header}; "
            "configure the name in full to read it without a conversion"
        )
    known, factor = unit
    if dimension not in (None, known):
        raise ValueError(
            f"column {header} has a unit of {known}, {dimension} is needed"
        )
    if factor == 1.0:
        return Match(header)
    return Match(header, factor, f"{header} to {DIMENSIONS[known]} (x {factor:.6g})")


@cache
def find_unit(symbol: str) -> tuple[str, float] | None:
    """Return the dimension of a unit and its factor to SI; None if it is unknown."""
    # As written first: units may differ in capitals, such as mm and Mm.
    for spelling in (symbol, symbol.lower()):
        written = SPELLINGS.get(spelling, spelling)
        if not WRITTEN.fullmatch(written) and written != "standard_gravity":
            continue
        # m/s2 means m/s^2.
        power = re.sub(r"(?<=[A-Za-z])([1-4])", r"^\1", written).replace("·", "*")
        units, dimensions = _registry()
        try:
            factor, base = units.get_base_units(units.parse_units(power))
        except Exception:  # of pint's parser, nearly anything
            continue
        if str(base) in dimensions:
            return dimensions[str(base)], float(factor)
    return None


@cache
def _registry() -> tuple[Any, dict[str, str]]:
    """Pint's units, and the dimension of every SI unit in base units."""
    import pint

    units = pint.UnitRegistry()
    bases = {
        dimension: units.parse_units(SPELLINGS.get(symbol, symbol))
        for dimension, symbol in DIMENSIONS.items()
    }
    return units, {str(units.get_base_units(base)[1]): d for d, base in bases.items()}


def split_unit(header: str) -> tuple[str, str | None]:
    """Split "x(m)" or "x [m]" into name and unit; the unit is None without one."""
    parts = re.fullmatch(r"(.*?\S)\s*(?:\(([^()]*)\)|\[([^\[\]]*)\])", header.strip())
    if parts is None:
        return header, None
    name, round_, square = parts.groups()
    return name, (round_ if square is None else square).strip()
