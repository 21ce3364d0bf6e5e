"""Make a data set of recorded drives: read, check, resample, cut and assign them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.data._checks import (
    Finding,
    check_finite,
    check_motion,
    check_time,
    cut_at_jumps,
    drop_slow_rows,
)
from sfkd_jax.data._logs import Columns, Log, read_logs
from sfkd_jax.data._plausible import (
    Bounds,
    check_ranges,
    check_steering,
    check_units,
)
from sfkd_jax.data._resampling import (
    Assignment,
    Segments,
    assign_parts,
    pieces,
    segments,
)
from sfkd_jax.data._splits import PARTS, Dataset, coverage, coverage_lines
from sfkd_jax.ranges import Fraction, NonNegativeInt, Positive, Real
from sfkd_jax.types import BODY, Trajectory

SHORTEST = 3
"""Rows that a drive needs to be checked at all."""
UNBOUNDED = 1e6
"""Half width of E where nobody measured the environment and no model reads it."""
MOST_LINES = 20
"""Warnings that are reported in full; of more, only their number."""


class LoggedDataset(NamedTuple):
    """A data set of recorded drives.

    Attributes:
        dataset: its four parts.
        coverage: {"state", "control", "environment"} -> channel -> `coverage`.
    """

    dataset: Dataset
    coverage: dict[str, dict[str, dict[str, float]]]


@dataclass(frozen=True)
class _Options:
    """How each drive is checked and cut, as in `from_logs`."""

    dt: float
    steps: int
    gap: float
    min_speed: float
    split_at_jumps: bool


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
    """Make a data set of recorded drives, or refuse them with the reason.

    Args:
        path: a file, a folder or a glob of .csv, .npz and .parquet.
        columns: their names.
        dt: of the model [s].
        wheelbase: that steering is compared with [m].
        limits: of the controls, low and high.
        needs_environment: whether the environment must be in the logs.
        report: receives every line for the user.
        steps: of a segment.
        gap: the longest wait between rows that is bridged, in periods.
        min_speed: slower rows are dropped, and the drive is cut there [m/s].
        split_at_jumps: whether a drive is cut where time, position or yaw jump;
            otherwise it is refused.
        shares: of training, validation, calibration and test.
        seed: of the random order of drives.
        env_low: lower corner of E; None: as far as the logs reach.
        env_high: upper corner of E.

    Raises:
        ValueError: the first reason why the logs are refused; the others are reported.
    """
    files = read_logs(path, columns, dt=dt, needs_environment=needs_environment)
    if files.conversions:
        report(f"converted to SI units: {', '.join(files.conversions)}")
    findings = [Finding(line) for line in files.errors]
    options = _Options(dt, steps, gap, min_speed, split_at_jumps)
    sound: list[Log] = []
    for recorded in files.logs:
        log, noticed = _check(recorded, columns, options)
        findings += noticed
        refused = any(finding.refused for finding in noticed)
        if not refused and len(log.time) >= SHORTEST and log.joined.any():
            sound.append(log)
    if sound:
        findings += check_steering(sound, columns, wheelbase=wheelbase)
        findings += check_ranges(sound, columns, limits=limits, box=(env_low, env_high))
    _report_findings(findings, report)
    cut = segments([pieces(log, dt=dt, gap=gap) for log in sound], steps=steps)
    assignment = assign_parts(cut.drives, shares=shares, seed=seed)
    report(_summary(sound, cut, assignment, dt))
    if not assignment.whole:
        report(
            "warning: too few drives to assign them whole; each was cut in time, and "
            "coverage is that of the same drives only"
        )
    dataset = _dataset(cut, assignment.parts, (env_low, env_high))
    covered = _coverage(cut, columns)
    for line in coverage_lines(covered):
        report(line)
    return LoggedDataset(dataset, covered)


def _check(log: Log, columns: Columns, options: _Options) -> tuple[Log, list[Finding]]:
    """A drive after cutting, and all findings about it alone."""
    dt, gap = options.dt, options.gap
    log, findings = drop_slow_rows(log, columns, min_speed=options.min_speed)
    wrong = list(check_finite(log, columns))
    if options.split_at_jumps and not wrong:
        log, cuts = cut_at_jumps(log, columns, dt=dt, gap=gap)
        findings += cuts
    wrong += check_time(log, columns)
    findings += wrong
    if wrong or not len(log.time):
        return log, findings
    if (length := _longest(log)) < (options.steps - 1e-3) * dt:
        findings.append(
            Finding(
                f"{log.whole}: only {length:.4g} s, a segment is "
                f"{options.steps * dt:.4g} s; not used",
                refused=False,
            )
        )
    if len(log.time) < SHORTEST or not log.joined.any():
        return log, findings
    units = list(check_units(log, columns))
    findings += units
    if not any(finding.refused for finding in units):
        findings += check_motion(log, columns, dt=dt, gap=gap)
    return log, findings


def _longest(log: Log) -> float:
    """Duration of the longest stretch between cuts [s]."""
    edges = np.flatnonzero(~log.joined) + 1
    parts = np.split(log.time, edges)
    return max(float(part[-1] - part[0]) for part in parts)


def _report_findings(findings: list[Finding], report: Callable[[str], None]) -> None:
    """Report all findings; the first of those that refuse the logs is the error."""
    warnings = [
        f"warning: {finding.line}" for finding in findings if not finding.refused
    ]
    refused = [finding.line for finding in findings if finding.refused]
    for lines in (warnings, refused[1:]):
        for line in lines[:MOST_LINES]:
            report(line)
        if len(lines) > MOST_LINES:
            report(f"and {len(lines) - MOST_LINES} lines more like these")
    if refused:
        raise ValueError(
            refused[0]
            + (f" (the first of {len(refused)} findings)" if refused[1:] else "")
        )


def _summary(logs: list[Log], cut: Segments, assignment: Assignment, dt: float) -> str:
    """How much was read, and how many segments came of it."""
    waits = np.concatenate([np.diff(log.time)[log.joined] for log in logs])
    seconds, steps = float(waits.sum()), cut.controls.shape[1]
    counts = np.bincount(assignment.parts, minlength=len(PARTS)).tolist()
    parts = ", ".join(
        f"{count} {name}" for count, name in zip(counts, PARTS, strict=True)
    )
    return (
        f"{len(logs)} drives, {seconds:.0f} s at {1 / np.median(waits):.4g} Hz; "
        f"sampled every {dt:g} s (states linearly, yaw unwrapped; controls and "
        f"environment held); {len(cut.drives)} segments of {steps} steps, "
        f"{100 * len(cut.drives) * steps * dt / seconds:.0f} % of the time: {parts}"
    )


def _dataset(cut: Segments, parts: Int[np.ndarray, " segment"], box: Bounds) -> Dataset:
    """Segments as arrays of a data set."""
    drives = {
        name: len(np.unique(cut.drives[parts == k])) for k, name in enumerate(PARTS)
    }
    arrays = (cut.states, cut.controls, cut.envs)
    trajectories = [
        Trajectory(*(jnp.asarray(a[parts == k], dtype=jnp.float32) for a in arrays))
        for k in range(len(PARTS))
    ]
    low, high = environment_box(cut.envs, *box)
    return Dataset(*trajectories, env_low=low, env_high=high, drives=drives)


def environment_box(
    envs: Float[Array, "*batch environment"] | Float[np.ndarray, "*batch environment"],
    low: Sequence[float] | None = None,
    high: Sequence[float] | None = None,
) -> tuple[Float[Array, " environment"], Float[Array, " environment"]]:
    """Return the corners of E: as given, or as far as the environments reach.

    Environments that are all zero are unknown; E is then wide.

    Args:
        envs: of all segments.
        low: lower corner, or None.
        high: upper corner, or None.
    """
    values = np.asarray(envs)
    values = values.reshape(-1, values.shape[-1])
    corners = (low, high)
    if low is None or high is None:
        wide = np.full(values.shape[1], UNBOUNDED)
        corners = (
            (values.min(axis=0), values.max(axis=0)) if values.any() else (-wide, wide)
        )
    return jnp.asarray(corners[0], dtype=jnp.float32), jnp.asarray(
        corners[1], dtype=jnp.float32
    )


def _coverage(
    cut: Segments, columns: Columns
) -> dict[str, dict[str, dict[str, float]]]:
    """Coverage of body states, controls and measured environments."""
    groups = {
        "state": (columns.state[BODY], cut.states[..., BODY]),
        "control": (columns.control, cut.controls),
        "environment": (columns.environment if cut.envs.any() else (), cut.envs),
    }
    return {
        group: coverage(
            dict(zip(names, values.reshape(-1, values.shape[-1]).T, strict=False))
        )
        for group, (names, values) in groups.items()
    }
