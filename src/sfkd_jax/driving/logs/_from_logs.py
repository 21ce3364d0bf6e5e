"""Make a data set of recorded runs: read, check, resample, cut and assign them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sfkd_jax.data import PARTS, Dataset, coverage, environment_box
from sfkd_jax.driving.logs._checks import Bounds, Checks
from sfkd_jax.driving.logs._command_lags import CommandLag, command_lags
from sfkd_jax.driving.logs._findings import Finding
from sfkd_jax.driving.logs._joint_checks import check_together
from sfkd_jax.driving.logs._log_files import SUFFIXES, left_out, log_files
from sfkd_jax.driving.logs._logs import Columns, Log
from sfkd_jax.driving.logs._reading import read_logs
from sfkd_jax.driving.logs._segments import Piece, assign_parts, pieces, segments
from sfkd_jax.driving.plants import roles_of
from sfkd_jax.ranges import Fraction, NonNegativeInt, Positive, Real, check_choice
from sfkd_jax.types import BODY, Trajectory

MOST_LINES = 20
"""Number of warnings that are reported in full; further ones are only counted. The same
holds for reasons to refuse the logs.
"""
FEW = 5
"""Number of files that a line names."""
Coverage: TypeAlias = dict[str, dict[str, dict[str, float]]]
"""`coverage` of every channel by its name, in the groups "state", "control" and
"environment".
"""


class LoggedDataset(NamedTuple):
    """A data set of recorded runs, and what was found of them.

    Attributes:
        dataset: of their segments.
        coverage: how well the segments cover every channel.
        command_lags: how late each command acts, by its name.
    """

    dataset: Dataset
    coverage: Coverage
    command_lags: dict[str, CommandLag]


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
    env_roles: tuple[str, ...] = (),
) -> LoggedDataset:
    """Make a data set of recorded runs, or refuse them with the reason.

    Args:
        path: a file, a folder or a glob of .csv, .npz and .parquet.
        columns: names of their columns.
        dt: period of the model [s].
        wheelbase: that the steering is compared with [m].
        limits: lower and upper limits of the controls.
        needs_environment: whether the environment must be in the logs. If not, it
            counts as unknown, whatever the logs hold.
        report: receives every line for the user.
        steps: of a segment.
        gap: longest wait between rows that is bridged, in periods.
        min_speed: speed below which rows are dropped and the run is cut [m/s].
        split_at_jumps: whether a run is cut where time, position or yaw jump. If not,
            such a run is refused.
        missing: "refuse", or "drop" rows in which a number is missing. The run is cut
            where rows are dropped.
        shares: of training, validation, calibration and test.
        seed: of the random order of runs.
        env_low: lower corner of E, or None for a box as large as the logs need.
        env_high: upper corner of E, or None.
        env_roles: what each entry of e is, see `plants.roles_of`; () for what the
            names of the columns say.

    Raises:
        ValueError: the first reason why the logs are refused; the others are reported.
    """
    check_choice("dataset.missing", missing, ("refuse", "drop"))
    box = (env_low, env_high) if needs_environment else (None, None)
    checks = Checks(
        columns=columns,
        dt=dt,
        steps=steps,
        wheelbase=wheelbase,
        gap=gap,
        min_speed=min_speed,
        split_at_jumps=split_at_jumps,
        drop_missing=missing == "drop",
        limits=limits,
        box=box,
        roles=roles_of(columns.environment, env_roles),
    )
    logs = _checked_logs(path, checks, needs_environment, report)
    lags = command_lags(checks, logs)
    found = ", ".join(lag.line(name) for name, lag in lags.items())
    report(f"{found}: latency and lag of the actuators together")
    cut, runs = segments([list(pieces(log, dt, gap)) for log in logs], steps)
    parts, whole_runs = assign_parts(runs, shares=shares, seed=seed)
    _report_sizes(logs, parts, steps, dt, report)
    if not whole_runs:
        report(
            "warning: too few runs to assign them whole; each was cut in time, and "
            "coverage is that of the same runs only"
        )
    # The box is that of the segments: rows that were dropped do not widen it.
    low, high = environment_box(cut.envs, *box, known=needs_environment)
    dataset = _dataset_of_parts(cut, runs, parts, low, high)
    environment = columns.environment if needs_environment else ()
    covered = _coverage(cut, columns, environment)
    _report_coverage(covered, report)
    return LoggedDataset(dataset, covered, lags)


def _checked_logs(
    path: str,
    checks: Checks,
    needs_environment: bool,
    report: Callable[[str], None],
) -> list[Log]:
    """Read and check all logs of a path, and return the runs that can be used.

    All files are read and checked before any is refused: one call shows all faults. The
    arguments are those of `from_logs`.
    """
    recorded, errors, conversions = read_logs(
        [file for _, file in log_files(path)],
        checks.columns,
        dt=checks.dt,
        needs_environment=needs_environment,
        blanks=checks.drop_missing,
    )
    if others := left_out(path):
        names = ", ".join(others[:FEW]) + (", …" if len(others) > FEW else "")
        report(
            f"warning: {path}: {len(others)} files are left out, since they are no "
            f"{', '.join(SUFFIXES)}: {names}"
        )
    if conversions:
        report(f"converted to SI units: {', '.join(conversions)}")
    logs, findings = checks.apply(recorded)
    if logs:
        findings += check_together(checks, logs)
    _report_findings([*map(Finding, errors), *findings], report)
    return logs


def _dataset_of_parts(
    cut: Piece,
    runs: Int[np.ndarray, " segment"],
    parts: Int[np.ndarray, " segment"],
    env_low: Float[Array, " environment"],
    env_high: Float[Array, " environment"],
) -> Dataset:
    """Return the data set of segments.

    Args:
        cut: the segments, stacked.
        runs: number of the run of each.
        parts: part of each, as index into `PARTS`.
        env_low: lower corner of E.
        env_high: upper corner of E.
    """
    trajectories: list[Trajectory] = []
    runs_of_parts: dict[str, int] = {}
    for index, name in enumerate(PARTS):
        chosen = parts == index
        arrays = (jnp.asarray(array[chosen], dtype=jnp.float32) for array in cut)
        trajectories.append(Trajectory(*arrays))
        runs_of_parts[name] = len(np.unique(runs[chosen]))
    return Dataset(
        *trajectories, env_low=env_low, env_high=env_high, runs=runs_of_parts
    )


def _report_sizes(
    logs: list[Log],
    parts: Int[np.ndarray, " segment"],
    steps: int,
    dt: float,
    report: Callable[[str], None],
) -> None:
    """Report how much was recorded, and how it was sampled and divided.

    Args:
        logs: the runs.
        parts: part of every segment, as index into `PARTS`.
        steps: of a segment.
        dt: sampling period [s].
        report: receives the line.
    """
    waits = np.concatenate([log.waits[log.joined] for log in logs])
    seconds = float(waits.sum())
    sizes = [f"{int((parts == k).sum())} {name}" for k, name in enumerate(PARTS)]
    report(
        f"{len(logs)} runs, {seconds:.0f} s at {1 / np.median(waits):.4g} Hz, "
        f"sampled every {dt:g} s (states linearly, yaw unwrapped; controls "
        f"averaged over each step, environment held); {len(parts)} segments "
        f"of {steps} steps, {len(parts) * steps * dt / seconds:.0%}: "
        f"{', '.join(sizes)}"
    )


def _coverage(cut: Piece, columns: Columns, environment: tuple[str, ...]) -> Coverage:
    """Return the coverage of every channel of the segments by its name.

    Args:
        cut: the segments, stacked.
        columns: names of states and controls.
        environment: names of the entries of e, or () if they are unknown.
    """
    groups = {
        "state": (columns.state[BODY], cut.states[..., BODY]),
        "control": (columns.control, cut.controls),
        "environment": (environment, cut.envs),
    }
    covered = {}
    for group, (names, values) in groups.items():
        channels = values.reshape(-1, values.shape[-1]).T
        covered[group] = coverage(dict(zip(names, channels, strict=False)))
    return covered


def _report_coverage(covered: Coverage, report: Callable[[str], None]) -> None:
    """Report the coverage of every channel in a line."""
    for group, channels in covered.items():
        for name, channel in channels.items():
            full = f"{channel['low']:.4g} … {channel['high']:.4g}"
            middle = f"{channel['low_998']:.4g} … {channel['high_998']:.4g}"
            visited = round(10 * channel["bins_visited"])
            report(
                f"coverage of {group} {name}: {full}, middle 99.8 % {middle}, "
                f"{visited} of 10 tenths visited"
            )


def _report_findings(findings: list[Finding], report: Callable[[str], None]) -> None:
    """Report all findings, and raise the first for which the logs are refused.

    Raises:
        ValueError: the logs are refused.
    """
    warnings: list[str] = []
    reasons: list[str] = []
    for finding in findings:
        if finding.refused:
            reasons.append(finding.line)
        else:
            warnings.append(f"warning: {finding.line}")
    # The first reason is the text of the error, and not reported as well.
    for lines in (warnings, reasons[1:]):
        for line in lines[:MOST_LINES]:
            report(line)
        if len(lines) > MOST_LINES:
            report(f"and {len(lines) - MOST_LINES} lines more like these")
    if len(reasons) > 1:
        raise ValueError(f"{reasons[0]} (the first of {len(reasons)} findings)")
    if reasons:
        raise ValueError(reasons[0])
