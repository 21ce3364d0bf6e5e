"""What is wrong with a recorded drive row by row: not finite, time that runs back, jumps, stale positions, rates."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sfkd_jax.datasets._logs import Columns, Log

SLOWER = 1.2
"""A log whose period is this many times the model's is refused: rows between its own
would be invented.
"""
LARGEST = 1e38
"""What float32, in which segments are held, holds of a difference of two."""
STALE = 0.2
"""Share of rows with the very position of the row before, though driving, from which
positions count as stale.
"""


class Finding(NamedTuple):
    """One line about a log, with its place, and whether the log is refused for it."""

    line: str
    refused: bool = True


def channels(log: Log, columns: Columns) -> dict[str, Float[np.ndarray, " time"]]:
    """Every column of a drive by its name; an environment that nobody measured has none."""
    named = zip(
        ("state", "control", "environment"),
        (log.states, log.controls, log.envs),
        strict=True,
    )
    found = {columns.time: log.time}
    for setting, values in named:
        names = getattr(columns, setting)
        found |= {
            name: values[:, k]
            for k, name in enumerate(names)
            if len(names) == values.shape[1]
        }
    return found


def check_rows(log: Log, columns: Columns) -> Iterator[Finding]:
    """Numbers that are not finite in float32, and time that does not increase."""
    for name, values in channels(log, columns).items():
        bad = ~np.isfinite(values) | (np.abs(values) > LARGEST)
        if bad.any():
            yield Finding(
                f"{_first(log, bad)}: {name} is {values[bad.argmax()]}{more(bad)}"
            )
    if np.isfinite(log.time).all() and (back := np.diff(log.time) <= 0).any():
        k = int(back.argmax())
        before, after = log.time[k], log.time[k + 1]
        says = (
            f"repeats {after:.12g}"
            if before == after
            else f"goes back from {before:.12g} to {after:.12g}"
        )
        yield Finding(
            f"{log.at(k + 1)}: {columns.time} {says}{more(back)}; two drives in one file? dataset.columns.drive"
        )


def check_motion(
    log: Log, columns: Columns, *, dt: float, gap: float
) -> Iterator[Finding]:
    """Jumps of position and yaw, positions that are older than their rows, and sampling that is too slow or uneven."""
    waits = np.diff(log.time)
    period = float(np.median(waits))
    if period > SLOWER * dt:
        yield Finding(
            f"{log.whole}: recorded every {period:.4g} s, slower than vehicle.dt={dt:g}; pass vehicle.dt={period:.2g}"
        )
    gaps = waits > gap * max(period, dt)
    if gaps.any():
        k = int(gaps.argmax())
        yield Finding(
            f"{log.at(k + 1)}: {waits[k]:.4g} s without rows; drives are split there{more(gaps)}",
            refused=False,
        )
    uneven = (np.abs(waits - period) > 0.5 * period) & ~gaps
    if uneven.mean() > 0.1:
        yield Finding(
            f"{_first(log, uneven, 1)}: uneven sampling, {waits[uneven.argmax()]:.4g} s after the row before"
            f"{more(uneven)}",
            refused=False,
        )
    moved = np.linalg.norm(np.diff(log.states[:, :2], axis=0), axis=1)
    said = 0.5 * (np.abs(log.states[1:, 3]) + np.abs(log.states[:-1, 3])) * waits
    driving = said > 0.1 * np.quantile(said, 0.9)
    stale = driving & (moved == 0.0)
    if stale.sum() > STALE * max(driving.sum(), 1):
        yield Finding(
            f"{_first(log, stale, 1)}: the position of the row before at {log.states[stale.argmax() + 1, 3]:.3g} m/s"
            f"{more(stale)}; log positions as often as {columns.time}, or leave rows out"
        )
        return
    jumps = moved - said > said + 15.0 * 1.4826 * np.median(np.abs(moved - said)) + 1e-6
    jumps &= ~gaps
    if jumps.any():
        k = int(jumps.argmax())
        where = f"{columns.state[0]}, {columns.state[1]} jump {moved[k]:.3g} m at {log.states[k, 3]:.3g} m/s"
        yield Finding(f"{_first(log, jumps, 1)}: {where}{more(jumps)}")
    yield from _check_turns(log, columns, ~gaps)


def _check_turns(
    log: Log, columns: Columns, near: Bool[np.ndarray, " step"]
) -> Iterator[Finding]:
    """Yaw that is elsewhere at once, between rows that are near in time."""
    turned = np.abs(np.diff(np.unwrap(log.states[:, 2])))
    spins = near & (turned > max(1.0, 10.0 * float(np.median(turned))))
    if spins.any():
        yield Finding(
            f"{_first(log, spins, 1)}: {columns.state[2]} jumps by {turned[spins.argmax()]:.3g} rad{more(spins)}"
        )


def _first(log: Log, bad: Bool[np.ndarray, " time"], shift: int = 0) -> str:
    """Where the first of some rows stands."""
    return log.at(int(bad.argmax()) + shift)


def more(bad: Bool[np.ndarray, " time"]) -> str:
    """How many rows there are like the first."""
    return f" ({int(bad.sum())} rows like this)" if bad.sum() > 1 else ""
