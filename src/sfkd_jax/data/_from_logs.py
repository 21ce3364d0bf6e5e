"""Make a data set of recorded runs: read, check, resample, cut and assign them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.data._checks import Bounds, Checks, Finding
from sfkd_jax.data._dataset import PARTS, Dataset, check_shares
from sfkd_jax.data._logs import Columns, Log, read_logs
from sfkd_jax.ranges import Fraction, NonNegativeInt, Positive, Real
from sfkd_jax.types import BODY, Trajectory

UNBOUNDED = 1e6
"""Half width of E where nobody measured the environment and no model reads it."""
MOST_LINES = 20
"""Warnings that are reported in full; of more, only their number."""
ATTEMPTS = 200
"""Orders of the runs that are tried before runs are cut."""
TOLERANCE = 2.0
"""A part may be this many times larger or smaller than its share."""
SAME_MOMENT = 1e-5
"""Rows within this share of a period of a moment are taken without interpolation."""
BINS = 10
VISITED = 0.001
"""Share of all samples from which a bin counts as visited."""


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
        shares: of training, validation, calibration and test.
        seed: of the random order of runs.
        env_low: lower corner of E; None: as far as the logs reach.
        env_high: upper corner of E.

    Raises:
        ValueError: the first reason why the logs are refused; the others are reported.
    """
    # All files are read and checked before any is refused: one run shows all faults.
    recorded, errors, conversions = read_logs(
        path, columns, dt=dt, needs_environment=needs_environment
    )
    if conversions:
        report(f"converted to SI units: {', '.join(conversions)}")
    box = (env_low, env_high) if needs_environment else (None, None)
    checks = Checks(
        columns, dt, steps, wheelbase, gap, min_speed, split_at_jumps, limits, box
    )
    logs, findings = checks.apply(recorded)
    _report_findings([*map(Finding, errors), *findings], report)
    cut, runs = _segments([list(_pieces(log, dt, gap)) for log in logs], steps)
    parts, whole = assign_parts(runs, shares=shares, seed=seed)
    waits = np.concatenate([log.waits[log.joined] for log in logs])
    seconds = float(waits.sum())
    sizes = [f"{int((parts == k).sum())} {name}" for k, name in enumerate(PARTS)]
    used = 100 * len(runs) * steps * dt / seconds
    report(
        f"{len(logs)} runs, {seconds:.0f} s at {1 / np.median(waits):.4g} Hz; "
        f"sampled every {dt:g} s (states linearly, yaw unwrapped; controls and "
        f"environment held); {len(runs)} segments of {steps} steps, "
        f"{used:.0f} % of the time: {', '.join(sizes)}"
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

    States are interpolated linearly, yaw after unwrapping; controls and environments
    are held from the row before (zero order).
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
        # Controls of the row before: a later one was not yet known to the robot.
        held = rows[np.searchsorted(time, moments, side="right")[:-1] - 1]
        sampled = [np.interp(moments, time, channel) for channel in states.T]
        yield Piece(np.column_stack(sampled), log.controls[held], log.envs[held])


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


def assign_parts(
    runs: Int[np.ndarray, " segment"], *, shares: tuple[float, ...], seed: int
) -> tuple[Int[np.ndarray, " segment"], bool]:
    """Assign whole runs at random if the parts come near their shares.

    Otherwise cut each run into four stretches of time. Parts made of whole runs share
    no run. Parts made of stretches are neighbours in time, and what is measured on them
    holds for more of the same runs, not for new ones.

    Args:
        runs: number of the run of every segment.
        shares: of the parts.
        seed: of the random order of runs.

    Returns:
        The part of every segment, in the order of `PARTS`, and whether every run is in
        one part only.

    Raises:
        ValueError: shares that are not four positive numbers of sum 1, or too few
            segments for them.
    """
    check_shares(shares)
    numbers, sizes = np.unique(runs, return_counts=True)
    random = np.random.default_rng(seed)
    # Fewer runs than parts: one part would be empty in every order.
    for _ in range(ATTEMPTS if len(numbers) >= len(shares) else 0):
        lacking, owner = np.multiply(shares, len(runs)), np.empty(len(sizes), dtype=int)
        # Each run in turn goes to the part that lacks most of its share.
        for run in random.permutation(len(numbers)):
            owner[run] = lacking.argmax()
            lacking[owner[run]] -= sizes[run]
        reached = np.bincount(owner, weights=sizes, minlength=len(shares))
        relative = reached / len(runs) / np.asarray(shares)
        if relative.min() >= 1 / TOLERANCE and relative.max() <= TOLERANCE:
            return owner[np.searchsorted(numbers, runs)], True
    # In time within each run: training first, so that the test is the latest.
    order = np.concatenate([(np.arange(size) + 0.5) / size for size in sizes])
    parts = np.empty(len(runs), dtype=int)
    parts[np.argsort(runs, kind="stable")] = np.searchsorted(
        np.cumsum(shares)[:-1], order
    )
    if len(np.unique(parts)) < len(shares):
        raise ValueError(
            f"{len(runs)} segments are too few for "
            f"dataset.shares={list(shares)}; record more"
        )
    return parts, False


def coverage(
    values: Mapping[str, Float[np.ndarray, " sample"]],
) -> dict[str, dict[str, float]]:
    """Return range, middle 99.8 % and the share of visited bins of every channel.

    A bin is a tenth of the range; it is visited if it holds 0.1 % of the samples.

    Returns:
        name -> {"low", "high", "low_998", "high_998", "bins_visited"}; a constant
        channel visits no bin.
    """
    covered = {}
    for name, samples in values.items():
        low, high = float(samples.min()), float(samples.max())
        middle = np.quantile(samples, [0.001, 0.999]).tolist()
        counts = np.zeros(BINS)
        if high > low:
            counts = np.histogram(samples, BINS, (low, high))[0]
        covered[name] = {
            "low": low,
            "high": high,
            "low_998": middle[0],
            "high_998": middle[1],
            "bins_visited": float(np.mean(counts >= max(1, VISITED * len(samples)))),
        }
    return covered


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
