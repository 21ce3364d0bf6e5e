"""Cut recorded drives where they jump, and where slow rows are dropped."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from sfkd_jax.data._checks import (
    Finding,
    backwards,
    describe_backwards,
    describe_jump,
    describe_turn,
    more,
    motion,
    position_jumps,
    stale_steps,
    yaw_jumps,
)
from sfkd_jax.data._logs import Columns, Log

Cut: TypeAlias = tuple[Log, list[Finding]]
"""A drive after cutting, and a line about every kind of cut."""


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
        findings.append(_cut_there(describe_backwards(log, columns, back)))
        log = log.cut(back)
    if not log.joined.any():
        return log, findings
    steps = motion(log, dt=dt, gap=gap)
    if stale_steps(log, steps).any():
        return log, findings
    if (jumps := position_jumps(log, steps)).any():
        findings.append(_cut_there(describe_jump(log, columns, steps, jumps)))
        log = log.cut(jumps)
    if log.joined.any() and (turns := yaw_jumps(log, steps)).any():
        findings.append(_cut_there(describe_turn(log, columns, turns)))
        log = log.cut(turns)
    return log, findings


def _cut_there(description: str) -> Finding:
    """A warning that a drive is cut."""
    return Finding(f"{description}; the drive is cut there", refused=False)
