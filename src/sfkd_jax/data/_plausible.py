"""Check units, axes, columns and ranges against the motion of recorded drives."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from sfkd_jax.data._checks import Finding, channels, more
from sfkd_jax.data._logs import Columns, Log

Bounds: TypeAlias = tuple[tuple[float, ...] | None, tuple[float, ...] | None]
"""Lowest and highest of every channel, or None where there is no bound."""
ROUNDED = 1e-5
"""How far outside its range a channel may be: float32 rounds."""
LOOK = 0.5
"""Length of the chords over which motion is compared with the columns [s]."""
AGREE = (0.8, 1.25)
"""Path length over integrated speed of a plausible log."""
FACTORS = (
    (1 / 3.6, "the speed is probably in km/h"),
    (0.44704, "the speed is probably in miles per hour"),
    (0.3048, "the speed is probably in feet per second"),
    (3.28084, "positions are probably in feet"),
    (1e2, "positions are probably in cm"),
    (1e3, "positions are probably in mm"),
    (1e-3, "time is probably in ms, or positions in km"),
    (1e-6, "time is probably in µs"),
    (1e-9, "time is probably in ns"),
    (9e-6, "positions are probably degrees of latitude and longitude"),
    (57.29578, "the speed is probably an angular rate, or columns changed places"),
)


class Chords(NamedTuple):
    """Chords of a drive over about `LOOK`, where it moves.

    Attributes:
        length: of the chord [m].
        integrated: ∫ v dt [m].
        course: direction of the chord, reversed where v < 0 [rad].
        middle: index of the row in the middle.
    """

    length: Float[np.ndarray, " chord"]
    integrated: Float[np.ndarray, " chord"]
    course: Float[np.ndarray, " chord"]
    middle: Int[np.ndarray, " chord"]


def check_units(log: Log, columns: Columns) -> Iterator[Finding]:
    """Check the speed against positions, then yaw against the direction of travel."""
    chords = _chords(log, log.states[:, 3])
    moved, integrated = chords.length.sum(), np.abs(chords.integrated).sum()
    if moved == 0.0 and integrated == 0.0:
        yield Finding(
            f"{log.whole}: neither position nor {columns.state[3]} ever moves",
            refused=False,
        )
        return
    if moved == 0.0 or integrated == 0.0:
        still, goes = (
            ("the position", columns.state[3])
            if moved == 0.0
            else (columns.state[3], "the position")
        )
        yield Finding(
            f"{log.whole}: {still} stands still while {goes} moves; "
            "have columns changed places?"
        )
        return
    ratio = moved / integrated
    if not AGREE[0] <= ratio <= AGREE[1]:
        yield Finding(
            f"{log.whole}: positions move {ratio:.3g} times as fast as "
            f"{columns.state[3]}; {_cause(log, columns, ratio)}"
        )
        return
    yield from _check_heading(log, columns, chords)


def _chords(log: Log, speed: Float[np.ndarray, " time"]) -> Chords:
    """Chords of a drive that moved, by position or by a speed."""
    waits = np.diff(log.time)
    period = float(np.median(waits[log.joined]))
    reach = min(max(1, round(LOOK / period)), len(log.time) - 1)
    along = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * waits)])
    chord = log.states[reach:, :2] - log.states[:-reach, :2]
    length, integrated = np.linalg.norm(chord, axis=1), along[reach:] - along[:-reach]
    whole = log.time[reach:] - log.time[:-reach] < 1.5 * reach * period  # no gap inside
    whole &= log.stretch[reach:] == log.stretch[:-reach]
    enough = [
        0.2 * np.max(np.abs(lengths), where=whole, initial=0.0)
        for lengths in (length, integrated)
    ]
    moving = whole & ((length > enough[0]) | (np.abs(integrated) > enough[1]))
    course = np.arctan2(chord[:, 1], chord[:, 0]) + np.pi * (integrated < 0)
    return Chords(
        length[moving],
        integrated[moving],
        course[moving],
        np.flatnonzero(moving) + reach // 2,
    )


def _cause(log: Log, columns: Columns, ratio: float) -> str:
    """A unit that explains a factor, else a column that fits as the speed, if any."""
    nearest, text = min(FACTORS, key=lambda factor: abs(math.log(ratio / factor[0])))
    tolerance = 0.5 if nearest == 9e-6 else 0.1
    if abs(math.log(ratio / nearest)) < tolerance:
        return text
    for name, values in channels(log, columns).items():
        chords = _chords(log, values)
        integrated = np.abs(chords.integrated).sum()
        if (
            name not in (columns.time, *columns.state[:2])
            and 0.9 * integrated <= chords.length.sum() <= 1.1 * integrated
        ):
            return f"{name} fits as the speed: have columns changed places?"
    return "wrong units, or columns changed places?"


def _check_heading(log: Log, columns: Columns, chords: Chords) -> Iterator[Finding]:
    """Check yaw against the direction of travel; name a likely cause."""
    name, yaw = columns.state[2], log.states[chords.middle, 2]
    agreed = _agreement(chords.course - yaw)
    if abs(agreed) > 0.7 and abs(np.angle(agreed)) < 0.5:
        return
    readings = _readings(columns, yaw)
    best = max(
        readings, key=lambda text: _agreement(chords.course - readings[text]).real
    )
    off = f"{log.whole}: {name} and the direction of travel differ"
    if _agreement(chords.course - readings[best]).real > 0.9:
        yield Finding(f"{off}; {best}")
    elif abs(agreed) > 0.7:
        yield Finding(
            f"{off} by {np.angle(agreed):.2f} rad throughout; "
            "is the sensor mounted askew?",
            False,
        )
    else:
        yield Finding(
            f"{off} at random; a robot that drives sideways, "
            "or columns that changed places?",
            False,
        )


def _readings(
    columns: Columns, yaw: Float[np.ndarray, " chord"]
) -> dict[str, Float[np.ndarray, " chord"]]:
    """What yaw may be instead, and the yaw that follows."""
    x, y, name, speed = columns.state[:4]
    return {
        f"{name} is probably in degrees": np.deg2rad(yaw),
        f"{name} probably counts clockwise": -yaw,
        f"{name} is probably a compass heading (from north, clockwise), "
        f"or {x} and {y} changed places": 0.5 * np.pi - yaw,
        f"{name} is probably a compass heading in degrees": 0.5 * np.pi
        - np.deg2rad(yaw),
        f"{name} probably counts from the y axis": yaw + 0.5 * np.pi,
        f"{speed} is probably of the wrong sign, or the robot drives backwards": yaw
        + np.pi,
    }


def _agreement(angles: Float[np.ndarray, " chord"]) -> complex:
    """Mean of exp(i φ): its length measures agreement, its angle is the mean angle."""
    return complex(np.mean(np.exp(1j * angles)))


def check_steering(
    logs: list[Log], columns: Columns, *, wheelbase: float
) -> Iterator[Finding]:
    """Compare yaw rates with a bicycle's, ω = v tan δ / L; warn of sign, unit and L."""
    expected, turned = (
        np.concatenate(parts) for parts in zip(*map(_turns, logs), strict=True)
    )
    power = float(np.sqrt(np.mean(expected**2) * np.mean(turned**2)))
    alike = float(np.mean(expected * turned)) / power if power else 0.0
    if abs(alike) < 0.6:
        return  # not a steering angle, or too little steering
    fits = float(np.mean(expected**2) / np.mean(expected * turned))
    name, where = columns.control[0], span(logs)
    if alike < 0:
        yield Finding(
            f"{where}: the robot turns against {name}; "
            "a positive one should turn it left",
            refused=False,
        )
    elif not 0.6 < fits / wheelbase < 1.7:
        unit = f" or {name} is not in rad" if fits > 10 * wheelbase else ""
        yield Finding(
            f"{where}: {name} and yaw suggest a wheelbase of {fits:.3g} m, "
            f"vehicle.wheelbase is {wheelbase:g}{unit}",
            refused=False,
        )


def _turns(log: Log) -> tuple[Float[np.ndarray, " step"], Float[np.ndarray, " step"]]:
    """v tan δ and the yaw rate of every step; large controls are taken as tan δ."""
    steering = log.controls[:-1, 0]
    angle = np.tan(steering) if np.abs(log.controls[:, 0]).max() < 1.4 else steering
    joined = log.joined
    turned = np.diff(np.unwrap(log.states[:, 2]))[joined] / np.diff(log.time)[joined]
    return (log.states[:-1, 3] * angle)[joined], turned


def check_ranges(
    logs: list[Log], columns: Columns, *, limits: Bounds, box: Bounds
) -> Iterator[Finding]:
    """Refuse constant controls and environments outside E; warn of the rest.

    Warnings are of poor excitation and of controls outside their limits.

    Args:
        logs: all drives.
        columns: their names.
        limits: of the controls.
        box: E.
    """
    where = span(logs)
    for k, name in enumerate(columns.control):
        values = np.concatenate([log.controls[:, k] for log in logs])
        kinds = len(np.unique(values))
        if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
            yield Finding(
                f"{where}: {name} is always {values[0]:.4g}; "
                "without excitation nothing can be learned of it"
            )
        elif kinds < 5:
            yield Finding(
                f"{where}: {name} takes only {kinds} values; vary it more",
                refused=False,
            )
    if limits[0] and limits[1]:
        yield from _outside(
            logs,
            columns.control,
            "controls",
            (limits[0], limits[1]),
            "vehicle.control",
            refused=False,
        )
    low, high = box
    if low is None and high is None:
        return
    size = logs[0].envs.shape[1]
    if (
        low is None
        or high is None
        or {len(low), len(high)} != {size}
        or np.any(np.greater(low, high))
    ):
        yield Finding(
            f"environment.low and environment.high must be {size} numbers each, "
            "the low ones not above the high"
        )
        return
    names = (
        columns.environment
        if len(columns.environment) == size
        else ("environment",) * size
    )
    yield from _outside(logs, names, "envs", (low, high), "dataset.env", refused=True)


def span(logs: list[Log]) -> str:
    """Return the position of several drives, for messages."""
    return logs[0].whole + (
        f" and {len(logs) - 1} drives more" if len(logs) > 1 else ""
    )


def _outside(
    logs: list[Log],
    names: tuple[str, ...],
    field: str,
    bounds: tuple[tuple[float, ...], tuple[float, ...]],
    setting: str,
    *,
    refused: bool,
) -> Iterator[Finding]:
    """Report the first row of every channel that is outside its range."""
    for k, (name, low, high) in enumerate(zip(names, *bounds, strict=True)):
        for log in logs:
            values: Float[np.ndarray, " time"] = getattr(log, field)[:, k]
            slack = ROUNDED * max(1.0, abs(low), abs(high))
            outside = (values < low - slack) | (values > high + slack)
            if outside.any():
                first = int(outside.argmax())
                yield Finding(
                    f"{log.at(first)}: {name} is {values[first]:.4g}, outside "
                    f"{low:g} to {high:g} of {setting}_low and {setting}_high"
                    f"{more(outside)}",
                    refused,
                )
                break
