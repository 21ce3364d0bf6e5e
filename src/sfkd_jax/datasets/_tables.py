"""Columns of numbers from npz, csv and parquet; what cannot be read is told in one line with its place."""

from __future__ import annotations

import csv
import io
import zipfile
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float, Int, Shaped


class Table(NamedTuple):
    """Columns of equal length, as they stand in a file.

    Attributes:
        source: the file. columns: by name; text where the file holds text.
        rows: where each row stands in the file. counted: what `rows` counts: "line" (csv, the header is line 1) or
            "row" (npz and parquet, from 0).
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
        if values.dtype.kind == "M":
            return (values - values[0]) / np.timedelta64(1, "s")
        try:
            return values.astype(np.float64)
        except (TypeError, ValueError):
            self._blame(name)

    def _blame(self, name: str) -> NoReturn:
        """Name the first cell of a column that is not a number."""
        for row, value in zip(self.rows, self.columns[name], strict=True):
            try:
                float(value)
            except (TypeError, ValueError):
                said = repr(str(value)) if str(value).strip() else "empty"
                raise ValueError(f"{self.source}, {self.counted} {row}: {name} is {said}, not a number") from None
        raise ValueError(f"{self.source}: {name} cannot be read as numbers")


def read_csv(file: Path) -> Table:
    """A csv file with one line of column names; comma, semicolon, tab or blank between cells, # before comments.

    Raises:
        ValueError: not text, no header, no rows, or rows of another length than the header.
    """
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{file}: not a text file in UTF-8") from None
    head = text.split("\n", 1)[0]
    between = max(",;\t", key=head.count)
    reader = csv.reader(io.StringIO(text), delimiter=between if between in head else " ", skipinitialspace=True)
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
        raise ValueError(f"{file}, line {line}: {len(row)} cells below a header of {len(names)}")
    if not rest:
        raise ValueError(f"{file}: no rows below the header")
    body = np.array([row for _, row in rest])
    return Table(str(file), {name: body[:, k] for k, name in enumerate(names)}, np.array([n for n, _ in rest]), "line")


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
        ValueError: pyarrow is missing, or the file is not what its name says.
    """
    try:
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(f'{file}: parquet files need pyarrow: pip install "sfkd-jax[parquet]"') from None
    try:
        held = parquet.read_table(file)
    except (OSError, ValueError) as reason:
        raise ValueError(f"{file}: not a readable parquet file ({str(reason).splitlines()[0]})") from None
    if not held.num_rows:
        raise ValueError(f"{file}: no rows")
    columns = {name: held.column(name).to_numpy() for name in held.column_names}
    return Table(str(file), columns, np.arange(held.num_rows), "row")


def read_npz(file: Path) -> dict[str, np.ndarray]:
    """The arrays of an npz file; nothing pickled is ever loaded.

    Raises:
        ValueError: damaged, or not plain arrays.
    """
    try:
        held = np.load(file, allow_pickle=False)
        if isinstance(held, np.ndarray):
            raise ValueError("a single array without a name")
        with held:
            return {name: held[name] for name in held.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as reason:
        said = str(reason).splitlines()[0] if str(reason) else type(reason).__name__
        raise ValueError(f"{file}: not a readable npz file of plain arrays ({said})") from None
