"""Read tables from csv, npz and parquet files; errors name the file and the line."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from sfkd_jax.driving.logs._column_names import among
from sfkd_jax.store import as_artefact_error, read_bytes

PREAMBLE = 50
"""Number of lines of a csv file among which its header is looked for."""
DROP = "; dataset.missing=drop leaves such rows out"
"""Advice where a number is missing."""
QUOTED = 64
"""Number of characters of a cell that a message quotes."""


class Table(NamedTuple):
    """Columns of equal length, as they stand in a file.

    Attributes:
        source: the file.
        columns: the configured columns by name; text where the file holds text.
        headers: names of all columns of the file.
        rows: position of each row in the file.
        row_name: what `rows` counts: "line" (csv, from 1) or "row" (npz and parquet,
            from 0).
        run: the column that numbers the runs, if the form of the file holds several.
    """

    source: str
    columns: Mapping[str, Shaped[np.ndarray, " time"]]
    headers: tuple[str, ...]
    rows: Int[np.ndarray, " time"]
    row_name: str = "row"
    run: str | None = None

    def numbers(self, name: str, factor: float = 1.0) -> Float[np.ndarray, " time"]:
        """Return a column, times the factor to its SI unit, as float64.

        Dates become seconds since the first one.

        Raises:
            ValueError: a cell is no number.
        """
        values = self.columns[name]
        try:
            if values.dtype.kind == "M":
                return (values - values[0]) / np.timedelta64(1, "s")
            if values.dtype.kind in "biufSUO":
                numbers = values.astype(np.float64)
                # Without a conversion the numbers of the file are kept exactly.
                return numbers if factor == 1.0 else factor * numbers
        except (TypeError, ValueError, OverflowError):
            pass
        for row, value in zip(self.rows, values, strict=True):
            if not _is_number(value):
                where = f"{self.source}, {self.row_name} {row}"
                if not str(value).strip():
                    raise ValueError(f"{where}: {name} is empty, not a number{DROP}")
                text = repr(str(value)[:QUOTED])
                raise ValueError(f"{where}: {name} is {text}, not a number")
        raise ValueError(f"{self.source}: {name} cannot be read as numbers")


def read_csv(file: Path, wanted: Collection[str], *, blanks: bool = False) -> Table:
    """Read the configured columns of a csv file.

    Cells are separated by commas, semicolons, tabs or blanks, and # begins a comment.
    Lines before the header are skipped.

    Args:
        file: with a text in UTF-8, or else in Windows-1252.
        wanted: names of columns. The header is the line that has most of them.
        blanks: whether empty cells are NaN; otherwise they are text.

    Raises:
        ValueError: the file cannot be read as such a table.
    """
    lines = _text(file).splitlines()
    filled = [k for k, line in enumerate(lines) if line.strip()]
    if not filled:
        raise ValueError(f"{file}: the file is empty")
    header = _header(file, lines, filled, wanted)
    names, separator = _cells(lines[header].lstrip("# "))
    repeated = [name for k, name in enumerate(names) if name in names[:k]]
    if repeated:
        where = f"{file}, line {header + 1}"
        raise ValueError(f"{where}: the column {repeated[0]} appears twice")
    kept = [k for k in filled if k > header and not lines[k].startswith("#")]
    if not kept:
        raise ValueError(f"{file}: no rows below the header")
    rows = np.array(kept) + 1
    body = [lines[k] for k in kept]
    # A log may be half as large as the memory. No copy of it is kept longer than it is
    # used.
    del lines
    content = _with_decimal_points(body, separator)
    del body
    table, odd_rows = _parse(file, content, names, separator, wanted, blanks)
    if odd_rows:
        odd = odd_rows[0]
        raise ValueError(
            f"{file}, line {rows[odd.number - 1]}: {odd.actual_columns} cells "
            f"below a header of {len(names)}"
        )
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    return Table(str(file), columns, tuple(names), rows, "line")


def _with_decimal_points(lines: list[str], separator: str) -> bytes:
    """Return lines as the content of a file, with decimal points in place of commas."""
    if separator == " ":
        lines = [" ".join(line.split()) for line in lines]
    text = "\n".join([*lines, ""])
    decimal_comma = rf"(?:^|{separator}) *-?\d+,\d"
    # Every line is searched, since the first ones may hold whole numbers only.
    if separator != "," and re.search(decimal_comma, text, re.MULTILINE):
        text = text.replace(",", ".")
    return text.encode()


def _parse(
    file: Path,
    content: bytes,
    names: list[str],
    separator: str,
    wanted: Collection[str],
    blanks: bool,
) -> tuple[Any, list[Any]]:
    """Parse the rows of a csv file.

    Args:
        file: for messages.
        content: rows without the header.
        names: of all columns.
        separator: of cells.
        wanted: names of the columns to read.
        blanks: whether empty cells are NaN.

    Returns:
        The table of pyarrow, and the rows that have another number of cells.
    """
    from pyarrow import csv  # imported here, because most programs read no csv file

    odd_rows: list[Any] = []

    def skip(row: Any) -> str:
        odd_rows.append(row)
        return "skip"

    try:
        table = csv.read_csv(
            io.BytesIO(content),
            read_options=csv.ReadOptions(
                use_threads=False,
                column_names=names,
                # One block: the type of a column depends on all of its cells.
                block_size=len(content) + 1,
            ),
            parse_options=csv.ParseOptions(
                delimiter=separator, invalid_row_handler=skip, newlines_in_values=False
            ),
            convert_options=csv.ConvertOptions(
                # Without null values an empty cell is text, and an error with a line.
                null_values=[""] if blanks else [],
                # Other columns, such as texts, would fill the memory.
                include_columns=among(names, wanted),
            ),
        )
    except (ValueError, OverflowError) as reason:
        raise ValueError(f"{file}: not a readable csv file ({reason})") from None
    return table, odd_rows


def _header(
    file: Path, lines: list[str], filled: list[int], wanted: Collection[str]
) -> int:
    """Return the index of the line that has most of the configured names.

    If no line has any, it is the first one that is no comment. It must have as many
    cells as a row.

    Args:
        file: for messages.
        lines: of the file.
        filled: indices of the lines that are not empty.
        wanted: configured names.
    """
    # numpy writes headers as comments.
    candidates = {k: _cells(lines[k].lstrip("# "))[0] for k in filled[:PREAMBLE]}
    matches = {k: len(among(cells, wanted)) for k, cells in candidates.items()}
    most = max(matches.values())
    if most > 0:
        return next(k for k in matches if matches[k] == most)
    first = next((k for k in candidates if not lines[k].startswith("#")), filled[0])
    where = f"{file}, line {first + 1}"
    cells = candidates[first]
    if all(map(_is_number, cells)):
        raise ValueError(f"{where}: numbers where the names of the columns should be")
    cells_of_rows, _ = _cells(lines[filled[-1]])
    if len(cells) != len(cells_of_rows):
        raise ValueError(
            f"{where} is no header: {len(cells)} cells above rows of "
            f"{len(cells_of_rows)}, and no line has one of the names "
            f"{', '.join(wanted)}; set dataset.columns"
        )
    return first


def _text(file: Path) -> str:
    """Return the text of a file as UTF-8, or else as Windows-1252."""
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
    """Return the cells of a line, and the separator, which it has most of."""
    most = max(",;\t", key=line.count)
    separator = most if most in line else " "
    cells = line.split() if separator == " " else line.split(separator)
    return [cell.strip().strip('"').strip() for cell in cells], separator


def _is_number(value: Any) -> bool:
    """Return whether a cell is a number."""
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def read_npz(
    file: Path, wanted: Callable[[list[str]], Collection[str]]
) -> tuple[dict[str, Shaped[np.ndarray, ...]], tuple[str, ...]]:
    """Return the wanted arrays of an npz file, and the names of all of its arrays.

    Args:
        file: to read.
        wanted: (names of all arrays) -> those to read. Others may be objects, or larger
            than the memory.
    """
    # Pickled objects could run code, so that they are not allowed.
    with _opened(file, "npz") as stream, np.load(stream, allow_pickle=False) as opened:
        names = opened.files
        return {name: opened[name] for name in wanted(names)}, tuple(names)


def read_parquet(file: Path, wanted: Collection[str]) -> Table:
    """Read the configured columns of a parquet file.

    Raises:
        ValueError: the file has no rows, or two columns of the same name.
    """
    from pyarrow import parquet

    with _opened(file, "parquet") as stream:
        opened = parquet.ParquetFile(stream)
        names = opened.schema_arrow.names
        table = opened.read(among(names, wanted))
    if not table.num_rows:
        raise ValueError(f"{file}: no rows")
    if len(set(names)) < len(names):
        raise ValueError(f"{file}: two columns have one name")
    arrays = {name: table.column(name).to_numpy() for name in table.column_names}
    return Table(str(file), arrays, tuple(names), np.arange(table.num_rows))


@contextmanager
def _opened(file: Path, file_format: str) -> Iterator[BinaryIO]:
    """Open a file; whatever a library raises on a damaged one becomes one line."""
    with as_artefact_error(file), file.open("rb") as stream:
        try:
            yield stream
        except Exception as reason:  # A damaged file may raise anything.
            first_line = (str(reason).splitlines() or [type(reason).__name__])[0]
            raise ValueError(
                f"{file}: not a readable {file_format} file ({first_line})"
            ) from None
