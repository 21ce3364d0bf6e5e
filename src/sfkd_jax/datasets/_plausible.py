"""Whether the columns of a drive mean what they are said to mean: units, axes, and columns that changed places."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.datasets._checks import Finding, channels
from sfkd_jax.datasets._logs import Columns, Log
from sfkd_jax.datasets._ranges import span

LOOK = 0.5
"""Length of the stretches over which motion is compared with what the columns say [s]."""
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


class Stretches(NamedTuple):
    """A drive seen in stretches of about `LOOK`, those that moved.

    Attributes:
        travelled: chord [m].
        said: ∫ v dt [m].
        course: direction of the chord, backwards where v < 0 [rad].
        middle: index of the row in the middle.
    """

    travelled: Float[np.ndarray, " stretch"]
    said: Float[np.ndarray, " stretch"]
    course: Float[np.ndarray, " stretch"]
    middle: np.ndarray


def check_units(log: Log, columns: Columns) -> Iterator[Finding]:
    """Speed against positions, then yaw against the direction of travel."""
    seen = _stretches(log, log.states[:, 3])
    moved, said = seen.travelled.sum(), np.abs(seen.said).sum()
    if moved == 0.0 and said == 0.0:
        yield Finding(
            f"{log.whole}: neither position nor {columns.state[3]} ever moves",
            refused=False,
        )
        return
    if moved == 0.0 or said == 0.0:
        still, goes = (
            ("the position", columns.state[3])
            if moved == 0.0
            else (columns.state[3], "the position")
        )
        yield Finding(
            f"{log.whole}: {still} stands still while {goes} moves; have columns changed places?"
        )
        return
    ratio = moved / said
    if not AGREE[0] <= ratio <= AGREE[1]:
        says = f"positions move {ratio:.3g} times as fast as {columns.state[3]} says"
        yield Finding(f"{log.whole}: {says}; {_cause(log, columns, ratio)}")
        return
    yield from _check_heading(log, columns, seen)


def _stretches(log: Log, speed: Float[np.ndarray, " time"]) -> Stretches:
    """The stretches of a drive that moved, by position or by what a speed says."""
    waits = np.diff(log.time)
    period = float(np.median(waits))
    reach = min(max(1, round(LOOK / period)), len(log.time) - 1)
    along = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * waits)])
    chord = log.states[reach:, :2] - log.states[:-reach, :2]
    travelled, said = np.linalg.norm(chord, axis=1), along[reach:] - along[:-reach]
    whole = log.time[reach:] - log.time[:-reach] < 1.5 * reach * period  # no gap inside
    enough = [
        0.2 * np.max(np.abs(lengths), where=whole, initial=0.0)
        for lengths in (travelled, said)
    ]
    moving = whole & ((travelled > enough[0]) | (np.abs(said) > enough[1]))
    course = np.arctan2(chord[:, 1], chord[:, 0]) + np.pi * (said < 0)
    return Stretches(
        travelled[moving],
        said[moving],
        course[moving],
        np.flatnonzero(moving) + reach // 2,
    )


def _cause(log: Log, columns: Columns, ratio: float) -> str:
    """The unit that explains a factor, or the column that is the speed, or neither."""
    nearest, text = min(FACTORS, key=lambda factor: abs(math.log(ratio / factor[0])))
    tolerance = 0.5 if nearest == 9e-6 else 0.1
    if abs(math.log(ratio / nearest)) < tolerance:
        return text
    for name, values in channels(log, columns).items():
        seen = _stretches(log, values)
        said = np.abs(seen.said).sum()
        if (
            name not in (columns.time, *columns.state[:2])
            and 0.9 * said <= seen.travelled.sum() <= 1.1 * said
        ):
            return f"{name} fits as the speed: have columns changed places?"
    return "wrong units, or columns changed places?"


def _check_heading(log: Log, columns: Columns, seen: Stretches) -> Iterator[Finding]:
    """Yaw against the direction of travel; what would explain their difference is tried."""
    name, yaw = columns.state[2], log.states[seen.middle, 2]
    readings = {
        f"{name} is probably in degrees": np.deg2rad(yaw),
        f"{name} probably counts clockwise": -yaw,
        f"{name} is probably a compass heading (from north, clockwise), or {columns.state[0]} and {columns.state[1]} "
        "changed places": 0.5 * np.pi - yaw,
        f"{name} is probably a compass heading in degrees": 0.5 * np.pi
        - np.deg2rad(yaw),
        f"{name} probably counts from the y axis": yaw + 0.5 * np.pi,
        f"{columns.state[3]} is probably of the wrong sign, or the robot drives backwards": yaw
        + np.pi,
    }
    agreed = _agreement(seen.course - yaw)
    if abs(agreed) > 0.7 and abs(np.angle(agreed)) < 0.5:
        return
    best = max(readings, key=lambda text: _agreement(seen.course - readings[text]).real)
    off = f"{name} and the direction of travel differ"
    if _agreement(seen.course - readings[best]).real > 0.9:
        yield Finding(f"{log.whole}: {off}; {best}")
    elif abs(agreed) > 0.7:
        yield Finding(
            f"{log.whole}: {off} by {np.angle(agreed):.2f} rad throughout; is the sensor mounted askew?",
            False,
        )
    else:
        yield Finding(
            f"{log.whole}: {off} at random; a robot that drives sideways, or columns that changed places?",
            False,
        )


def _agreement(angles: Float[np.ndarray, " stretch"]) -> complex:
    """Mean of exp(i φ): its length says how well angles agree, its angle on what."""
    return complex(np.mean(np.exp(1j * angles)))


def check_steering(
    logs: list[Log], columns: Columns, *, wheelbase: float
) -> Iterator[Finding]:
    """Whether yaw turns as a bicycle's would, ω = v tan δ / L: warns of its sign, its unit and the wheelbase."""
    asked, turned = (
        np.concatenate(parts) for parts in zip(*map(_turns, logs), strict=True)
    )
    power = float(np.sqrt(np.mean(asked**2) * np.mean(turned**2)))
    if power == 0.0 or abs(alike := float(np.mean(asked * turned)) / power) < 0.6:
        return  # no angle of steering, or too little of it
    fits, name = float(np.mean(asked**2) / np.mean(asked * turned)), columns.control[0]
    where = span(logs)
    if alike < 0:
        yield Finding(
            f"{where}: the robot turns against {name}; a positive one should turn it left",
            refused=False,
        )
    elif not 0.6 < fits / wheelbase < 1.7:
        unit = f" or {name} is not in rad" if fits > 10 * wheelbase else ""
        says = f"{name} and yaw suggest a wheelbase of {fits:.3g} m, vehicle.wheelbase is {wheelbase:g}{unit}"
        yield Finding(f"{where}: {says}", refused=False)


def _turns(log: Log) -> tuple[Float[np.ndarray, " step"], Float[np.ndarray, " step"]]:
    """v tan δ and the yaw rate, row by row; an angle that is none is left as it is."""
    steering = log.controls[:-1, 0]
    angle = np.tan(steering) if np.abs(log.controls[:, 0]).max() < 1.4 else steering
    return log.states[:-1, 3] * angle, np.diff(np.unwrap(log.states[:, 2])) / np.diff(
        log.time
    )
