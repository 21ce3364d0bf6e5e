"""Read recorded drives from csv, npz and parquet files."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from sfkd_jax.data._files import digest, log_files
from sfkd_jax.data._logs import UNKNOWN, Columns, Log, environment_columns
from sfkd_jax.data._stacked import stacked_drives
from sfkd_jax.data._tables import Table, read_csv, read_npz, read_parquet
from sfkd_jax.data._units import find_column, split_unit
from sfkd_jax.store import ArtefactError, one_line

DIMENSIONS = ("length", "length", "angle", "speed")
"""Of the first states."""


class LogFiles(NamedTuple):
    """What was read from files.

    Attributes:
        logs: drives, in an order that does not depend on the names of files.
        errors: one line per file that could not be read.
        conversions: of columns to SI units.
    """

    logs: list[Log]
    errors: list[str]
    conversions: list[str]


def read_logs(
    path: str, columns: Columns, *, dt: float, needs_environment: bool
) -> LogFiles:
    """Read all drives of a path.

    Args:
        path: a file, a folder or a glob.
        columns: their names.
        dt: the period of npz arrays x, u, e without a time [s].
        needs_environment: whether the environment must be in the files; otherwise one
            that is not becomes zeros.

    Raises:
        ValueError: no files, or invalid names of columns.
    """
    _check_columns(columns, needs_environment)
    read = LogFiles([], [], [])
    for file in sorted(log_files(path), key=digest):
        try:
            logs, conversions = _read(file, columns, dt, needs_environment)
        except (ArtefactError, ValueError) as reason:
            read.errors.append(one_line(reason))
            continue
        read.logs.extend(logs)
        read.conversions.extend(conversions)
    unique = list(dict.fromkeys(read.conversions))
    return LogFiles(read.logs, sorted(read.errors), unique)


def _check_columns(columns: Columns, needs_environment: bool) -> None:
    """Refuse names that no file could satisfy."""
    if len(columns.state) < 4:
        raise ValueError(
            "dataset.columns.state must name position, position, yaw and speed first, "
            "got too few columns"
        )
    if len(columns.control) != 2:
        raise ValueError(
            f"dataset.columns.control must name two columns, got {len(columns.control)}"
        )
    names = [columns.time, *columns.state, *columns.control, *columns.environment]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"dataset.columns names {twice[0]} twice")
    if needs_environment and not columns.environment:
        raise ValueError(
            "dataset.columns.environment is empty: pass environment.source=none, "
            "or name the columns that were measured"
        )


def _read(
    file: Path, columns: Columns, dt: float, needs_environment: bool
) -> tuple[list[Log], list[str]]:
    """The drives of one file, and conversions of its columns."""
    if file.suffix.lower() == ".npz":
        arrays = read_npz(file)
        if {"x", "u"} <= set(arrays) and columns.state[0] not in arrays:
            return stacked_drives(str(file), arrays, columns, dt, needs_environment), []
        table = _flat(str(file), arrays, columns)
    else:
        table = (read_parquet if file.suffix.lower() == ".parquet" else read_csv)(file)
    table, conversions = _in_si(table, columns)
    return _drives(table, columns, needs_environment), conversions


def _flat(source: str, arrays: dict[str, np.ndarray], columns: Columns) -> Table:
    """Arrays of an npz file, one per column; its other arrays are ignored."""
    wanted = {*columns.state, *columns.control, *columns.environment}
    wanted |= {columns.time, columns.drive}
    used = {
        name: array
        for name, array in arrays.items()
        if name in wanted or (split_unit(name) or ("",))[0] in wanted
    }
    shapes = {name: array.shape for name, array in used.items()}
    if odd := [
        name
        for name, shape in shapes.items()
        if len(shape) != 1 or shape != next(iter(shapes.values()))
    ]:
        first = next(iter(shapes))
        raise ValueError(
            f"{source}: {odd[0]} has shape {shapes[odd[0]]}, {first} {shapes[first]}: "
            "one number a moment"
        )
    count = next(iter(shapes.values()))[0] if shapes else 0
    if shapes and not count:
        raise ValueError(f"{source}: no rows")
    return Table(
        source, used or dict.fromkeys(arrays, np.zeros(0)), np.arange(count), "row"
    )


def _in_si(table: Table, columns: Columns) -> tuple[Table, list[str]]:
    """The table under configured names in SI units, and the conversions."""
    dimensions: dict[str, str | None] = {columns.time: "time"}
    dimensions |= dict.fromkeys(
        (*columns.state, *columns.control, *columns.environment)
    )
    dimensions |= dict(zip(columns.state, DIMENSIONS, strict=False))
    names, factors, conversions = {}, {}, []
    for name, dimension in dimensions.items():
        try:
            match = find_column(name, table.columns, dimension)
        except ValueError as reason:
            raise ValueError(f"{table.source}: {reason}") from None
        if match is None:
            continue
        names[match.header], factors[name] = name, match.factor
        conversions += [match.conversion] if match.conversion else []
    held = {names.get(header, header): a for header, a in table.columns.items()}
    return table._replace(columns=held, factors=factors), conversions


def _drives(table: Table, columns: Columns, needs_environment: bool) -> list[Log]:
    """A table as one log, or as one log per value of its drive column."""
    environment = environment_columns(
        table.source, columns, set(table.columns), needs_environment
    )
    for setting in ("time", "state", "control"):
        names = getattr(columns, setting)
        _require(table, setting, [names] if isinstance(names, str) else list(names))
    time = table.numbers(columns.time)
    states, controls = (
        np.column_stack([table.numbers(n) for n in names])
        for names in (columns.state, columns.control)
    )
    measured = [table.numbers(name) for name in environment]
    envs = np.column_stack(measured) if measured else np.zeros((len(time), UNKNOWN))
    log = Log(
        table.source,
        table.rows,
        table.row_name,
        time,
        states,
        controls,
        envs,
        np.zeros(len(time), dtype=int),
    )
    return [log] if columns.drive is None else _by_drive(table, columns.drive, log)


def _by_drive(table: Table, column: str, log: Log) -> list[Log]:
    """A log split by the values of the drive column."""
    _require(table, "drive", [column])
    labels = table.columns[column]
    if labels.dtype.kind == "f" and np.isnan(labels).any():
        row = table.rows[np.isnan(labels).argmax()]
        raise ValueError(
            f"{table.source}, {table.row_name} {row}: {column} is nan, "
            "so its drive is unknown"
        )
    return [
        log.select(labels == label)._replace(
            source=f"{table.source}, drive {label}",
            stretch=np.zeros(int((labels == label).sum()), dtype=int),
        )
        for label in dict.fromkeys(labels.tolist())
    ]


def _require(table: Table, setting: str, names: list[str]) -> None:
    """Refuse a table that lacks a column, naming the setting that maps it."""
    if absent := [name for name in names if name not in table.columns]:
        present = ", ".join(list(table.columns)[:12])
        raise ValueError(
            f"{table.source}: no column {absent[0]} among {present}; "
            f"map it with dataset.columns.{setting}"
        )
