"""Tables of csv, npz and parquet files; errors name the file and the line."""

from __future__ import annotations

import codecs
import glob
import hashlib
import io
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float, Int, Shaped

from sfkd_jax.data._units import name_of, with_unit_row
from sfkd_jax.store import open_regular

SUFFIXES = (".csv", ".npz", ".parquet")
DECODED = 1 << 29
"""Largest decoded size of an npz or parquet file [bytes]: few bytes may encode any
number of equal values.
"""
PREAMBLE = 50
"""Lines of a csv file among which its header is looked for."""
QUOTED = 64
"""Characters of a cell that a message quotes."""


def log_files(path: str) -> list[Path]:
    """Return the log files of a file, a folder or a glob, sorted by name.

    Raises:
        ValueError: none, files of another kind, or two with the same contents.
        ArtefactError: one is a pipe, a device or a folder, or cannot be read.
    """
    if path in ("", "???"):
        raise ValueError(
            "dataset.path is not set: pass dataset.path=FILE, dataset.path=FOLDER or "
            "'dataset.path=GLOB'"
        )
    here, known = Path(path).expanduser(), ", ".join(SUFFIXES)
    if here.is_dir():
        files = [
            file
            for file in sorted(here.iterdir())
            if file.suffix.lower() in SUFFIXES and file.name[0] != "."
        ]
    else:
        # A file whose name holds brackets is meant itself, not what it would match.
        named = [str(here)] if here.is_file() else glob.glob(str(here), recursive=True)
        files = sorted(file for file in map(Path, named) if file.is_file())
    if not files and here.is_dir():
        raise ValueError(
            f"{path}: no {known} in this folder; "
            "dataset.path takes globs such as logs/**/*.csv"
        )
    if not files:
        raise ValueError(f"{path}: no such file or folder, and no file matches it")
    if odd := [file for file in files if file.suffix.lower() not in SUFFIXES]:
        raise ValueError(f"{odd[0]}: unknown kind of log; choose one of {known}")
    first: dict[str, Path] = {}
    for file in files:
        if (same := first.setdefault(digest(file), file)) != file:
            raise ValueError(
                f"{file}: the same contents as {same}; remove one of them, "
                "or test drives are trained on"
            )
    return files


def fingerprint(path: str) -> str:
    """Return a hash of the contents of all logs of a path, whatever their names.

    Raises:
        ValueError: as for `log_files`.
    """
    hashes = sorted(map(digest, log_files(path)))
    return hashlib.sha256("".join(hashes).encode()).hexdigest()


def digest(file: Path) -> str:
    """Return the hash of a file's contents, cached until the file is written again."""
    status = file.stat()
    return _digest(file.resolve(), status.st_size, status.st_mtime_ns)


@cache
def _digest(file: Path, size: int, written: int) -> str:
    del size, written  # part of the key of the cache
    with open_regular(file) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@dataclass(frozen=True)
class Table:
    """Columns of equal length, as they stand in a file.

    Attributes:
        source: the file.
        columns: by name; text where the file holds text.
        rows: position of each row in the file.
        row_name: what `rows` counts: "line" (csv, from 1) or "row" (npz and parquet,
            from 0).
        decimal: the decimal point of its text.
        factors: to SI units, by column; 1 if a column is not listed.
    """

    source: str
    columns: Mapping[str, Shaped[np.ndarray, " time"]]
    rows: Int[np.ndarray, " time"]
    row_name: str = "row"
    decimal: str = "."
    factors: Mapping[str, float] = field(default_factory=dict)

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
                # Without a conversion the very numbers of the file are kept.
                return numbers if factor == 1.0 else factor * numbers
        except (TypeError, ValueError, OverflowError):
            pass
        self._raise_at(name)

    def _raise_at(self, name: str) -> NoReturn:
        """Report the first cell of a column that is not a number."""
        for row, value in zip(self.rows, self.columns[name], strict=True):
            if not _is_number(value, self.decimal):
                text = repr(str(value)[:QUOTED]) if str(value).strip() else "empty"
                raise ValueError(
                    f"{self.source}, {self.row_name} {row}: {name} is {text}, "
                    "not a number"
                )
        raise ValueError(f"{self.source}: {name} cannot be read as numbers")


def read_csv(file: Path, time: str) -> Table:
    """Read a csv file.

    Cells are separated by commas, semicolons, tabs or blanks; # begins a comment. Lines
    before the header are skipped, a line of units below it is added to the names.

    Args:
        file: as UTF-8, UTF-16 with its mark, or else Windows-1252.
        time: the column by which the header is known; without it the first line is.

    Raises:
        ValueError: not text, no header, no rows, or rows of another length than the
            header.
    """
    csv = _pyarrow("csv", file)
    lines = _text(file).splitlines()
    filled = [k for k, line in enumerate(lines) if line.strip()]
    if not filled:
        raise ValueError(f"{file}: the file is empty")
    heads = {k: _cells(lines[k].lstrip("# "))[0] for k in filled[:PREAMBLE]}
    header = next(
        (k for k, cells in heads.items() if time in map(name_of, cells)), filled[0]
    )
    # numpy writes headers as comments.
    names, between = _cells(lines[header].lstrip("# "))
    _check_header(f"{file}, line {header + 1}", names)
    kept = [k for k in filled if k > header and not lines[k].startswith("#")]
    if kept and (units := with_unit_row(names, _cells(lines[kept[0]], between)[0])):
        names, kept = units, kept[1:]
    if not kept:
        raise ValueError(f"{file}: no rows below the header")
    rows = np.array(kept) + 1
    body = [lines[k] for k in kept]
    if between == " ":
        body = [" ".join(line.split()) for line in body]
    text = "\n".join([*body, ""])
    # The first rows may hold whole numbers only, so every line is looked at.
    comma = between != "," and re.search(rf"(?:^|{between}) *-?\d+,\d", text, re.M)
    content = text.encode()
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
            # An empty cell is an error with a line, not a number.
            convert_options=csv.ConvertOptions(
                null_values=[], decimal_point="," if comma else "."
            ),
        )
    except (ValueError, OverflowError) as reason:
        raise ValueError(f"{file}: not a readable csv file ({reason})") from None
    if odd:
        raise ValueError(
            f"{file}, line {rows[odd[0].number - 1]}: {odd[0].actual_columns} cells "
            f"below a header of {len(names)}"
        )
    columns = {name: held.column(k).to_numpy() for k, name in enumerate(names)}
    return Table(str(file), columns, rows, "line", "," if comma else ".")


def _text(file: Path) -> str:
    """The text of a file, by its byte order mark, as UTF-8, or else Windows-1252.

    Raises:
        ValueError: zeros, which no text has.
    """
    with open_regular(file) as stream:
        content = stream.readall()
    encoding = "utf-8-sig"
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        # Recorders on Windows write the degree sign as one byte.
        text = content.decode("cp1252", errors="replace")
    if "\0" in text:
        raise ValueError(f"{file}: not a text file")
    return text


def _cells(line: str, between: str | None = None) -> tuple[list[str], str]:
    """The cells of a line, and the separator, which it has most of."""
    if between is None:
        most = max(",;\t", key=line.count)
        between = most if most in line else " "
    cells = line.split() if between == " " else line.split(between)
    return [cell.strip().strip('"').strip() for cell in cells], between


def _check_header(where: str, names: list[str]) -> None:
    """Refuse a header that does not name columns."""
    if all(map(_is_number, names)):
        raise ValueError(f"{where}: numbers where the names of the columns should be")
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"{where}: the column {twice[0]} appears twice")


def _is_number(value: Any, decimal: str = ".") -> bool:
    """Whether a cell is a number."""
    try:
        float(value.replace(decimal, ".") if isinstance(value, str) else value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def read_npz(file: Path) -> dict[str, Shaped[np.ndarray, ...]]:
    """Return the arrays of an npz file.

    Raises:
        ValueError: damaged, of another kind, with objects, or larger than DECODED bytes
            once inflated.
    """

    def read(stream: io.FileIO) -> dict[str, Shaped[np.ndarray, ...]]:
        with zipfile.ZipFile(stream) as packed:
            _check_decoded(sum(part.file_size for part in packed.infolist()))
        stream.seek(0)
        # Pickles would run code.
        with np.load(stream, allow_pickle=False) as opened:
            return {name: opened[name] for name in opened.files}

    return _guarded(file, "npz", read)


def read_parquet(file: Path) -> Table:
    """Read a parquet file.

    Raises:
        ValueError: pyarrow is missing, the file is damaged or of another kind, or
            larger than DECODED bytes once decoded.
    """
    parquet = _pyarrow("parquet", file)

    def read(stream: io.FileIO) -> Any:
        opened = parquet.ParquetFile(io.BufferedReader(stream))
        _check_decoded(_declared(opened.metadata))
        return opened.read()

    held = _guarded(file, "parquet", read)
    names = held.column_names
    if not held.num_rows:
        raise ValueError(f"{file}: no rows")
    if len(set(names)) < len(names):
        raise ValueError(f"{file}: two columns have one name")
    columns = {name: held.column(name).to_numpy() for name in names}
    return Table(str(file), columns, np.arange(held.num_rows))


def _pyarrow(module: str, file: Path) -> Any:
    """The csv or parquet module of pyarrow, which is an optional package.

    Raises:
        ValueError: it is not installed.
    """
    try:
        if module == "csv":
            from pyarrow import csv as found
        else:
            from pyarrow import parquet as found
    except ImportError:
        raise ValueError(
            f'{file}: {module} files need pyarrow: pip install "sfkd-jax[train]"'
        ) from None
    return found


def _guarded(file: Path, kind: str, read: Callable[[io.FileIO], Any]) -> Any:
    """Read a file; a damaged one is one line, whatever the library raises.

    Raises:
        ValueError: the file cannot be read.
    """
    with open_regular(file) as stream:
        try:
            return read(stream)
        except Exception as reason:  # a damaged file raises nearly anything
            first = (str(reason).splitlines() or [type(reason).__name__])[0]
            raise ValueError(f"{file}: not a readable {kind} file ({first})") from None


def _check_decoded(size: int) -> None:
    """Refuse what would fill the memory."""
    if size > DECODED:
        raise ValueError(
            f"{size >> 20} MiB once decoded, at most {DECODED >> 20} are read"
        )


def _declared(about: Any) -> int:
    """Decoded size that a parquet file declares, by its values and pages [bytes]."""
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    columns = [group.column(k) for group in groups for k in range(group.num_columns)]
    values = sum(max(column.num_values, 0) for column in columns)
    rows = sum(max(group.num_rows, 0) * group.num_columns for group in groups)
    pages = sum(max(column.total_uncompressed_size, 0) for column in columns)
    return max(
        8 * values, 8 * rows, 8 * max(about.num_rows, 0) * about.num_columns, pages
    )
