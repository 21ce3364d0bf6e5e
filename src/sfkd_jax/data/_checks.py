"""Check recorded drives row by row, and cut them where they jump or stand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sfkd_jax.data._logs import Columns, Log

SLOWER = 1.2
"""A log whose period is this many times the model's is refused: rows between its own
would be invented.
"""
LARGEST = 1e38
"""Largest number whose differences float32, which segments are stored in, can hold."""
STALE = 0.2
"""Share of driving rows that repeat the position of the row before, from which
positions count as stale.
"""


class Finding(NamedTuple):
    """One line about a log, and whether the log is refused for it."""

    line: str
    refused: bool = True


class Motion(NamedTuple):
    """A drive step by step.

    Attributes:
        waits: time between rows [s].
        period: median of it [s].
        gaps: whether a wait is longer than what is bridged.
        moved: distance between positions [m].
        integrated: distance by the speed [m].
    """

    waits: Float[np.ndarray, " step"]
    period: float
    gaps: Bool[np.ndarray, " step"]
    moved: Float[np.ndarray, " step"]
    integrated: Float[np.ndarray, " step"]


CUT_THERE = "; the drive is cut there"
Jumps: TypeAlias = tuple[Bool[np.ndarray, " step"], str]
"""The steps that jump, and a line about the first of them."""
Cut: TypeAlias = tuple[Log, list[Finding]]
"""A drive after cutting, and a line about every kind of cut."""


def channels(log: Log, columns: Columns) -> dict[str, Float[np.ndarray, " time"]]:
    """Return every column of a drive by its name, less an unknown environment."""
    groups = {
        "state": log.states,
        "control": log.controls,
        "environment": log.envs,
    }
    named = {columns.time: log.time}
    for setting, values in groups.items():
        names = getattr(columns, setting)
        if len(names) == values.shape[1]:
            named |= dict(zip(names, values.T, strict=True))
    return named


def motion(log: Log, *, dt: float, gap: float) -> Motion:
    """Measure the steps of a drive; steps across a cut count neither way.

    Args:
        log: at least two joined rows, all finite.
        dt: of the model [s].
        gap: the longest wait that is bridged, in periods: of the log or dt, whichever
            is longer.
    """
    waits = np.diff(log.time)
    period = float(np.median(waits[log.joined]))
    moved = np.linalg.norm(np.diff(log.states[:, :2], axis=0), axis=1)
    speed = np.abs(log.states[:, 3])
    integrated = 0.5 * (speed[1:] + speed[:-1]) * waits
    gaps = waits > gap * max(period, dt)
    return Motion(waits, period, gaps & log.joined, moved, integrated)


def check_finite(log: Log, columns: Columns) -> Iterator[Finding]:
    """Refuse numbers that are not finite in float32."""
    for name, values in channels(log, columns).items():
        bad = ~np.isfinite(values) | (np.abs(values) > LARGEST)
        if bad.any():
            yield Finding(
                f"{_first(log, bad)}: {name} is {values[bad.argmax()]}{more(bad)}"
            )


def check_time(log: Log, columns: Columns) -> Iterator[Finding]:
    """Refuse time that does not increase."""
    if (back := backwards(log)).any():
        yield Finding(
            f"{describe_backwards(log, columns, back)}; "
            "two drives in one file? dataset.columns.drive, dataset.split_at_jumps"
        )


def backwards(log: Log) -> Bool[np.ndarray, " step"]:
    """Return the steps at which time repeats or goes back."""
    return (np.diff(log.time) <= 0) & log.joined


def describe_backwards(
    log: Log, columns: Columns, back: Bool[np.ndarray, " step"]
) -> str:
    """Describe the first of such steps."""
    k = int(back.argmax())
    before, after = log.time[k], log.time[k + 1]
    change = (
        f"repeats {after:.12g}"
        if before == after
        else f"goes back from {before:.12g} to {after:.12g}"
    )
    return f"{log.at(k + 1)}: {columns.time} {change}{more(back)}"


def check_motion(
    log: Log, columns: Columns, *, dt: float, gap: float
) -> Iterator[Finding]:
    """Check sampling, stale positions, and jumps of position and yaw."""
    steps = motion(log, dt=dt, gap=gap)
    yield from _check_sampling(log, steps, dt)
    if (stale := stale_steps(log, steps)).any():
        yield Finding(
            f"{_first(log, stale, 1)}: the position of the row before "
            f"at {log.states[stale.argmax() + 1, 3]:.3g} m/s{more(stale)}; "
            f"log positions as often as {columns.time}, or leave rows out"
        )
        return
    for find in (_position_jumps, _yaw_jumps):
        jumps, line = find(log, columns, steps)
        if jumps.any():
            yield Finding(line)


def _check_sampling(log: Log, steps: Motion, dt: float) -> Iterator[Finding]:
    """Refuse slow sampling; warn of gaps and uneven sampling."""
    waits, period, gaps = steps.waits, steps.period, steps.gaps
    if period > SLOWER * dt:
        yield Finding(
            f"{log.whole}: recorded every {period:.4g} s, slower than "
            f"vehicle.dt={dt:g}; pass vehicle.dt={period:.2g}"
        )
    if gaps.any():
        k = int(gaps.argmax())
        yield Finding(
            f"{log.at(k + 1)}: {waits[k]:.4g} s without rows; "
            f"drives are split there{more(gaps)}",
            refused=False,
        )
    uneven = (np.abs(waits - period) > 0.5 * period) & ~gaps & log.joined
    if uneven.mean() > 0.1:
        yield Finding(
            f"{_first(log, uneven, 1)}: uneven sampling, "
            f"{waits[uneven.argmax()]:.4g} s after the row before{more(uneven)}",
            refused=False,
        )


def stale_steps(log: Log, steps: Motion) -> Bool[np.ndarray, " step"]:
    """Return steps without motion while driving; none if they are few."""
    integrated = steps.integrated
    driving = integrated > 0.1 * np.quantile(integrated[log.joined], 0.9)
    driving &= log.joined
    stale = driving & (steps.moved == 0.0)
    many = stale.sum() > STALE * max(driving.sum(), 1)
    return stale if many else np.zeros_like(stale)


def _position_jumps(log: Log, columns: Columns, steps: Motion) -> Jumps:
    """Steps much longer than the speed explains."""
    moved, integrated = steps.moved, steps.integrated
    spread = 1.4826 * np.median(np.abs(moved - integrated)[log.joined])
    jumps = moved - integrated > integrated + 15.0 * spread + 1e-6
    jumps &= ~steps.gaps & log.joined
    k = int(jumps.argmax())
    return jumps, (
        f"{log.at(k + 1)}: {columns.state[0]}, {columns.state[1]} "
        f"jump {moved[k]:.3g} m at {log.states[k, 3]:.3g} m/s{more(jumps)}"
    )


def _yaw_jumps(log: Log, columns: Columns, steps: Motion) -> Jumps:
    """Steps that turn much more than the others, between rows near in time."""
    turned = np.abs(np.diff(np.unwrap(log.states[:, 2])))
    usual = float(np.median(turned[log.joined]))
    jumps = ~steps.gaps & log.joined & (turned > max(1.0, 10.0 * usual))
    k = int(jumps.argmax())
    line = f"{log.at(k + 1)}: {columns.state[2]} jumps by {turned[k]:.3g} rad"
    return jumps, line + more(jumps)


def _first(log: Log, bad: Bool[np.ndarray, " time"], shift: int = 0) -> str:
    """The position of the first of some rows."""
    return log.at(int(bad.argmax()) + shift)


def more(bad: Bool[np.ndarray, " time"]) -> str:
    """Return how many rows there are like the first, for messages."""
    return f" ({int(bad.sum())} rows like this)" if bad.sum() > 1 else ""


def drop_slow_rows(log: Log, columns: Columns, *, min_speed: float) -> Cut:
    """Drop rows slower than `min_speed` [m/s] and cut the drive there."""
    slow = np.abs(log.states[:, 3]) < min_speed
    if not slow.any():
        return log, []
    k = int(slow.argmax())
    line = (
        f"{log.at(k)}: {columns.state[3]} is {log.states[k, 3]:.3g} m/s, "
        f"dropped by dataset.min_speed={min_speed:g}; the drive is cut there"
    )
    return log.select(~slow), [Finding(line + more(slow), refused=False)]


def cut_at_jumps(log: Log, columns: Columns, *, dt: float, gap: float) -> Cut:
    """Cut a drive where time goes back and where position or yaw jump.

    Stale positions jump at every update: such a drive is left as it is.

    Args:
        log: rows that are finite.
        columns: their names.
        dt: of the model [s].
        gap: see `motion`.
    """
    findings = []
    if (back := backwards(log)).any():
        line = describe_backwards(log, columns, back)
        findings.append(Finding(line + CUT_THERE, refused=False))
        log = log.cut(back)
    if not log.joined.any():
        return log, findings
    steps = motion(log, dt=dt, gap=gap)
    if stale_steps(log, steps).any():
        return log, findings
    for find in (_position_jumps, _yaw_jumps):
        if not log.joined.any():  # the cuts have left single rows
            break
        jumps, line = find(log, columns, steps)
        if jumps.any():
            findings.append(Finding(line + CUT_THERE, refused=False))
            log = log.cut(jumps)
    return log, findings
