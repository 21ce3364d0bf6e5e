"""Read recorded drives: columns by their names, in SI units, one log per drive."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sfkd_jax.data._tables import (
    Table,
    digest,
    log_files,
    read_csv,
    read_npz,
    read_parquet,
)
from sfkd_jax.data._units import find_column, name_of
from sfkd_jax.ranges import Names
from sfkd_jax.store import ArtefactError, one_line

UNKNOWN = 2
"""Entries of the constant environment that replaces one that nobody measured."""
DIMENSIONS = ("length", "length", "angle", "speed")
"""Of the first states."""


class Columns(NamedTuple):
    """Names of the columns of a log.

    Attributes:
        time: [s].
        state: position [m], yaw [rad, counter-clockwise from the x axis], speed [m/s],
            then any others.
        control: the two commands.
        environment: any number of them, or none.
        drive: a column that numbers the drives in one file, or None: every file is one
            drive.
    """

    time: str = "t"
    state: tuple[str, ...] = ("p_x", "p_y", "yaw", "v")
    control: tuple[str, ...] = ("steering", "acceleration")
    environment: Names = ("friction", "wind")
    drive: str | None = None


@dataclass(frozen=True)
class Log:
    """One recorded drive.

    Attributes:
        source: file, and drive if there are several in it.
        rows: position of each row in the file.
        row_name: what `rows` counts, "line" or "row".
        time: [s].
        states: one row per moment.
        controls: one row per moment.
        envs: one row per moment; zeros where nobody measured them.
        stretch: number of the uninterrupted stretch that each row belongs to.
    """

    source: str
    rows: Int[np.ndarray, " time"]
    row_name: str
    time: Float[np.ndarray, " time"]
    states: Float[np.ndarray, "time state"]
    controls: Float[np.ndarray, "time control"]
    envs: Float[np.ndarray, "time environment"]
    stretch: Int[np.ndarray, " time"]

    def at(self, index: int) -> str:
        """Return the position of a row, for messages."""
        return f"{self.source}, {self.row_name} {self.rows[index]}"

    @property
    def whole(self) -> str:
        """The position of the drive, for messages."""
        return f"{self.source}, {self.row_name}s {self.rows[0]} to {self.rows[-1]}"

    @property
    def joined(self) -> Bool[np.ndarray, " step"]:
        """Whether each row but the first continues the row before it."""
        return self.stretch[1:] == self.stretch[:-1]

    def select(self, chosen: Bool[np.ndarray, " time"]) -> Log:
        """Return the chosen rows, cut where rows between them are left out."""
        arrays = {
            name: getattr(self, name)[chosen]
            for name in ("rows", "time", "states", "controls", "envs")
        }
        left_out = np.concatenate([[0], np.cumsum(~chosen)])[:-1]
        return replace(self, stretch=(self.stretch + left_out)[chosen], **arrays)

    def cut(self, before: Bool[np.ndarray, " step"]) -> Log:
        """Return the same rows, cut before every row that is marked."""
        cuts = np.concatenate([[0], np.cumsum(before)])
        return replace(self, stretch=self.stretch + cuts)


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
    # The order of contents: a data set does not depend on the names of its files.
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
    suffix = file.suffix.lower()
    if suffix == ".npz":
        arrays = read_npz(file)
        if {"x", "u"} <= set(arrays) and columns.state[0] not in arrays:
            return _stacked(str(file), arrays, columns, dt, needs_environment), []
        table = _one_per_column(str(file), arrays, columns)
    elif suffix == ".parquet":
        table = read_parquet(file)
    else:
        table = read_csv(file, columns.time)
    table, conversions = _in_si(table, columns)
    return _drives(table, columns, needs_environment), conversions


def _one_per_column(
    source: str, arrays: dict[str, np.ndarray], columns: Columns
) -> Table:
    """Arrays of an npz file, one per column; its other arrays are ignored."""
    wanted = {*columns.state, *columns.control, *columns.environment}
    wanted |= {columns.time, columns.drive}
    used = {
        name: array
        for name, array in arrays.items()
        if name in wanted or name_of(name) in wanted
    }
    if not used:  # a later message lists what the file has
        return Table(source, dict.fromkeys(arrays, np.zeros(0)), np.arange(0))
    first, shape = next((name, array.shape) for name, array in used.items())
    for name, array in used.items():
        if array.ndim != 1 or array.shape != shape:
            raise ValueError(
                f"{source}: {name} has shape {array.shape}, {first} {shape}: "
                "one number a moment"
            )
    if not shape[0]:
        raise ValueError(f"{source}: no rows")
    return Table(source, used, np.arange(shape[0]))


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
    return replace(table, columns=held, factors=factors), conversions


def _drives(table: Table, columns: Columns, needs_environment: bool) -> list[Log]:
    """A table as one log, or as one log per value of its drive column."""
    measured = _environment(
        table.source, columns.environment, set(table.columns), needs_environment
    )
    drive = () if columns.drive is None else (columns.drive,)
    wanted = {"time": (columns.time,), "state": columns.state}
    for setting, names in (
        wanted | {"control": columns.control, "drive": drive}
    ).items():
        if absent := [name for name in names if name not in table.columns]:
            present = ", ".join(list(table.columns)[:12])
            raise ValueError(
                f"{table.source}: no column {absent[0]} among {present}; "
                f"map it with dataset.columns.{setting}"
            )
    time = table.numbers(columns.time)

    def stacked(names: tuple[str, ...]) -> Float[np.ndarray, "time channel"]:
        return np.column_stack([table.numbers(name) for name in names])

    log = Log(
        source=table.source,
        rows=table.rows,
        row_name=table.row_name,
        time=time,
        states=stacked(columns.state),
        controls=stacked(columns.control),
        envs=stacked(measured) if measured else np.zeros((len(time), UNKNOWN)),
        stretch=np.zeros(len(time), dtype=int),
    )
    if columns.drive is None:
        return [log]
    labels = table.columns[columns.drive]
    if labels.dtype.kind == "f" and np.isnan(labels).any():
        raise ValueError(
            f"{log.at(int(np.isnan(labels).argmax()))}: {columns.drive} is nan, "
            "so its drive is unknown"
        )
    # Rows of one drive continue each other, whatever lies between them in the file.
    return [
        replace(
            log.select(labels == label),
            source=f"{table.source}, drive {label}",
            stretch=np.zeros(int((labels == label).sum()), dtype=int),
        )
        for label in dict.fromkeys(labels.tolist())
    ]


def _environment(
    source: str, names: tuple[str, ...], present: set[str], needed: bool
) -> tuple[str, ...]:
    """Return the environment's columns to read: all, or none if none is needed.

    Raises:
        ValueError: a column is missing.
    """
    absent = [name for name in names if name not in present]
    if not absent:
        return names
    if not needed and len(absent) == len(names):
        return ()
    raise ValueError(
        f"{source}: no column {absent[0]} for the environment; "
        "pass environment.source=none, or map the columns with "
        "dataset.columns.environment"
    )


def _stacked(
    source: str,
    arrays: dict[str, np.ndarray],
    columns: Columns,
    dt: float,
    needs_environment: bool,
) -> list[Log]:
    """The drives of arrays x (drive, time + 1, state), u and e (drive, time, entry).

    Raises:
        ValueError: arrays of other shapes, or that are no numbers.
    """
    measured = _environment(source, ("e",), set(arrays), needs_environment)
    wanted = {
        name: arrays[name][None] if arrays[name].ndim == 2 else arrays[name]
        for name in ("x", "u", *measured)
    }
    for name, array in wanted.items():
        if array.ndim != 3 or array.dtype.kind not in "iuf":
            raise ValueError(
                f"{source}: {name} must be numbers of shape (drive, time, entry), "
                f"got {array.shape}"
            )
    count, steps = wanted["x"].shape[0], wanted["x"].shape[1] - 1
    entries = wanted["e"].shape[-1] if measured else 0
    sizes = {
        "x": (count, steps + 1, len(columns.state)),
        "u": (count, steps, 2),
        "e": (count, steps, len(columns.environment) or entries),
    }
    for name, array in wanted.items():
        if array.shape != sizes[name]:
            raise ValueError(
                f"{source}: {name} has shape {array.shape}, expected {sizes[name]}"
            )
    if steps < 1 or not count:
        raise ValueError(f"{source}: no steps in x of shape {wanted['x'].shape}")
    time = np.asarray(arrays.get(columns.time, dt * np.arange(steps + 1)))
    shape = (count, steps + 1)
    if time.dtype.kind not in "iuf" or time.shape not in (shape[1:], shape):
        raise ValueError(
            f"{source}: {columns.time} must be numbers of shape {shape}, "
            f"got {time.dtype} {time.shape}"
        )
    time = np.broadcast_to(time.astype(np.float64), shape)
    x, u = (wanted[name].astype(np.float64) for name in "xu")
    e = np.zeros((count, steps, UNKNOWN))
    if measured:
        e = wanted["e"].astype(np.float64)
    # u and e of the last moment are unknown and never used.
    u, e = (np.concatenate([part, part[:, -1:]], axis=1) for part in (u, e))
    rows, stretch = np.arange(steps + 1), np.zeros(steps + 1, dtype=int)
    return [
        Log(f"{source}, drive {k}", rows, "row", time[k], x[k], u[k], e[k], stretch)
        for k in range(count)
    ]
