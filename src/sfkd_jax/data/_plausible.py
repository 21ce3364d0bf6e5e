"""Check units, axes and the order of columns against the motion of a drive."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sfkd_jax.data._checks import Finding, channels
from sfkd_jax.data._logs import Columns, Log
from sfkd_jax.data._ranges import span

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
