"""Checks of all recorded runs together: ranges, commands, steering and copies."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int, Shaped
from numpy.lib.stride_tricks import sliding_window_view

from sfkd_jax.driving.logs._checks import Checks
from sfkd_jax.driving.logs._command_lags import speed_tables, yaw_tables
from sfkd_jax.driving.logs._comparisons import compare, turns
from sfkd_jax.driving.logs._findings import Finding, more, warning
from sfkd_jax.driving.logs._logs import Log
from sfkd_jax.driving.logs._motion import Delay, find_chords, find_delay

ROUNDED = 1e-5
"""Relative excess over its range that rounding to float32 explains."""
STRAIGHT = 1.0
"""Yaw rate below which a log teaches too little about turning [degrees/s]."""
ALIKE = 1e-3
"""Part of a channel's standard deviation to which numbers are rounded and compared."""
IN_A_ROW = 10
"""Number of steps that are compared at once. Single steps are alike by chance."""


def check_together(checks: Checks, logs: list[Log]) -> list[Finding]:
    """Return the findings about all runs together.

    Args:
        checks: what they are checked against.
        logs: at least one run.
    """
    return [
        *_steering(checks, logs),
        *compare(checks, logs),
        *_ranges(checks, logs),
        *_commands(checks, logs),
        *_repeats(checks, logs),
    ]


def _steering(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Compare yaw rates with those of a bicycle, ω = v tan δ / L: sign, unit and L."""
    turns_of_logs = [turns(log) for log in logs]
    expected = np.concatenate([expected_turn for expected_turn, _ in turns_of_logs])
    turned = np.concatenate([yaw_rate for _, yaw_rate in turns_of_logs])
    power = float(np.sqrt(np.mean(expected**2) * np.mean(turned**2)))
    alike = float(np.mean(expected * turned)) / power if power else 0.0
    # The control is no steering angle, or there is too little steering to tell.
    if abs(alike) < 0.6:
        return
    wheelbase = float(np.mean(expected**2) / np.mean(expected * turned))
    name = checks.columns.control[0]
    where = _span(logs)
    if alike < 0:
        yield warning(
            f"{where}: the robot turns against {name}; "
            "a positive one should turn it left"
        )
    elif not 0.6 < wheelbase / checks.wheelbase < 1.7:
        unit = f" or {name} is not in rad" if wheelbase > 10 * checks.wheelbase else ""
        yield warning(
            f"{where}: {name} and yaw suggest a wheelbase of {wheelbase:.3g} m, "
            f"vehicle.wheelbase is {checks.wheelbase:g}{unit}"
        )


def _ranges(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Find controls that hardly vary or leave their limits, and e outside of E."""
    yield from _excitation(checks, logs)
    low, high = checks.limits
    if low and high:
        limits = "of vehicle.control_low and vehicle.control_high"
        for line in _outside(logs, "controls", checks.columns.control, low, high):
            yield warning(f"{line} {limits}")
    low, high = checks.box
    if low is None and high is None:
        return
    low = () if low is None else low
    high = () if high is None else high
    size = logs[0].envs.shape[1]
    if {len(low), len(high)} != {size} or np.any(np.greater(low, high)):
        yield Finding(
            f"environment.low and environment.high must be {size} numbers each, "
            "the low ones not above the high"
        )
        return
    names = checks.columns.environment
    if len(names) != size:
        names = ("environment",) * size
    for line in _outside(logs, "envs", names, low, high):
        yield Finding(f"{line} of environment.low and environment.high")


def _excitation(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Find controls that are constant, or take few values."""
    where = _span(logs)
    for k, name in enumerate(checks.columns.control):
        values = np.concatenate([log.controls[:, k] for log in logs])
        count = len(np.unique(values))
        if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
            yield Finding(
                f"{where}: {name} is always {values[0]:.4g}; "
                "without excitation nothing can be learned of it"
            )
        elif count < 5:
            yield warning(f"{where}: {name} takes only {count} values; vary it more")


def _outside(
    logs: list[Log],
    field: str,
    names: tuple[str, ...],
    low: tuple[float, ...],
    high: tuple[float, ...],
) -> Iterator[str]:
    """Yield a line about the first row of every channel that is outside its range.

    Args:
        logs: the runs.
        field: of the logs that holds the channels.
        names: of the channels.
        low: lower end of every range.
        high: upper end of every range.
    """
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
    """Return where several runs are, for messages."""
    if len(logs) == 1:
        return logs[0].whole
    return f"{logs[0].whole} and {len(logs) - 1} runs more"


def _commands(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Compare the motion with the commands.

    Finds columns that changed places, delays, and runs without curves.
    """
    yaw, speed = checks.columns.state[2:4]
    controls = checks.columns.control
    for log in logs:
        yaws = [_yaw_delay(checks, [log], control).alike for control in (0, 1)]
        speeds = [_speed_delay(checks, [log], control).alike for control in (0, 1)]
        swapped = yaws[1] > 0.8 or (speeds[0] > 0.8 and speeds[1] < 0.4)
        if yaws[0] < 0.4 and swapped:
            yield Finding(
                f"{log.whole}: {yaw} follows {controls[1]} (correlation "
                f"{yaws[1]:.2f}), not {controls[0]} ({yaws[0]:.2f}); "
                "have columns changed places?"
            )
    delays = (
        (_yaw_delay(checks, logs, 0), yaw, controls[0]),
        (_speed_delay(checks, logs, 1), speed, controls[1]),
    )
    for delay, motion, command in delays:
        steps = delay.lag / checks.dt
        # A motion may be half a step early if its command was measured or interpolated.
        if delay.certain and delay.alike > 0.8 and (steps < -1.0 or steps > 0.25):
            yield warning(
                f"{_span(logs)}: {delay.line(motion, command, checks.dt)}, "
                "unless a state shows the delay"
            )
    turn = np.concatenate([find_chords(log, log.states[:, 3]).turn for log in logs])
    if not turn.size:
        return
    rate = np.rad2deg(np.sqrt(np.mean(turn**2)))
    if rate < STRAIGHT:
        yield warning(
            f"{_span(logs)}: {yaw} turns by {rate:.2g} degrees a second (root mean "
            "square); record curves, or the model learns none"
        )


def _yaw_delay(checks: Checks, logs: list[Log], control: int) -> Delay:
    """Return the delay of yaw behind a command."""
    return find_delay(yaw_tables(checks, logs, control), held=True)


def _speed_delay(checks: Checks, logs: list[Log], control: int) -> Delay:
    """Return the delay of the speed behind a command."""
    return find_delay(speed_tables(checks, logs, control), held=True)


def _repeats(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Find stretches as long as a segment that two runs have in common.

    Numbers are compared, since a copy may have another format, clock and origin.
    """
    spread = np.std(np.concatenate([log.steps for log in logs]), axis=0)
    scale = ALIKE * np.where(spread > 0.0, spread, 1.0)
    hashes_of_logs = [_hashes(log, scale) for log in logs]
    hashes = np.concatenate([log_hashes for log_hashes, _ in hashes_of_logs])
    rows = np.concatenate([log_rows for _, log_rows in hashes_of_logs])
    counts = [len(log_hashes) for log_hashes, _ in hashes_of_logs]
    owners = np.repeat(np.arange(len(logs)), counts)
    # For every hash, the first one that is equal: a copy has its origin in another run.
    _, first, group = np.unique(hashes, return_index=True, return_inverse=True)
    origins = first[group]
    pairs = np.column_stack([owners[origins], owners])
    copied = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    for origin, copy in copied:
        places = np.flatnonzero((pairs == (origin, copy)).all(axis=1))
        duration = (len(places) + IN_A_ROW) * logs[copy].period
        if duration < checks.steps * checks.dt:
            continue
        here = _stretch(logs[copy], rows[places])
        there = _stretch(logs[origin], rows[origins[places]])
        yield Finding(
            f"{here}: the same numbers as {there}; remove one of them, "
            "or test runs are trained on"
        )


def _stretch(log: Log, starts: Int[np.ndarray, " place"]) -> str:
    """Return where the compared steps are that begin at some rows, for messages."""
    return log.between(int(starts.min()), int(starts.max()) + IN_A_ROW)


def _hashes(
    log: Log, scale: Float[np.ndarray, " channel"]
) -> tuple[Shaped[np.ndarray, " place"], Int[np.ndarray, " place"]]:
    """Return a hash of every `IN_A_ROW` steps that vary, and the rows of their starts.

    Args:
        log: the run.
        scale: of every channel, to which numbers are rounded.
    """
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
    # Sums of products modulo 2^64.
    return np.einsum("kcs,cs->k", several, weights)[kept], np.flatnonzero(kept)
