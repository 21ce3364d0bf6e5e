"""Read recorded runs from csv, npz and parquet files, in SI units."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sfkd_jax.driving.logs._column_names import Match, among, find_column
from sfkd_jax.driving.logs._logs import Columns, Log
from sfkd_jax.driving.logs._tables import Table, read_csv, read_npz, read_parquet
from sfkd_jax.store import ArtefactError, one_line

UNKNOWN = 2
"""Number of entries of the constant environment that replaces an unknown one."""
FIRST_DIMENSIONS = ("time", "length", "length", "angle", "speed")
"""Dimensions of the time and of the first states."""
RUN = "number of the run"
"""Column that numbers the runs in tables made of arrays x, u, e."""


def read_logs(
    files: Iterable[Path],
    columns: Columns,
    *,
    dt: float,
    needs_environment: bool,
    blanks: bool = False,
) -> tuple[list[Log], list[str], list[str]]:
    """Read all runs of csv, npz and parquet files.

    Args:
        files: to read.
        columns: their names.
        dt: the period of npz arrays x, u, e without a time [s].
        needs_environment: whether the environment must be in the files. If not, it
            counts as unknown and becomes zeros.
        blanks: whether empty cells are NaN; otherwise they are errors.

    Returns:
        All runs, in the order of the files; one line per file that could not be read;
        conversions of columns to SI units.

    Raises:
        ValueError: no file could satisfy these columns.
    """
    _check_columns(columns, needs_environment)
    logs: list[Log] = []
    errors: list[str] = []
    conversions: list[str] = []
    for file in files:
        # A file that cannot be read does not stop the others: one call finds all
        # faults.
        try:
            table = _table(file, columns, dt, blanks)
            runs, converted = _runs(table, columns, needs_environment)
        except (ArtefactError, ValueError) as reason:
            errors.append(one_line(reason))
            continue
        logs += runs
        conversions += converted
    return logs, sorted(errors), list(dict.fromkeys(conversions))


def _check_columns(columns: Columns, needs_environment: bool) -> None:
    """Refuse names that no file could satisfy."""
    names = [columns.time, *columns.state, *columns.control, *columns.environment]
    # A name that appears twice would read one column as two channels.
    repeated = [name for index, name in enumerate(names) if name in names[:index]]
    if repeated:
        raise ValueError(f"dataset.columns names {repeated[0]} twice")
    if needs_environment and not columns.environment:
        raise ValueError(
            "dataset.columns.environment is empty: pass environment.source=none, "
            "or name the columns that were measured"
        )


def _table(file: Path, columns: Columns, dt: float, blanks: bool) -> Table:
    """Read the configured columns of a file."""
    wanted = [columns.time, *columns.state, *columns.control, *columns.environment]
    if columns.run:
        wanted.append(columns.run)
    suffix = file.suffix.lower()
    if suffix == ".csv":
        return read_csv(file, wanted, blanks=blanks)
    if suffix == ".parquet":
        return read_parquet(file, wanted)
    source = str(file)
    used, names = read_npz(file, partial(_arrays_to_read, columns, wanted))
    if _holds_whole_runs(names, columns):
        return _table_of_arrays(source, used, columns, dt)
    # Without any such array, a later message lists those that the file has.
    first = next(iter(used), "")
    shape = used[first].shape if used else (1,)
    for name, array in used.items():
        if array.ndim != 1 or array.shape != shape:
            raise ValueError(
                f"{source}: {name} has shape {array.shape}, {first} {shape}: "
                "one number a moment"
            )
    if not shape[0]:
        raise ValueError(f"{source}: no rows")
    return Table(source, used, names, np.arange(shape[0]))


def _holds_whole_runs(names: Collection[str], columns: Columns) -> bool:
    """Return whether an npz file has arrays x and u in place of columns."""
    return {"x", "u"} <= set(names) and columns.state[0] not in names


def _arrays_to_read(
    columns: Columns, wanted: Collection[str], names: list[str]
) -> list[str]:
    """Return which arrays of an npz file are read.

    Args:
        columns: configured names.
        wanted: the same in a row, of all channels.
        names: of the arrays in the file.
    """
    if _holds_whole_runs(names, columns):
        return [name for name in names if name in ("x", "u", "e", columns.time)]
    return among(names, wanted)


def _table_of_arrays(
    source: str, arrays: dict[str, np.ndarray], columns: Columns, dt: float
) -> Table:
    """Return arrays of several runs as a table, one run below the other.

    Args:
        source: the file.
        arrays: x (run, time + 1, state), u (run, time, control), optionally e (run,
            time, environment) and the time (time + 1,) or (run, time + 1). An array of
            a single run may lack the first axis.
        columns: names of the entries.
        dt: the period if there is no time [s].
    """
    parts = {"x": columns.state, "u": columns.control}
    if "e" in arrays and columns.environment:
        parts["e"] = columns.environment
    of_runs = {}
    for name in parts:
        array = arrays[name]
        of_runs[name] = array[None] if array.ndim == 2 else array
    # Zeros stand for axes that x lacks; the check of its shape refuses it below.
    count, moments = (*of_runs["x"].shape, 0, 0)[:2]
    time = np.asarray(arrays.get(columns.time, dt * np.arange(moments)))
    shapes: dict[str, tuple[int, ...]] = {}
    for name, names in parts.items():
        steps = moments if name == "x" else moments - 1
        shapes[name] = (count, steps, len(names))
    shapes[columns.time] = (moments,) if time.ndim == 1 else (count, moments)
    for name, array in {**of_runs, columns.time: time}.items():
        shape = shapes[name]
        if array.dtype.kind not in "iuf" or array.shape != shape or 0 in shape:
            raise ValueError(
                f"{source}: {name} must be numbers of shape {shape}, "
                f"got {array.dtype} {array.shape}"
            )
    table = {
        columns.time: np.broadcast_to(time, (count, moments)).ravel(),
        RUN: np.repeat(np.arange(count), moments),
    }
    for name, names in parts.items():
        array = of_runs[name]
        # u and e of the last moment are unknown. Nothing uses their copies.
        if name != "x":
            array = np.concatenate([array, array[:, -1:]], axis=1)
        table.update(zip(names, array.reshape(-1, len(names)).T, strict=True))
    rows = np.tile(np.arange(moments), count)
    return Table(source, table, tuple(arrays), rows, run=RUN)


def _runs(
    table: Table, columns: Columns, needs_environment: bool
) -> tuple[list[Log], list[str]]:
    """Return the runs of a table in SI units, and the conversions."""
    run = table.run or columns.run
    environment = columns.environment if needs_environment else ()
    matches = _find_columns(table, columns, environment, run)

    def stacked(names: tuple[str, ...]) -> Float[np.ndarray, "time channel"]:
        used = [matches[name] for name in names]
        return np.column_stack(
            [table.numbers(match.header, match.factor) for match in used]
        )

    size = len(table.rows)
    states = stacked(columns.state)
    log = Log(
        source=table.source,
        rows=table.rows,
        row_name=table.row_name,
        time=stacked((columns.time,))[:, 0],
        states=states,
        controls=stacked(columns.control),
        envs=stacked(environment) if environment else np.zeros((size, UNKNOWN)),
        stretch=np.zeros(size, dtype=int),
    )
    conversions = [match.conversion for match in matches.values() if match.conversion]
    if run is None:
        return [log], conversions
    labels = table.columns[matches[run].header]
    if labels.dtype.kind == "f" and np.isnan(labels).any():
        row = int(np.isnan(labels).argmax())
        raise ValueError(f"{log.at(row)}: {run} is nan, so its run is unknown")
    return _split_by_label(log, labels), conversions


def _find_columns(
    table: Table,
    columns: Columns,
    environment: tuple[str, ...],
    run: str | None,
) -> dict[str, Match]:
    """Return the column of a table that each configured name stands for.

    Args:
        table: of a file.
        columns: configured names.
        environment: those of the environment that are needed.
        run: the column that numbers the runs, or None.

    Raises:
        ValueError: a column is missing, or has a unit of another dimension.
    """
    wanted = {
        "time": (columns.time,),
        "state": columns.state,
        "control": columns.control,
        "environment": environment,
        "run": () if run is None else (run,),
    }
    dimensions: dict[str, str | None] = dict.fromkeys(chain(*wanted.values()))
    dimensions.update(
        zip((columns.time, *columns.state), FIRST_DIMENSIONS, strict=False)
    )
    matches: dict[str, Match] = {}
    try:
        for name, dimension in dimensions.items():
            match = find_column(name, table.columns, dimension)
            if match is not None:
                matches[name] = match
    except ValueError as reason:
        raise ValueError(f"{table.source}: {reason}") from None
    for setting, names in wanted.items():
        absent = [name for name in names if name not in matches]
        if absent:
            hint = f"map it with dataset.columns.{setting}"
            if setting == "environment":
                hint += ", or pass environment.source=none"
            present = ", ".join(table.headers[:12])
            raise ValueError(
                f"{table.source}: no column {absent[0]} among {present}; {hint}"
            )
    return matches


def _split_by_label(log: Log, labels: np.ndarray) -> list[Log]:
    """Return the runs of a file, which a column numbers.

    The rows of a run continue each other, even if rows of another run lie between them
    in the file.
    """
    logs = []
    for label in dict.fromkeys(labels.tolist()):
        run = log.select(labels == label)
        source = f"{log.source}, run {label}"
        stretch = np.zeros(len(run.rows), dtype=int)
        logs.append(replace(run, source=source, stretch=stretch))
    return logs
