"""Columns of numbers from csv and parquet; what cannot be read is told in one line with its place."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float, Int, Shaped

from sfkd_jax.artefacts import open_regular

WIDEST = 64
"""Letters of a cell up to which a column of a csv file is held as text of one width;
numbers are shorter.
"""
DECODED = 1 << 29
"""Bytes that a parquet file may become: it can repeat a value without end in a few
bytes.
"""


class Table(NamedTuple):
    """Columns of equal length, as they stand in a file.

    Attributes:
        source: the file.
        columns: by name; text where the file holds text.
        rows: where each row stands in the file.
        counted: what `rows` counts: "line" (csv, the header is line 1) or "row" (npz
            and parquet, from 0).
    """

    source: str
    columns: dict[str, Shaped[np.ndarray, " time"]]
    rows: Int[np.ndarray, " time"]
    counted: str

    def numbers(self, name: str) -> Float[np.ndarray, " time"]:
        """A column as float64; moments become seconds since the first.

        Raises:
            ValueError: a cell that is not a number.
        """
        values = self.columns[name]
        try:
            if values.dtype.kind == "M":
                return (values - values[0]) / np.timedelta64(1, "s")
            if values.dtype.kind in "biufSUO":
                return values.astype(np.float64)
        except (TypeError, ValueError, OverflowError):
            pass
        self._blame(name)

    def _blame(self, name: str) -> NoReturn:
        """Name the first cell of a column that is not a number."""
        for row, value in zip(self.rows, self.columns[name], strict=True):
            try:
                float(value)
            except (TypeError, ValueError, OverflowError):
                said = repr(str(value)[:WIDEST]) if str(value).strip() else "empty"
                raise ValueError(
                    f"{self.source}, {self.counted} {row}: {name} is {said}, not a number"
                ) from None
        raise ValueError(f"{self.source}: {name} cannot be read as numbers")


def read_csv(file: Path) -> Table:
    """A csv file with one line of column names; comma, semicolon, tab or blank between cells, # before comments.

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
    """Cells as an array; one long cell does not make all others as wide."""
    return np.array(cells, dtype=object if max(map(len, cells)) > WIDEST else str)


def _check_header(where: str, names: list[str]) -> None:
    """Refuse a header that does not name columns."""
    if all(map(_is_number, names)):
        raise ValueError(f"{where}: numbers where the names of the columns should be")
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"{where}: the column {twice[0]} stands there twice")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def read_parquet(file: Path) -> Table:
    """A parquet file.

    Raises:
        ValueError: pyarrow is missing, the file is not what its name says, or it
            becomes more than DECODED bytes.
    """
    try:
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            f'{file}: parquet files need pyarrow: pip install "sfkd-jax[parquet]"'
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
            said = (str(reason).splitlines() or [type(reason).__name__])[0]
            raise ValueError(f"{file}: not a readable parquet file ({said})") from None
    if not held.num_rows:
        raise ValueError(f"{file}: no rows")
    if len(columns) < len(held.column_names):
        raise ValueError(f"{file}: two columns have one name")
    return Table(str(file), columns, np.arange(held.num_rows), "row")


def _decoded(about: Any) -> int:
    """At least how many bytes a parquet file says that it becomes: by its values, and by its pages."""
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    columns = [group.column(k) for group in groups for k in range(group.num_columns)]
    values = sum(max(column.num_values, 0) for column in columns)
    rows = sum(max(group.num_rows, 0) * group.num_columns for group in groups)
    pages = sum(max(column.total_uncompressed_size, 0) for column in columns)
    return max(
        8 * values, 8 * rows, 8 * max(about.num_rows, 0) * about.num_columns, pages
    )
