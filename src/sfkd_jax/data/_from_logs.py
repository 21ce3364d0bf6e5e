"""Make a data set of recorded runs: read, check, resample, cut and assign them."""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped
from numpy.lib.stride_tricks import sliding_window_view

from sfkd_jax.data._checks import Bounds, Checks, Finding
from sfkd_jax.data._dataset import PARTS, Dataset, assign_parts, coverage
from sfkd_jax.data._logs import Columns, Log, read_logs
from sfkd_jax.ranges import Fraction, NonNegativeInt, Positive, Real, check_choice
from sfkd_jax.store import open_regular
from sfkd_jax.types import BODY, Trajectory

SUFFIXES = (".csv", ".npz", ".parquet")
UNBOUNDED = 1e6
"""Half width of E where nobody measured the environment and no model reads it."""
MOST_LINES = 20
"""Warnings that are reported in full; of more, only their number."""
ALIKE = 1e-3
"""Of a channel's standard deviation: to this step numbers are rounded and compared."""
IN_A_ROW = 10
"""Steps that are compared at once: single ones are alike by chance."""
SAME_MOMENT = 1e-5
"""Rows within this share of a period of a moment are taken without interpolation."""


class LoggedDataset(NamedTuple):
    """A data set of recorded runs.

    Attributes:
        dataset: its four parts.
        coverage: {"state", "control", "environment"} -> channel -> `coverage`.
    """

    dataset: Dataset
    coverage: dict[str, dict[str, dict[str, float]]]


class Piece(NamedTuple):
    """Evenly sampled steps without a gap, or a stack of as long ones.

    Attributes:
        states: at every moment.
        controls: at every moment but the last.
        envs: at every moment but the last.
    """

    states: Float[np.ndarray, "*segment steps_plus_1 state"]
    controls: Float[np.ndarray, "*segment steps control"]
    envs: Float[np.ndarray, "*segment steps environment"]


def from_logs(
    path: str,
    columns: Columns,
    *,
    dt: float,
    wheelbase: float,
    limits: Bounds = (None, None),
    needs_environment: bool = True,
    report: Callable[[str], None] = print,
    steps: int = 50,
    gap: Positive = 2.5,
    min_speed: float = 0.0,
    split_at_jumps: bool = False,
    missing: str = "refuse",
    shares: tuple[Fraction, Fraction, Fraction, Fraction] = (0.6, 0.1, 0.2, 0.1),
    seed: NonNegativeInt = 0,
    env_low: tuple[Real, ...] | None = None,
    env_high: tuple[Real, ...] | None = None,
) -> LoggedDataset:
    """Make a data set of recorded runs, or refuse them with the reason.

    Args:
        path: a file, a folder or a glob of .csv, .npz and .parquet.
        columns: their names.
        dt: of the model [s].
        wheelbase: that steering is compared with [m].
        limits: of the controls, low and high.
        needs_environment: whether the environment must be in the logs; otherwise it is
            unknown, whatever they hold.
        report: receives every line for the user.
        steps: of a segment.
        gap: the longest wait between rows that is bridged, in periods.
        min_speed: slower rows are dropped, and the run is cut there [m/s].
        split_at_jumps: whether a run is cut where time, position or yaw jump; otherwise
            it is refused.
        missing: "refuse" or "drop" rows in which a number is missing; the run is cut
            where they are dropped.
        shares: of training, validation, calibration and test.
        seed: of the random order of runs.
        env_low: lower corner of E; None: as far as the logs reach.
        env_high: upper corner of E.

    Raises:
        ValueError: the first reason why the logs are refused; the others are reported.
    """
    check_choice("dataset.missing", missing, ("refuse", "drop"))
    drop = missing == "drop"
    # All files are read and checked before any is refused: one run shows all faults.
    recorded, errors, conversions = read_logs(
        log_files(path).values(),
        columns,
        dt=dt,
        needs_environment=needs_environment,
        blanks=drop,
    )
    if conversions:
        report(f"converted to SI units: {', '.join(conversions)}")
    box = (env_low, env_high) if needs_environment else (None, None)
    cuts = (gap, min_speed, split_at_jumps, drop)
    checks = Checks(columns, dt, steps, wheelbase, *cuts, limits, box)
    logs, findings = checks.apply(recorded)
    findings += _repeats(logs, steps * dt)
    _report_findings([*map(Finding, errors), *findings], report)
    cut, runs = _segments([list(_pieces(log, dt, gap)) for log in logs], steps)
    parts, whole = assign_parts(runs, shares=shares, seed=seed)
    waits = np.concatenate([log.waits[log.joined] for log in logs])
    seconds = float(waits.sum())
    sizes = [f"{int((parts == k).sum())} {name}" for k, name in enumerate(PARTS)]
    used = 100 * len(runs) * steps * dt / seconds
    report(
        f"{len(logs)} runs, {seconds:.0f} s at {1 / np.median(waits):.4g} Hz; "
        f"sampled every {dt:g} s (states linearly, yaw unwrapped; controls "
        f"averaged over each step, environment held); {len(runs)} segments "
        f"of {steps} steps, {used:.0f} % of the time: {', '.join(sizes)}"
    )
    if not whole:
        report(
            "warning: too few runs to assign them whole; each was cut in time, and "
            "coverage is that of the same runs only"
        )
    # From what is used: rows that were dropped do not widen E.
    low, high = environment_box(cut.envs, *box, known=needs_environment)
    dataset = Dataset(
        *(
            Trajectory(*(jnp.asarray(a[parts == k], dtype=jnp.float32) for a in cut))
            for k in range(len(PARTS))
        ),
        env_low=low,
        env_high=high,
        runs={name: len(np.unique(runs[parts == k])) for k, name in enumerate(PARTS)},
    )
    groups = {
        "state": (columns.state[BODY], cut.states[..., BODY]),
        "control": (columns.control, cut.controls),
        "environment": (columns.environment if needs_environment else (), cut.envs),
    }
    covered = {
        group: coverage(
            dict(zip(names, values.reshape(-1, values.shape[-1]).T, strict=False))
        )
        for group, (names, values) in groups.items()
    }
    for line in _coverage_lines(covered):
        report(line)
    return LoggedDataset(dataset, covered)


def _repeats(logs: list[Log], shortest: float) -> Iterator[Finding]:
    """Stretches that two runs have in common, from a length in seconds on.

    Their numbers are compared: a copy may have another format, clock and origin.
    """
    if not logs:
        return
    spread = np.std(np.concatenate([log.steps for log in logs]), axis=0)
    scale = ALIKE * np.where(spread > 0.0, spread, 1.0)
    found = [_marks(log, scale) for log in logs]
    marks, rows = (np.concatenate(part) for part in zip(*found, strict=True))
    owners = np.repeat(np.arange(len(logs)), [len(one) for one, _ in found])
    _, first, group = np.unique(marks, return_index=True, return_inverse=True)
    origins = first[group]
    pairs = np.column_stack([owners[origins], owners])
    for one, other in np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0):
        copies = np.flatnonzero((pairs == (one, other)).all(axis=1))
        if (len(copies) + IN_A_ROW) * logs[other].period < shortest:
            continue
        here, there = (
            log.between(int(places.min()), int(places.max()) + IN_A_ROW)
            for log, places in (
                (logs[other], rows[copies]),
                (logs[one], rows[origins[copies]]),
            )
        )
        yield Finding(
            f"{here}: the same numbers as {there}; remove one of them, "
            "or test runs are trained on"
        )


def _marks(
    log: Log, scale: Float[np.ndarray, " channel"]
) -> tuple[Shaped[np.ndarray, " mark"], Int[np.ndarray, " mark"]]:
    """A hash of every few steps that vary, and the row at which they begin."""
    words = np.rint(log.steps / scale).astype(np.int64).view(np.uint64)
    if len(words) < IN_A_ROW:
        return np.zeros(0, np.uint64), np.zeros(0, int)
    random = np.random.default_rng(0)
    weights = random.integers(1, 1 << 63, (len(scale), IN_A_ROW), dtype=np.uint64)
    # Where nothing changes, as at standstill, all runs are alike.
    varied = np.append(False, np.any(words[1:] != words[:-1], axis=1))
    kept = sliding_window_view(varied, IN_A_ROW).sum(axis=-1) >= IN_A_ROW // 2
    kept &= sliding_window_view(log.joined, IN_A_ROW).all(axis=-1)
    several = sliding_window_view(words, IN_A_ROW, axis=0)
    return np.einsum("kcs,cs->k", several, weights)[kept], np.flatnonzero(kept)


def _report_findings(findings: list[Finding], report: Callable[[str], None]) -> None:
    """Report all findings; the first of those that refuse the logs is the error."""
    warnings = [f"warning: {one.line}" for one in findings if not one.refused]
    refused = [one.line for one in findings if one.refused]
    for lines in (warnings, refused[1:]):
        for line in lines[:MOST_LINES]:
            report(line)
        if len(lines) > MOST_LINES:
            report(f"and {len(lines) - MOST_LINES} lines more like these")
    if refused:
        more = f" (the first of {len(refused)} findings)" if refused[1:] else ""
        raise ValueError(f"{refused[0]}{more}")


def log_files(path: str) -> dict[str, Path]:
    """Return the logs of a file, a folder or a glob by the hash of their contents.

    They are in the order of the hashes: a data set does not depend on names of files.

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
        absent = f"no {known} in this folder; dataset.path takes globs such as "
        absent += "logs/**/*.csv"
        files = [file for file in here.iterdir() if file.suffix.lower() in SUFFIXES]
        files = [file for file in files if not file.name.startswith(".")]
    else:
        absent = "no such file or folder, and no file matches it"
        # A file whose name holds brackets is meant itself, not what it would match.
        named = [here] if here.is_file() else glob.glob(str(here), recursive=True)
        files = [file for file in map(Path, named) if file.is_file()]
    if not files:
        raise ValueError(f"{path}: {absent}")
    found: dict[str, Path] = {}
    for file in sorted(files):
        if file.suffix.lower() not in SUFFIXES:
            raise ValueError(f"{file}: unknown kind of log; choose one of {known}")
        status = file.stat()
        digest = _digest(file.resolve(), status.st_size, status.st_mtime_ns)
        if (same := found.setdefault(digest, file)) != file:
            raise ValueError(
                f"{file}: the same contents as {same}; remove one of them, "
                "or test runs are trained on"
            )
    return dict(sorted(found.items()))


def fingerprint(path: str) -> str:
    """Return a hash of the contents of all logs of a path, whatever their names.

    Raises:
        ValueError: as for `log_files`.
    """
    return hashlib.sha256("".join(log_files(path)).encode()).hexdigest()


@cache
def _digest(file: Path, size: int, written: int) -> str:
    """The hash of a file's contents, cached until it is written again."""
    del size, written  # part of the key of the cache
    with open_regular(file) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()  # pyright: ignore


def environment_box(
    envs: Float[Array, "*batch environment"] | Float[np.ndarray, "*batch environment"],
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
    *,
    known: bool,
) -> tuple[Float[Array, " environment"], Float[Array, " environment"]]:
    """Return the corners of E: as given, or as far as the environments reach.

    Args:
        envs: of all segments.
        low: lower corner, or None.
        high: upper corner, or None.
        known: whether somebody measured them; E is wide otherwise.
    """
    values = np.asarray(envs).reshape(-1, np.shape(envs)[-1])
    corners: Iterable[Any] = (low, high)
    if low is None or high is None:
        wide = np.full(values.shape[1], UNBOUNDED)
        # Not by the values: a slope that is 0 throughout was measured to be 0.
        corners = (values.min(axis=0), values.max(axis=0)) if known else (-wide, wide)
    lower, upper = (jnp.asarray(corner, dtype=jnp.float32) for corner in corners)
    return lower, upper


def _pieces(log: Log, dt: float, gap: float) -> Iterator[Piece]:
    """Split a run at its gaps and cuts, and sample each piece at 0, dt, 2 dt, ….

    States are interpolated linearly, yaw after unwrapping; environments are held from
    the row before (zero order), controls averaged over the step as they were held.
    """
    edges = np.flatnonzero(log.gaps(gap, dt) | ~log.joined) + 1
    for rows in np.split(np.arange(len(log.time)), edges):
        time, states = log.time[rows] - log.time[rows[0]], log.states[rows]
        moments = dt * np.arange(int(time[-1] / dt + SAME_MOMENT) + 1)
        nearest = time[np.searchsorted(0.5 * (time[1:] + time[:-1]), moments)]
        # Rows at these moments are kept exactly.
        same = np.abs(nearest - moments) < SAME_MOMENT * dt
        moments = np.where(same, nearest, moments)
        # Interpolated through a wrap, yaw would turn by 2π between two rows.
        states[:, 2] = np.unwrap(states[:, 2])
        sampled = [np.interp(moments, time, channel) for channel in states.T]
        # Of the row before: a later one was not yet known to the robot.
        held = np.searchsorted(time, moments[:-1], side="right") - 1
        last = np.searchsorted(time, moments[1:], side="left") - 1
        # Rows jitter around the moments, and the robot follows a command from its row.
        commands = log.controls[rows]
        given = np.cumsum(np.diff(time)[:, None] * commands[:-1], axis=0)
        given = np.concatenate([np.zeros((1, commands.shape[1])), given])
        given = np.column_stack([np.interp(moments, time, total) for total in given.T])
        mean = np.diff(given, axis=0) / np.diff(moments)[:, None]
        # One that did not change is kept to the last bit.
        controls = np.where((held == last)[:, None], commands[held], mean)
        yield Piece(np.column_stack(sampled), controls, log.envs[rows[held]])


def _segments(
    pieces: list[list[Piece]], steps: int
) -> tuple[Piece, Int[np.ndarray, " segment"]]:
    """Cut the pieces of every run end to end; the rest of a piece is dropped.

    Positions are relative to the first of a segment, and its yaw begins in (−π, π]:
    float32 cannot resolve positions on Earth.

    Returns:
        The segments in the order of time, and the number of the run of each.

    Raises:
        ValueError: no piece is as long as a segment.
    """
    cut: list[Piece] = []
    runs: list[int] = []
    for run, piece in ((k, piece) for k, parts in enumerate(pieces) for piece in parts):
        for start in range(0, len(piece.controls) - steps + 1, steps):
            stop = start + steps
            states = piece.states[start : stop + 1].copy()
            states[:, :2] -= states[0, :2]
            turns = np.ceil((states[0, 2] - np.pi) / (2.0 * np.pi))
            states[:, 2] -= 2.0 * np.pi * turns
            cut.append(
                Piece(states, piece.controls[start:stop], piece.envs[start:stop])
            )
            runs.append(run)
    if not cut:
        lengths = (len(piece.controls) for parts in pieces for piece in parts)
        raise ValueError(
            f"the longest run without a gap has {max(lengths, default=0)} steps, "
            f"a segment {steps}; pass dataset.steps"
        )
    return Piece(*map(np.stack, zip(*cut, strict=True))), np.array(runs)


def _coverage_lines(
    groups: Mapping[str, Mapping[str, Mapping[str, float]]],
) -> Iterator[str]:
    """The lines of a table of coverage, one per channel."""
    yield (
        f"{'coverage':28}{'lowest':>11}{'highest':>11}{'middle 99.8 %':>24}"
        f"{'tenths visited':>16}"
    )
    for group, rows in groups.items():
        for name, row in rows.items():
            middle = f"{row['low_998']:.4g} … {row['high_998']:.4g}"
            ends = f"{row['low']:11.4g}{row['high']:11.4g}"
            visited = f"{round(10 * row['bins_visited']):>13}/10"
            yield f"{f'{group}: {name}':28}{ends}{middle:>24}{visited}"
