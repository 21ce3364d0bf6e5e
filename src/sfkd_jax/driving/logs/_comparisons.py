"""Compare recorded runs with each other, and single rows with all others.

A few runs in other units, or a few rows with a number in place of a missing one, hardly
change what is computed of all rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sfkd_jax.driving.logs._checks import Checks
from sfkd_jax.driving.logs._findings import Finding, first_of, warning
from sfkd_jax.driving.logs._logs import Log
from sfkd_jax.driving.plants import FRICTION, MASS

Steps: TypeAlias = Float[np.ndarray, " step"]
Values: TypeAlias = Float[np.ndarray, " _"]
"""Values of a channel in a run; every run has a length of its own."""
LARGEST_STEERING = 1.4
"""Angle that a wheel cannot exceed, 80° [rad]. Larger commands are no angles."""
ALIKE = 0.6
"""Correlation of cause and effect from which on their ratio is compared."""
OTHER_GAIN = 3.0
"""Ratio of two gains from which on two runs are in different units. Tyres that slip
change the gain by less.
"""
OTHER_UNIT = 20.0
"""Ratio of the values of two runs from which on they are in different units."""
PLACEHOLDERS = (99.0, 999.0, 9999.0, 99999.0, 32767.0, 32768.0, 65535.0)
"""Sizes of numbers that loggers write where there is no value."""
NEVER_NEGATIVE = (FRICTION, MASS)
"""Roles of entries of e that cannot be below 0."""
BEYOND = 30.0
"""Ratio of a value to all others from which on it stands for a missing one."""


def compare(checks: Checks, logs: list[Log]) -> Iterator[Finding]:
    """Find runs in which a channel has another unit or sign, and rows without a value.

    Args:
        checks: what the runs are checked against.
        logs: at least one run.
    """
    yaw, speed = checks.columns.state[2:4]
    steering, acceleration = checks.columns.control
    yield from _odd_gains(logs, turns, steering, yaw)
    yield from _odd_gains(logs, _accelerations, acceleration, speed)
    for k, name in enumerate(checks.columns.control):
        yield from _placeholders(logs, [log.controls[:, k] for log in logs], name)
    size = logs[0].envs.shape[1]
    names = checks.columns.environment
    if len(names) != size:
        return
    for k, (name, role) in enumerate(zip(names, checks.roles, strict=True)):
        channel = [log.envs[:, k] for log in logs]
        yield from _odd_units(logs, channel, name)
        # Whoever states E says which values are real; others are refused elsewhere.
        if checks.box == (None, None):
            yield from _placeholders(logs, channel, name, role)


def turns(log: Log) -> tuple[Steps, Steps]:
    """Return v tan δ [m/s] and the yaw rate [rad/s] of every step."""
    steering = log.controls[:-1, 0]
    # Commands that are no angles of a wheel may be turn commands, taken as tan δ.
    is_angle = np.abs(log.controls[:, 0]).max() < LARGEST_STEERING
    tangent = np.tan(steering) if is_angle else steering
    expected = (log.states[:-1, 3] * tangent)[log.joined]
    turned = np.diff(np.unwrap(log.states[:, 2]))[log.joined] / log.waits[log.joined]
    return expected, turned


def _accelerations(log: Log) -> tuple[Steps, Steps]:
    """Return the second command, and the acceleration of every step [m/s²]."""
    expected = log.controls[:-1, 1][log.joined]
    accelerated = np.diff(log.states[:, 3])[log.joined] / log.waits[log.joined]
    return expected, accelerated


def _gain(cause: Steps, effect: Steps) -> float:
    """Return effect over cause by least squares; 0 where they are hardly alike."""
    power = float(np.sqrt(np.mean(cause**2) * np.mean(effect**2))) if len(cause) else 0
    product = float(np.mean(cause * effect)) if power else 0.0
    return product / float(np.mean(cause**2)) if abs(product) > ALIKE * power else 0.0


def _odd_gains(
    logs: list[Log],
    motion: Callable[[Log], tuple[Steps, Steps]],
    command: str,
    state: str,
) -> Iterator[Finding]:
    """Find runs that follow a command otherwise than most: another unit or sign.

    Args:
        logs: the runs.
        motion: (run) -> cause and effect of every step.
        command: name of the command.
        state: name of the state that follows it.
    """
    gains = np.array([_gain(*motion(log)) for log in logs])
    known = gains[gains != 0.0]
    if len(known) < 2:
        return

    def fits(gain: float) -> np.ndarray:
        ratio = known / gain
        return (ratio > 1.0 / OTHER_GAIN) & (ratio < OTHER_GAIN)

    usual = float(max(known, key=lambda gain: fits(gain).sum()))
    for log, gain in zip(logs, gains, strict=True):
        ratio = float(gain) / usual
        if ratio and not 1.0 / OTHER_GAIN < ratio < OTHER_GAIN:
            yield warning(
                f"{log.whole}: {state} follows {command} {ratio:.3g} times as strongly "
                f"as in other runs; has {command} another unit or sign in this one?"
            )


def _odd_units(
    logs: list[Log], channel: Sequence[Values], name: str
) -> Iterator[Finding]:
    """Find runs in which nearly all values are much larger or smaller than in others.

    Args:
        logs: the runs.
        channel: its values in each run.
        name: of the channel.
    """
    low, high = np.transpose(
        [np.quantile(np.abs(values), (0.05, 0.95)) for values in channel]
    )
    usual_low = float(np.median(low))
    usual_high = float(np.median(high))
    larger = (low > OTHER_UNIT * usual_high) & (usual_high > 0.0)
    smaller = (OTHER_UNIT * high < usual_low) & (high > 0.0)
    for index in np.flatnonzero(larger | smaller):
        values = channel[int(index)]
        span = f"{values.min():.4g} to {values.max():.4g}"
        yield warning(
            f"{logs[int(index)].whole}: {name} is {span}, in other runs up to "
            f"{usual_high:.4g}; has it another unit in this one?"
        )


def _placeholders(
    logs: list[Log], channel: Sequence[Values], name: str, role: str | None = None
) -> Iterator[Finding]:
    """Find a number that stands for a missing one, such as 9999, or a friction of -1.

    Args:
        logs: the runs.
        channel: its values in each run.
        name: of the channel.
        role: of the entry of e, see `plants.roles_of`; None for a command. A command
            may be much larger once, so that only usual placeholders are found.
    """
    sizes = np.abs(np.concatenate(channel))
    largest = float(sizes.max())
    others = float(sizes[sizes < largest].max(initial=0.0))
    beyond = 0.0 < BEYOND * others < largest
    beyond &= role is not None or largest in PLACEHOLDERS
    hint = "; leave the cell empty where nothing was measured"
    if role is not None:
        hint += ", or pass environment.low and environment.high"
    for log, values in zip(logs, channel, strict=True):
        odd = np.abs(values) == largest if beyond else np.zeros(len(values), dtype=bool)
        # A run that has one value throughout has been measured so.
        odd &= not odd.all()
        if role in NEVER_NEGATIVE:
            odd |= values < 0.0
        yield from first_of(
            log,
            odd,
            lambda k, values=values: f"{name} is {values[k]:.4g}, not a measured value",
            hint=hint,
        )
