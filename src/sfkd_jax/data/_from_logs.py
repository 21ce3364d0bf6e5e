"""Make a data set of recorded runs: read, check, resample, cut and assign them."""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Shaped
from numpy.lib.stride_tricks import sliding_window_view

from sfkd_jax.data._checks import Bounds, Checks, Finding, more, warning
from sfkd_jax.data._dataset import (
    PARTS,
    Dataset,
    assign_parts,
    coverage,
    environment_box,
    pieces,
    segments,
)
from sfkd_jax.data._logs import Columns, Delay, Log, find_chords, find_delay, read_logs
from sfkd_jax.ranges import Fraction, NonNegativeInt, Positive, Real, check_choice
from sfkd_jax.types import BODY, Trajectory

SUFFIXES = (".csv", ".npz", ".parquet")
MOST_LINES = 20
"""Warnings that are reported in full; of more, only their number."""
ROUNDED = 1e-5
"""How far outside its range a channel may be: float32 rounds."""
STRAIGHT = 1.0
"""Yaw rate below which a log teaches too little [degrees/s]."""
ALIKE = 1e-3
"""Of a channel's standard deviation: to this step numbers are rounded and compared."""
IN_A_ROW = 10
"""Steps that are compared at once: single ones are alike by chance."""


class LoggedDataset(NamedTuple):
    """A data set of recorded runs."""

    dataset: Dataset
    coverage: dict[str, dict[str, dict[str, float]]]
    """{"state", "control", "environment"} -> channel -> `coverage`."""


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
    # All files are read and checked before any is refused: one run shows all faults.
    recorded, errors, conversions = read_logs(
        [file for _, file in log_files(path)],
        columns,
        dt=dt,
        needs_environment=needs_environment,
        blanks=missing == "drop",
    )
    if conversions:
        report(f"converted to SI units: {', '.join(conversions)}")
    box = (env_low, env_high) if needs_environment else (None, None)
    cuts = (gap, min_speed, split_at_jumps, missing == "drop")
    checks = Checks(columns, dt, steps, wheelbase, *cuts, limits, box)
    logs, findings = checks.apply(recorded)
    if logs:
        for check in (_steering, _ranges, _commands, _repeats):
            findings += check(checks, logs)
    _report_findings([*map(Finding, errors), *findings], report)
    cut, runs = segments([list(pieces(log, dt, gap)) for log in logs], steps)
    parts, whole = assign_parts(runs, shares=shares, seed=seed)
    waits = np.concatenate([log.waits[log.joined] for log in logs])
    seconds = float(waits.sum())
    sizes = (f"{int((parts == k).sum())} {name}" for k, name in enumerate(PARTS))
    report(
        f"{len(logs)} runs, {seconds:.0f} s at {1 / np.median(waits):.4g} Hz, "
        f"sampled every {dt:g} s (states linearly, yaw unwrapped; controls "
        f"averaged over each step, environment held); {len(runs)} segments "
        f"of {steps} steps, {len(runs) * steps * dt / seconds:.0%}: {', '.join(sizes)}"
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
    for group, rows in covered.items():
        for name, row in rows.items():
            report(f"coverage of {group} {name}: {_told(row)}")
    return LoggedDataset(dataset, covered)


def _told(row: dict[str, float]) -> str:
    """The coverage of a channel, for a person."""
    middle = f"middle 99.8 % {row['low_998']:.4g} … {row['high_998']:.4g}"
    visited = f"{round(10 * row['bins_visited'])} of 10 tenths visited"
    return f"{row['low']:.4g} … {row['high']:.4g}, {middle}, {visited}"


def _repeats(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Stretches as long as a segment that two runs have in common.

    Their numbers are compared: a copy may have another format, clock and origin.
    """
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
        if (len(copies) + IN_A_ROW) * logs[other].period < checks.steps * checks.dt:
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


def _steering(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Yaw rates against a bicycle's, ω = v tan δ / L: sign, unit and L."""
    expected, turned = (
        np.concatenate(parts) for parts in zip(*map(_turns, logs), strict=True)
    )
    power = float(np.sqrt(np.mean(expected**2) * np.mean(turned**2)))
    alike = float(np.mean(expected * turned)) / power if power else 0.0
    # Not a steering angle, or too little steering to tell.
    if abs(alike) < 0.6:
        return
    fits = float(np.mean(expected**2) / np.mean(expected * turned))
    name = checks.columns.control[0]
    where = _span(logs)
    if alike < 0:
        yield warning(
            f"{where}: the robot turns against {name}; "
            "a positive one should turn it left"
        )
    elif not 0.6 < fits / checks.wheelbase < 1.7:
        unit = f" or {name} is not in rad" if fits > 10 * checks.wheelbase else ""
        yield warning(
            f"{where}: {name} and yaw suggest a wheelbase of {fits:.3g} m, "
            f"vehicle.wheelbase is {checks.wheelbase:g}{unit}"
        )


def _ranges(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Controls that hardly vary or leave their limits; environments outside E."""
    where = _span(logs)
    columns = checks.columns
    for k, name in enumerate(columns.control):
        values = np.concatenate([log.controls[:, k] for log in logs])
        kinds = len(np.unique(values))
        if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
            yield Finding(
                f"{where}: {name} is always {values[0]:.4g}; "
                "without excitation nothing can be learned of it"
            )
        elif kinds < 5:
            yield warning(f"{where}: {name} takes only {kinds} values; vary it more")
    low, high = checks.limits
    if low and high:
        found = _outside(logs, "controls", columns.control, low, high)
        limits = "of vehicle.control_low and vehicle.control_high"
        yield from (warning(f"{line} {limits}") for line in found)
    low, high = checks.box
    if low is None and high is None:
        return
    size = logs[0].envs.shape[1]
    low = low or ()
    high = high or ()
    if {len(low), len(high)} != {size} or np.any(np.greater(low, high)):
        yield Finding(
            f"environment.low and environment.high must be {size} numbers each, "
            "the low ones not above the high"
        )
        return
    names = columns.environment
    names = names if len(names) == size else ("environment",) * size
    found = _outside(logs, "envs", names, low, high)
    box = "of environment.low and environment.high"
    yield from (Finding(f"{line} {box}") for line in found)


def _outside(
    logs: list[Log],
    field: str,
    names: tuple[str, ...],
    low: tuple[float, ...],
    high: tuple[float, ...],
) -> Iterator[str]:
    """A line about the first row of every channel that is outside its range."""
    for k, (name, least, most) in enumerate(zip(names, low, high, strict=True)):
        slack = ROUNDED * max(1.0, abs(least), abs(most))
        for log in logs:
            channel = getattr(log, field)[:, k]
            outside = (channel < least - slack) | (channel > most + slack)
            if outside.any():
                first = int(outside.argmax())
                yield (
                    f"{log.at(first)}: {name} is {channel[first]:.4g}{more(outside)}, "
                    f"outside the range from {least:g} to {most:g}"
                )
                break


def _span(logs: list[Log]) -> str:
    """The position of several runs, for messages."""
    more = f" and {len(logs) - 1} runs more" if logs[1:] else ""
    return logs[0].whole + more


def _commands(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Motion against commands: columns that changed places, delays, no excitation."""
    yaw, speed, controls = *checks.columns.state[2:4], checks.columns.control

    def answer(chosen: list[Log], state: int, control: int) -> Delay:
        """The delay of yaw or speed behind a command; a turn is faster at speed."""
        tables = []
        for log in chosen:
            rate = log.controls[:, control] * log.states[:, 3] ** (state == 2)
            motion = np.unwrap(log.states[:, state]) if state == 2 else log.states[:, 3]
            table = np.column_stack([log.time, motion, rate])
            tables += [table[rows] for rows in log.parts(checks.gap, checks.dt)]
        return find_delay(tables, held=True)

    for log in logs:
        turns, pushes = ([answer([log], k, n).alike for n in (0, 1)] for k in (2, 3))
        swapped = turns[1] > 0.8 or (pushes[0] > 0.8 and pushes[1] < 0.4)
        if turns[0] < 0.4 and swapped:
            yield Finding(
                f"{log.whole}: {yaw} follows {controls[1]} (correlation "
                f"{turns[1]:.2f}), not {controls[0]} ({turns[0]:.2f}); "
                "have columns changed places?"
            )
    for state, name, control in ((2, yaw, 0), (3, speed, 1)):
        found = answer(logs, state, control)
        steps = found.lag / checks.dt
        # Half a step early: a command that was measured, or interpolated.
        if found.certain and found.alike > 0.8 and (steps < -1.0 or steps > 0.25):
            yield warning(
                f"{_span(logs)}: {found.line(name, controls[control], checks.dt)}, "
                "unless a state shows the delay"
            )
    turn = np.concatenate([find_chords(log, log.states[:, 3]).turn for log in logs])
    if turn.size and (rate := np.rad2deg(np.sqrt(np.mean(turn**2)))) < STRAIGHT:
        yield warning(
            f"{_span(logs)}: {yaw} turns by {rate:.2g} degrees a second (root mean "
            "square); record curves, or the model learns none"
        )


def _turns(log: Log) -> tuple[Float[np.ndarray, " step"], Float[np.ndarray, " step"]]:
    """v tan δ and the yaw rate of every step; large controls are taken as tan δ."""
    steering = log.controls[:-1, 0]
    # More than 80° is no angle of a wheel, but may be a turn command.
    angle = np.tan(steering) if np.abs(log.controls[:, 0]).max() < 1.4 else steering
    turned = np.diff(np.unwrap(log.states[:, 2]))[log.joined] / log.waits[log.joined]
    return (log.states[:-1, 3] * angle)[log.joined], turned


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


def log_files(path: str) -> list[tuple[str, Path]]:
    """Return the logs of a file, a folder or a glob, after the hash of their contents.

    They are in the order of the hashes: a data set does not depend on names of files.
    """
    if path in ("", "???"):
        raise ValueError(
            "dataset.path is not set: pass dataset.path=FILE, dataset.path=FOLDER or "
            "'dataset.path=GLOB'"
        )
    here = Path(path).expanduser()
    known = ", ".join(SUFFIXES)
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
    found: list[tuple[str, Path]] = []
    for file in sorted(files):
        if file.suffix.lower() not in SUFFIXES:
            raise ValueError(f"{file}: unknown kind of log; choose one of {known}")
        status = file.stat()
        digest = _digest(file.resolve(), status.st_size, status.st_mtime_ns)
        found.append((digest, file))
    return sorted(found)


def fingerprint(path: str) -> str:
    """Return a hash of the contents of all logs of a path, whatever their names."""
    digests = (digest for digest, _ in log_files(path))
    return hashlib.sha256("".join(digests).encode()).hexdigest()


@cache
def _digest(file: Path, size: int, written: int) -> str:
    """The hash of a file's contents, cached until it is written again."""
    del size, written  # part of the key of the cache
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()  # pyright: ignore
