"""How late the commands of recorded runs act, with an interval."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.driving.logs._checks import Checks
from sfkd_jax.driving.logs._logs import Log
from sfkd_jax.driving.logs._motion import Profile, find_profile

WIDEST = 0.3
"""Interval up to which a lag counts as determined [s]."""
LEAST_ALIKE = 0.5
"""Correlation from which on a motion counts as that of a command."""
BETWEEN_ROWS = 0.05
"""Error of a lag because motion is interpolated between rows, in periods of the log."""


class CommandLag(NamedTuple):
    """How much later a motion comes than its command.

    This is the sum of the latency of the command and the mean lag of what carries it
    out: a servo with a time constant of 0.1 s looks 0.1 s late. A late measurement of
    the motion counts as well. A command counts as held from its row on; one that was
    measured, and changed between rows, looks half a period early. The lag is
    undetermined if the runs do not excite the command.

    Attributes:
        motion: name of the state that follows the command.
        lag_s: most likely lag [s]; None if it is undetermined.
        low_s: lower end of the 95 % interval [s].
        high_s: upper end of the interval [s].
    """

    motion: str
    lag_s: float | None = None
    low_s: float | None = None
    high_s: float | None = None

    def line(self, command: str) -> str:
        """Return the lag in words, for messages."""
        if self.lag_s is None:
            return f"{self.motion} follows {command} after an undetermined time"
        return (
            f"{self.motion} follows {command} after {self.lag_s:.2f} s "
            f"({self.low_s:.2f} to {self.high_s:.2f} s)"
        )


def command_lags(checks: Checks, logs: list[Log]) -> dict[str, CommandLag]:
    """Return how late each command acts, by its name.

    The first command is compared with the yaw rate. The second one is compared with the
    acceleration, and as a speed command with the speed; what agrees better counts.

    Args:
        checks: what the runs are checked against.
        logs: runs that passed the checks.
    """
    yaw, speed = checks.columns.state[2:4]
    steering, drive = checks.columns.control
    profiles = {
        steering: (yaw, [yaw_tables(checks, logs, 0)]),
        drive: (speed, [make(checks, logs, 1) for make in (speed_tables, speed_steps)]),
    }
    period = max((log.period for log in logs), default=0.0)
    lags = {}
    for command, (motion, tables) in profiles.items():
        found = [find_profile(table, held=True) for table in tables]
        lags[command] = _lag(motion, [one for one in found if one is not None], period)
    return lags


def _lag(motion: str, profiles: list[Profile], period: float) -> CommandLag:
    """Return the lag by the profile that agrees best.

    Args:
        motion: its name.
        profiles: of the ways in which it may follow the command.
        period: of the log [s].
    """
    best = max(profiles, key=lambda one: one.fit[one.best], default=None)
    if best is None or best.fit[best.best] < LEAST_ALIKE**2:
        return CommandLag(motion)
    interval = best.interval()
    if interval is None:
        return CommandLag(motion)
    lag, low, high = interval
    if high - low > WIDEST:
        return CommandLag(motion)
    error = BETWEEN_ROWS * period
    return CommandLag(motion, lag, low - error, high + error)


Tables = list[Float[np.ndarray, "_ 3"]]
"""Time [s], motion and rate of uninterrupted stretches."""


def _tables(
    checks: Checks,
    logs: Iterable[Log],
    columns: Callable[[Log], tuple[np.ndarray, np.ndarray]],
) -> Tables:
    """Return the stretches of all runs with the motion and rate of each run."""
    tables = []
    for log in logs:
        table = np.column_stack([log.time, *columns(log)])
        tables += [table[rows] for rows in log.parts(checks.gap, checks.dt)]
    return tables


def yaw_tables(checks: Checks, logs: list[Log], control: int) -> Tables:
    """Return yaw, and a command times speed: a turn is faster then."""
    return _tables(
        checks,
        logs,
        lambda log: (
            np.unwrap(log.states[:, 2]),
            log.controls[:, control] * log.states[:, 3],
        ),
    )


def speed_tables(checks: Checks, logs: list[Log], control: int) -> Tables:
    """Return the speed, and a command that is an acceleration."""
    return _tables(
        checks, logs, lambda log: (log.states[:, 3], log.controls[:, control])
    )


def speed_steps(checks: Checks, logs: list[Log], control: int) -> Tables:
    """Return the speed, and the changes of a command that is a speed.

    A change between two rows is spread over a period before and after the later row, so
    that it is not late on the mean.
    """
    tables = speed_tables(checks, logs, control)
    changes = []
    for time, speed, command in (table.T for table in tables if len(table) > 1):
        changes.append(np.column_stack([time, speed, np.gradient(command, time)]))
    return changes
