"""Tables from csv and parquet files; errors name the file and the line."""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float, Int, Shaped

from sfkd_jax.store import open_regular

WIDEST = 64
"""Characters of a cell up to which a csv column is stored as text of fixed width."""
DECODED = 1 << 29
"""Largest decoded size of a parquet file [bytes]: few bytes may encode any number of
equal values.
"""


class Table(NamedTuple):
    """Columns of equal length, as they stand in a file.

    Attributes:
        source: the file.
        columns: by name; text where the file holds text.
        rows: position of each row in the file.
        row_name: what `rows` counts: "line" (csv, the header is line 1) or "row" (npz
            and parquet, from 0).
        factors: to SI units, by column; 1 if a column is not listed.
    """

    source: str
    columns: dict[str, Shaped[np.ndarray, " time"]]
    rows: Int[np.ndarray, " time"]
    row_name: str
    factors: Mapping[str, float] = MappingProxyType({})

    def numbers(self, name: str) -> Float[np.ndarray, " time"]:
        """Return a column as float64 in SI units; dates become seconds since the first.

        Raises:
            ValueError: a cell that is not a number.
        """
        values, factor = self.columns[name], self.factors.get(name, 1.0)
        try:
            if values.dtype.kind == "M":
                return (values - values[0]) / np.timedelta64(1, "s")
            if values.dtype.kind in "biufSUO":
                numbers = values.astype(np.float64)
                return numbers if factor == 1.0 else factor * numbers
        except (TypeError, ValueError, OverflowError):
            pass
        self._raise_at(name)

    def _raise_at(self, name: str) -> NoReturn:
        """Report the first cell of a column that is not a number."""
        for row, value in zip(self.rows, self.columns[name], strict=True):
            try:
                float(value)
            except (TypeError, ValueError, OverflowError):
                text = repr(str(value)[:WIDEST]) if str(value).strip() else "empty"
                raise ValueError(
                    f"{self.source}, {self.row_name} {row}: {name} is {text}, "
                    "not a number"
                ) from None
        raise ValueError(f"{self.source}: {name} cannot be read as numbers")


def read_csv(file: Path) -> Table:
    """Read a csv file with one line of column names.

    Cells are separated by commas, semicolons, tabs or blanks; # begins a comment.

    Raises:
        ValueError: not text, no header, no rows, or rows of another length than the
            header.
    """
    try:
        with open_regular(file) as stream:
            text = io.TextIOWrapper(
                io.BufferedReader(stream), encoding="utf-8-sig"
            ).read()
    except UnicodeDecodeError:
        raise ValueError(f"{file}: not a text file in UTF-8") from None
    head = text.split("\n", 1)[0]
    between = max(",;\t", key=head.count)
    reader = csv.reader(
        io.StringIO(text),
        delimiter=between if between in head else " ",
        skipinitialspace=True,
    )
    try:
        cells = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    except csv.Error as reason:
        raise ValueError(f"{file}, line {reader.line_num}: {reason}") from None
    if not cells:
        raise ValueError(f"{file}: the file is empty")
    (line, header), *rest = cells
    names = [name.strip() for name in header]
    names[0] = names[0].lstrip("# ")  # numpy writes headers as comments
    names = names[1:] if not names[0] else names
    _check_header(f"{file}, line {line}", names)
    rest = [(line, row) for line, row in rest if not row[0].startswith("#")]
    if odd := [(line, row) for line, row in rest if len(row) != len(names)]:
        line, row = odd[0]
        raise ValueError(
            f"{file}, line {line}: {len(row)} cells below a header of {len(names)}"
        )
    if not rest:
        raise ValueError(f"{file}: no rows below the header")
    columns = {
        name: _column([row[k] for _, row in rest]) for k, name in enumerate(names)
    }
    return Table(str(file), columns, np.array([number for number, _ in rest]), "line")


def _column(cells: list[str]) -> Shaped[np.ndarray, " time"]:
    """Cells as an array; a long cell does not widen all others."""
    return np.array(cells, dtype=object if max(map(len, cells)) > WIDEST else str)


def _check_header(where: str, names: list[str]) -> None:
    """Refuse a header that does not name columns."""
    if all(map(_is_number, names)):
        raise ValueError(f"{where}: numbers where the names of the columns should be")
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"{where}: the column {twice[0]} appears twice")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def read_npz(file: Path) -> dict[str, Shaped[np.ndarray, ...]]:
    """Return the arrays of an npz file.

    Raises:
        ValueError: damaged, of another kind, with objects, or larger than DECODED bytes
            once inflated.
    """
    with open_regular(file) as stream:
        try:
            with zipfile.ZipFile(stream) as packed:
                size = sum(part.file_size for part in packed.infolist())
            if size > DECODED:
                raise ValueError(
                    f"{size >> 20} MiB once inflated, at most {DECODED >> 20} are read"
                )
            stream.seek(0)
            # Pickles would run code.
            with np.load(stream, allow_pickle=False) as opened:
                return {name: opened[name] for name in opened.files}
        except Exception as reason:  # a damaged file raises nearly anything
            raise ValueError(f"{file}: not a readable npz file ({reason})") from None


def read_parquet(file: Path) -> Table:
    """Read a parquet file.

    Raises:
        ValueError: pyarrow is missing, the file is damaged or of another kind, or
            larger than DECODED bytes once decoded.
    """
    try:
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            f'{file}: parquet files need pyarrow: pip install "sfkd-jax[train]"'
        ) from None
    with open_regular(file) as stream:
        try:
            opened = parquet.ParquetFile(io.BufferedReader(stream))
            if (size := _decoded(opened.metadata)) > DECODED:
                raise ValueError(
                    f"{size >> 20} MiB once decoded, at most {DECODED >> 20} are read"
                )
            held = opened.read()
            columns = {
                name: held.column(k).to_numpy()
                for k, name in enumerate(held.column_names)
            }
        except Exception as reason:  # a damaged file raises nearly anything
            first = (str(reason).splitlines() or [type(reason).__name__])[0]
            raise ValueError(f"{file}: not a readable parquet file ({first})") from None
    if not held.num_rows:
        raise ValueError(f"{file}: no rows")
    if len(columns) < len(held.column_names):
        raise ValueError(f"{file}: two columns have one name")
    return Table(str(file), columns, np.arange(held.num_rows), "row")


def _decoded(about: Any) -> int:
    """Decoded size that a parquet file declares, by its values and pages [bytes]."""
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    columns = [group.column(k) for group in groups for k in range(group.num_columns)]
    values = sum(max(column.num_values, 0) for column in columns)
    rows = sum(max(group.num_rows, 0) * group.num_columns for group in groups)
    pages = sum(max(column.total_uncompressed_size, 0) for column in columns)
    return max(
        8 * values, 8 * rows, 8 * max(about.num_rows, 0) * about.num_columns, pages
    )
