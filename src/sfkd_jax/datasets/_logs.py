"""Recorded drives as they stand in files, before anything is checked, resampled or cut."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sfkd_jax.artefacts import ArtefactError, one_line, read_npz
from sfkd_jax.datasets._files import digest, log_files
from sfkd_jax.datasets._tables import Table, read_csv, read_parquet

STACKED = ("x", "u", "e")
"""Arrays of an npz file of whole drives, each (drive, time, entry); x has one moment
more.
"""
UNTOLD = 2
"""Entries of the constant environment that stands for one that nobody measured."""


class Columns(NamedTuple):
    """How logs name what they hold.

    Attributes:
        time: [s].
        state: position [m], yaw [rad, counter-clockwise from the x axis], speed [m/s],
            then any others.
        control: the two commands.
        environment: any number of them, or none.
        drive: a column that tells drives in one file apart, or None: every file is a
            drive.
    """

    time: str = "t"
    state: tuple[str, ...] = ("p_x", "p_y", "yaw", "v")
    control: tuple[str, ...] = ("steering", "acceleration")
    environment: tuple[str, ...] = ("friction", "wind")
    drive: str | None = None


class Log(NamedTuple):
    """One drive as it was recorded.

    Attributes:
        source: file, and drive if there are several in it.
        rows, counted: where its rows stand, see `Table`.
        time: [s].
        states, controls, envs: one row a moment; envs are zeros where nobody measured
            them.
    """

    source: str
    rows: Int[np.ndarray, " time"]
    counted: str
    time: Float[np.ndarray, " time"]
    states: Float[np.ndarray, "time state"]
    controls: Float[np.ndarray, "time control"]
    envs: Float[np.ndarray, "time environment"]

    def at(self, index: int) -> str:
        """Where a row stands, for a person."""
        return f"{self.source}, {self.counted} {self.rows[index]}"

    @property
    def whole(self) -> str:
        """Where the drive stands, for a person."""
        return f"{self.source}, {self.counted}s {self.rows[0]} to {self.rows[-1]}"


def read_logs(
    path: str, columns: Columns, *, dt: float, told: bool
) -> tuple[list[Log], list[str]]:
    """All drives of a path, in an order that the names of the files do not change, and what could not be read.

    Args:
        path: a file, a folder or a glob.
        columns: their names.
        dt: the period of npz arrays x, u, e that come without a time [s].
        told: whether an environment is needed; else one that is not in the files
            becomes zeros.

    Raises:
        ValueError: no files, or names of columns that cannot be meant.
    """
    _check_columns(columns, told)
    logs: list[Log] = []
    lines: list[str] = []
    for file in sorted(log_files(path), key=digest):
        try:
            logs += _open(file, columns, dt, told)
        except (ArtefactError, ValueError) as reason:
            lines.append(one_line(reason))
    return logs, sorted(lines)


def _check_columns(columns: Columns, told: bool) -> None:
    """Refuse names that no file could satisfy."""
    if len(columns.state) < 4:
        raise ValueError(
            "dataset.columns.state must name position, position, yaw and speed first, got too few columns"
        )
    if len(columns.control) != 2:
        raise ValueError(
            f"dataset.columns.control must name two columns, got {len(columns.control)}"
        )
    names = [columns.time, *columns.state, *columns.control, *columns.environment]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"dataset.columns names {twice[0]} twice")
    if told and not columns.environment:
        raise ValueError(
            "dataset.columns.environment is empty: pass env_source=none, or name the columns that were measured"
        )


def _open(file: Path, columns: Columns, dt: float, told: bool) -> list[Log]:
    """The drives of one file."""
    if file.suffix.lower() == ".npz":
        arrays = read_npz(file)
        if {"x", "u"} <= set(arrays) and columns.state[0] not in arrays:
            return _stacked(str(file), arrays, columns, dt, told)
        table = _flat(str(file), arrays, columns)
    else:
        table = (read_parquet if file.suffix.lower() == ".parquet" else read_csv)(file)
    return _drives(table, columns, told)


def _flat(source: str, arrays: dict[str, np.ndarray], columns: Columns) -> Table:
    """Arrays of an npz file, one a column; others that it holds do not count."""
    wanted = [
        columns.time,
        *columns.state,
        *columns.control,
        *columns.environment,
        columns.drive,
    ]
    used = {name: array for name, array in arrays.items() if name in wanted}
    shapes = {name: array.shape for name, array in used.items()}
    if odd := [
        name
        for name, shape in shapes.items()
        if len(shape) != 1 or shape != next(iter(shapes.values()))
    ]:
        first = next(iter(shapes))
        raise ValueError(
            f"{source}: {odd[0]} has shape {shapes[odd[0]]}, {first} {shapes[first]}: one number a moment"
        )
    count = next(iter(shapes.values()))[0] if shapes else 0
    if shapes and not count:
        raise ValueError(f"{source}: no rows")
    return Table(
        source, used or dict.fromkeys(arrays, np.zeros(0)), np.arange(count), "row"
    )


def _drives(table: Table, columns: Columns, told: bool) -> list[Log]:
    """A table cut where its drive column changes value."""
    environment = _environment(table.source, columns, table.columns.__contains__, told)
    for setting in ("time", "state", "control"):
        names = getattr(columns, setting)
        _demand(table, setting, [names] if isinstance(names, str) else list(names))
    time = table.numbers(columns.time)
    parts = [
        np.column_stack([table.numbers(n) for n in names])
        for names in (columns.state, columns.control)
    ]
    told_envs = [table.numbers(name) for name in environment]
    parts.append(
        np.column_stack(told_envs) if environment else np.zeros((len(time), UNTOLD))
    )
    if columns.drive is None:
        return [Log(table.source, table.rows, table.counted, time, *parts)]
    _demand(table, "drive", [columns.drive])
    labels = table.columns[columns.drive]
    if labels.dtype.kind == "f" and np.isnan(labels).any():
        row = table.rows[np.isnan(labels).argmax()]
        raise ValueError(
            f"{table.source}, {table.counted} {row}: {columns.drive} is nan, so its drive is unknown"
        )
    chosen = [
        (label, np.flatnonzero(labels == label))
        for label in dict.fromkeys(labels.tolist())
    ]
    return [
        Log(
            f"{table.source}, drive {label}",
            table.rows[k],
            table.counted,
            time[k],
            *(part[k] for part in parts),
        )
        for label, k in chosen
    ]


def _demand(table: Table, setting: str, names: list[str]) -> None:
    """Refuse a table that lacks a column, naming the setting that maps it."""
    if absent := [name for name in names if name not in table.columns]:
        held = ", ".join(list(table.columns)[:12])
        advice = f"map it with dataset.columns.{setting}"
        raise ValueError(
            f"{table.source}: no column {absent[0]} among {held}; {advice}"
        )


def _environment(
    source: str, columns: Columns, held: Callable[[str], bool], told: bool
) -> tuple[str, ...]:
    """Which of the environment's columns to read: all, or none where nobody measured any and none is needed."""
    absent = [name for name in columns.environment if not held(name)]
    if not absent or (not told and len(absent) == len(columns.environment)):
        return () if absent else columns.environment
    advice = "pass env_source=none, or map the columns with dataset.columns.environment"
    raise ValueError(f"{source}: no column {absent[0]} for the environment; {advice}")


def _stacked(
    source: str, arrays: dict[str, np.ndarray], columns: Columns, dt: float, told: bool
) -> list[Log]:
    """Whole drives as arrays x, u and e; without a time their rows are dt apart."""
    present = _environment(
        source, columns._replace(environment=("e",)), arrays.__contains__, told
    )
    wanted = {name: arrays[name] for name in STACKED if name in ("x", "u") or present}
    wanted = {
        name: array[None] if array.ndim == 2 else array
        for name, array in wanted.items()
    }
    for name, array in wanted.items():
        if array.ndim != 3 or array.dtype.kind not in "iuf":
            raise ValueError(
                f"{source}: {name} must be numbers of shape (drive, time, entry), got {array.shape}"
            )
    drives, steps = wanted["x"].shape[0], wanted["x"].shape[1] - 1
    sizes = {
        "x": len(columns.state),
        "u": 2,
        "e": len(columns.environment) or wanted.get("e", np.zeros(1)).shape[-1],
    }
    for name, array in wanted.items():
        long = steps + 1 if name == "x" else steps
        if array.shape != (drives, long, sizes[name]):
            raise ValueError(
                f"{source}: {name} has shape {array.shape}, expected {(drives, long, sizes[name])}"
            )
    if steps < 1 or not drives:
        raise ValueError(f"{source}: no steps in x of shape {wanted['x'].shape}")
    time = arrays[columns.time] if columns.time in arrays else dt * np.arange(steps + 1)
    if time.dtype.kind not in "iuf":
        raise ValueError(f"{source}: {columns.time} must be numbers, got {time.dtype}")
    time = time.astype(np.float64)
    if time.shape not in ((steps + 1,), (drives, steps + 1)):
        raise ValueError(
            f"{source}: {columns.time} has shape {time.shape}, expected {(drives, steps + 1)}"
        )
    time = np.broadcast_to(time, (drives, steps + 1))
    x, u = (np.asarray(wanted[name], dtype=np.float64) for name in ("x", "u"))
    e = (
        np.asarray(wanted["e"], dtype=np.float64)
        if present
        else np.zeros((drives, steps, UNTOLD))
    )
    held = [
        np.concatenate([part, part[:, -1:]], axis=1) for part in (u, e)
    ]  # of the last moment nothing is known
    rows, parts = np.arange(steps + 1), (time, x, *held)
    return [
        Log(f"{source}, drive {k}", rows, "row", *(part[k] for part in parts))
        for k in range(drives)
    ]
