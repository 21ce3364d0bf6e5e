"""Recorded runs: columns by their names, in SI units, one log per run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sfkd_jax.data._tables import (
    Table,
    among,
    find_column,
    read_csv,
    read_npz,
    read_parquet,
)
from sfkd_jax.ranges import Names
from sfkd_jax.store import ArtefactError, one_line

UNKNOWN = 2
"""Entries of the constant environment that replaces one that nobody measured."""
DIMENSIONS = ("time", "length", "length", "angle", "speed")
"""Of the time and the first states."""
LOOK = 0.5
"""Length of the chords over which motion is compared with the columns [s]."""
LATEST, LAGS, FEWEST = 1.0, 401, 20
"""Largest delay that is looked for [s], how many are, and chords that it takes."""
RUN = "number of the run"
"""Column of tables of arrays x, u, e."""


class Columns(NamedTuple):
    """Names of the columns of a log.

    Attributes:
        time: [s].
        state: position [m], yaw [rad, counter-clockwise from the x axis], speed [m/s],
            then any others.
        control: the two commands.
        environment: any number of them, or none.
        run: a column that numbers the runs in one file, or None: every file is one run.
    """

    time: str = "t"
    state: tuple[str, ...] = ("p_x", "p_y", "yaw", "v")
    control: tuple[str, str] = ("steering", "acceleration")
    environment: Names = ("friction", "wind")
    run: str | None = None


@dataclass(frozen=True)
class Log:
    """One recorded run.

    Attributes:
        source: file, and run if there are several in it.
        rows: position of each row in the file.
        row_name: what `rows` counts, "line" or "row".
        time: [s].
        envs: zeros where nobody measured them.
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

    def between(self, first: int, last: int) -> str:
        """Return the position of several rows, for messages."""
        rows = self.rows[first], self.rows[last]
        return f"{self.source}, {self.row_name}s {rows[0]} to {rows[1]}"

    @property
    def whole(self) -> str:
        """The position of the run, for messages."""
        return self.between(0, -1)

    @property
    def steps(self) -> Float[np.ndarray, "step channel"]:
        """Motion in the frame of every row, and what the row holds beside its pose.

        A copy keeps it, wherever and whenever it begins.
        """
        yaw = self.states[:-1, 2]
        (x, y) = np.diff(self.states[:, :2], axis=0).T
        ahead = np.cos(yaw) * x + np.sin(yaw) * y
        aside = np.cos(yaw) * y - np.sin(yaw) * x
        turned = np.diff(np.unwrap(self.states[:, 2]))
        held = np.column_stack([self.states[:, 3:], self.controls, self.envs])[:-1]
        return np.column_stack([ahead, aside, turned, held])

    @cached_property
    def joined(self) -> Bool[np.ndarray, " step"]:
        """Whether each row but the first continues the row before it."""
        return self.stretch[1:] == self.stretch[:-1]

    @cached_property
    def waits(self) -> Float[np.ndarray, " step"]:
        """Time between rows [s]."""
        return np.diff(self.time)

    @cached_property
    def period(self) -> float:
        """Median time between joined rows [s]; 0 if there are none."""
        return float(np.median(self.waits[self.joined])) if self.joined.any() else 0.0

    @cached_property
    def moved(self) -> Float[np.ndarray, " step"]:
        """Distance between positions [m]."""
        return np.linalg.norm(np.diff(self.states[:, :2], axis=0), axis=1)

    @cached_property
    def integrated(self) -> Float[np.ndarray, " step"]:
        """Distance by the speed [m]."""
        speed = np.abs(self.states[:, 3])
        return 0.5 * (speed[1:] + speed[:-1]) * self.waits

    def gaps(self, gap: float, dt: float) -> Bool[np.ndarray, " step"]:
        """Return the steps that are too long to be bridged.

        `gap` is the longest that is, in periods: of the log or dt, whichever is longer.
        """
        return (self.waits > gap * max(self.period, dt)) & self.joined

    def parts(self, gap: float, dt: float) -> list[Int[np.ndarray, " time"]]:
        """Return the rows between gaps and cuts; `gaps` has the arguments."""
        edges = np.flatnonzero(self.gaps(gap, dt) | ~self.joined) + 1
        return np.split(np.arange(len(self.time)), edges)

    def channels(self, columns: Columns) -> dict[str, Float[np.ndarray, " time"]]:
        """Return every column by its name, less an unknown environment."""
        named = {columns.time: self.time}
        for names, values in (
            (columns.state, self.states),
            (columns.control, self.controls),
            (columns.environment, self.envs),
        ):
            if len(names) == values.shape[1]:
                named |= dict(zip(names, values.T, strict=True))
        return named

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


class Chords(NamedTuple):
    """Chords of a run over about `LOOK`, where it moves.

    Attributes:
        length: of the chord [m].
        integrated: ∫ v dt [m].
        course: direction of the chord, reversed where v < 0 [rad].
        yaw: in the middle of the chord [rad].
        turn: yaw rate along the chord [rad/s].
        middle: index of the row in the middle.
    """

    length: Float[np.ndarray, " chord"]
    integrated: Float[np.ndarray, " chord"]
    course: Float[np.ndarray, " chord"]
    yaw: Float[np.ndarray, " chord"]
    turn: Float[np.ndarray, " chord"]
    middle: Int[np.ndarray, " chord"]


def find_chords(log: Log, speed: Float[np.ndarray, " time"]) -> Chords:
    """Chords of a run that moved, by position or by a speed."""
    reach = min(max(1, round(LOOK / log.period)), len(log.time) - 1)
    along = np.cumsum(0.5 * (speed[1:] + speed[:-1]) * log.waits)
    along = np.concatenate([[0.0], along])
    chord = log.states[reach:, :2] - log.states[:-reach, :2]
    length = np.linalg.norm(chord, axis=1)
    integrated = along[reach:] - along[:-reach]
    lasted = log.time[reach:] - log.time[:-reach]
    # A chord across a gap or a cut says nothing about the speed.
    whole = lasted < 1.5 * reach * log.period
    whole &= log.stretch[reach:] == log.stretch[:-reach]
    # At standstill noise moves the position: the course would be random.
    moving = np.zeros_like(whole)
    for distance in (length, np.abs(integrated)):
        moving |= distance > 0.2 * np.max(distance, where=whole, initial=0.0)
    moving &= whole
    course = np.arctan2(chord[:, 1], chord[:, 0]) + np.pi * (integrated < 0)
    yaw = np.unwrap(log.states[:, 2])
    first = np.flatnonzero(moving)
    # An odd number of steps has no row in its middle.
    middle = first + reach // 2
    after = first + (reach + 1) // 2
    return Chords(
        length[moving],
        integrated[moving],
        course[moving],
        0.5 * (yaw[middle] + yaw[after]),
        (yaw[first + reach] - yaw[first]) / lasted[moving],
        middle,
    )


class Delay(NamedTuple):
    """How much later a motion comes than the rate that should be its derivative.

    Attributes:
        lag: at which they agree best [s]; negative if the motion comes first.
        alike: absolute correlation at that lag.
        gain: of the motion over the integrated rate.
        certain: whether a lag of zero agrees worse, beyond chance.
    """

    lag: float = 0.0
    alike: float = 0.0
    gain: float = 0.0
    certain: bool = False

    def line(self, late: str, early: str, dt: float) -> str:
        """Return what is said of it, in periods dt of the model."""
        return (
            f"the lag of {late} behind {early} is {self.lag:.2g} s "
            f"({self.lag / dt:.2g} steps of vehicle.dt); shift one of them in time"
        )


def find_delay(
    tables: Iterable[Float[np.ndarray, "_ column"]], *, held: bool = False
) -> Delay:
    """Find the delay of a motion behind a rate by correlation over chords of `LOOK`.

    Args:
        tables: time [s], motion (of two columns: a position) and rate (of a position: a
            speed) of uninterrupted stretches.
        held: whether the rate holds from its row on, as a command does.
    """
    lags = np.linspace(-LATEST, LATEST, LAGS)
    motion = [np.zeros(0)]
    summed = [np.zeros((LAGS, 0))]
    for time, *moved, rate in (table.T for table in tables):
        between = rate[:-1] if held else 0.5 * (rate[1:] + rate[:-1])
        along = np.append(0.0, np.cumsum(between * np.diff(time)))
        starts = np.arange(time[0] + LATEST, time[-1] - LATEST - LOOK, 0.5 * LOOK)
        ends = np.stack([starts, starts + LOOK])
        summed.append(
            np.diff(np.interp(ends[:, None] - lags[:, None], time, along), axis=0)[0]
        )
        chords = [np.diff(np.interp(ends, time, one), axis=0)[0] for one in moved]
        if chords[1:]:  # a distance has no sign of its own
            chords = [np.sign(summed[-1][LAGS // 2]) * np.hypot(*chords)]
        motion += chords
    seen = np.concatenate(motion)
    expected = np.concatenate(summed, axis=1)
    if (count := len(seen)) < FEWEST:
        return Delay()
    seen = seen - seen.mean()
    expected = expected - expected.mean(axis=1, keepdims=True)
    power = np.sum(expected**2, axis=1)
    if not (seen.any() and power.min() > 0.0):
        return Delay()
    gains = expected @ seen / power
    fit = gains**2 * power / np.sum(seen**2)
    best = int(fit.argmax())
    # The log of a likelihood ratio: every other chord overlaps its neighbours.
    ratio = (1.0 - fit[LAGS // 2] + 1e-9) / (1.0 - fit[best] + 1e-9)
    certain = bool(0.25 * count * np.log(ratio) > 10.0)
    return Delay(
        float(lags[best]), float(np.sqrt(fit[best])), float(gains[best]), certain
    )


def agreement(angles: Float[np.ndarray, " chord"]) -> complex:
    """Mean of exp(i φ): its length measures agreement, its angle is the mean angle."""
    return complex(np.mean(np.exp(1j * angles)))


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
        needs_environment: whether the environment must be in the files; otherwise
            nobody measured it, and it becomes zeros.
        blanks: whether empty cells are NaN; otherwise they are errors.

    Returns:
        All runs, in the order of the files; one line per file that could not be read;
        conversions of columns to SI units.
    """
    _check_columns(columns, needs_environment)
    logs = []
    errors = []
    conversions = []
    # A file that cannot be read is a finding beside those of the others.
    for file in files:
        try:
            table = _table(file, columns, dt, blanks)
            read, converted = _logs(table, columns, needs_environment)
        except (ArtefactError, ValueError) as reason:
            errors.append(one_line(reason))
            continue
        logs += read
        conversions += converted
    return logs, sorted(errors), list(dict.fromkeys(conversions))


def _check_columns(columns: Columns, needs_environment: bool) -> None:
    """Refuse names that no file could satisfy."""
    # A name twice would read one column as two channels.
    names = [columns.time, *columns.state, *columns.control, *columns.environment]
    if twice := [name for k, name in enumerate(names) if name in names[:k]]:
        raise ValueError(f"dataset.columns names {twice[0]} twice")
    if needs_environment and not columns.environment:
        raise ValueError(
            "dataset.columns.environment is empty: pass environment.source=none, "
            "or name the columns that were measured"
        )


def _table(file: Path, columns: Columns, dt: float, blanks: bool) -> Table:
    """The columns of a file."""
    suffix = file.suffix.lower()
    source = str(file)
    wanted = [columns.time, *columns.state, *columns.control, *columns.environment]
    wanted += [columns.run] if columns.run else []
    if suffix == ".csv":
        return read_csv(file, wanted, blanks=blanks)
    if suffix == ".parquet":
        return read_parquet(file, wanted)
    arrays = read_npz(file)
    if {"x", "u"} <= set(arrays) and columns.state[0] not in arrays:
        return _stacked(source, arrays, columns, dt)
    used = {name: arrays[name] for name in among(arrays, wanted)}
    # Without any, a later message lists what the file has.
    first, shape = next(
        ((name, array.shape) for name, array in used.items()), ("", (1,))
    )
    for name, array in used.items():
        if array.ndim != 1 or array.shape != shape:
            raise ValueError(
                f"{source}: {name} has shape {array.shape}, {first} {shape}: "
                "one number a moment"
            )
    if not shape[0]:
        raise ValueError(f"{source}: no rows")
    return Table(source, used, tuple(arrays), np.arange(shape[0]))


def _stacked(
    source: str, arrays: dict[str, np.ndarray], columns: Columns, dt: float
) -> Table:
    """Arrays x (run, time + 1, state), u and e (run, time, entry) below each other."""
    parts = {"x": columns.state, "u": columns.control, "e": columns.environment}
    if "e" not in arrays or not columns.environment:
        del parts["e"]
    held = {name: arrays[name] for name in parts}
    # One run alone may come without its first axis.
    held = {name: a[None] if a.ndim == 2 else a for name, a in held.items()}
    count, moments = (*held["x"].shape, 0, 0)[:2]
    time = np.asarray(arrays.get(columns.time, dt * np.arange(moments)))
    shapes: dict[str, tuple[int, ...]] = {
        name: (count, moments - (name != "x"), len(names))
        for name, names in parts.items()
    }
    shapes[columns.time] = (moments,) if time.ndim == 1 else (count, moments)
    for name, array in (held | {columns.time: time}).items():
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
        array = held[name]
        if name != "x":  # u and e of the last moment are unknown and never used
            array = np.concatenate([array, array[:, -1:]], axis=1)
        table |= dict(zip(names, array.reshape(-1, len(names)).T, strict=True))
    rows = np.tile(np.arange(moments), count)
    return Table(source, table, tuple(arrays), rows, run=RUN)


def _logs(
    table: Table, columns: Columns, needs_environment: bool
) -> tuple[list[Log], list[str]]:
    """The runs of a table in SI units, and the conversions."""
    source = table.source
    run = table.run or columns.run
    wanted = {
        "time": (columns.time,),
        "state": columns.state,
        "control": columns.control,
        "environment": columns.environment if needs_environment else (),
        "run": () if run is None else (run,),
    }
    needed: dict[str, str | None] = dict.fromkeys(chain(*wanted.values()))
    needed |= zip((columns.time, *columns.state), DIMENSIONS, strict=False)
    try:
        matches = {
            name: find_column(name, table.columns, needed[name]) for name in needed
        }
    except ValueError as reason:
        raise ValueError(f"{source}: {reason}") from None
    found = {name: match for name, match in matches.items() if match}
    for setting, names in wanted.items():
        if absent := [name for name in names if name not in found]:
            hint = f"map it with dataset.columns.{setting}"
            if setting == "environment":
                hint += ", or pass environment.source=none"
            present = ", ".join(table.headers[:12])
            raise ValueError(f"{source}: no column {absent[0]} among {present}; {hint}")

    def stacked(names: tuple[str, ...]) -> Float[np.ndarray, "time channel"]:
        used = [found[name] for name in names]
        return np.column_stack([table.numbers(one.header, one.factor) for one in used])

    states = stacked(columns.state)
    size = len(table.rows)
    log = Log(
        source=source,
        rows=table.rows,
        row_name=table.row_name,
        time=stacked(wanted["time"])[:, 0],
        states=states,
        controls=stacked(columns.control),
        # Zeros: a constant that no model reads.
        envs=stacked(wanted["environment"])
        if wanted["environment"]
        else np.zeros((size, UNKNOWN)),
        stretch=np.zeros(size, dtype=int),
    )
    conversions = [match.conversion for match in found.values() if match.conversion]
    if run is None:
        return [log], conversions
    labels = table.columns[found[run].header]
    if labels.dtype.kind == "f" and np.isnan(labels).any():
        row = int(np.isnan(labels).argmax())
        raise ValueError(f"{log.at(row)}: {run} is nan, so its run is unknown")
    # Rows of one run continue each other, whatever lies between them in the file.
    return [
        replace(
            log.select(labels == label),
            source=f"{source}, run {label}",
            stretch=np.zeros(int((labels == label).sum()), dtype=int),
        )
        for label in dict.fromkeys(labels.tolist())
    ], conversions
