"""Check units and signs of a recorded run by its motion.

The speed is compared with the positions, and the yaw with the direction of travel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from sfkd_jax.driving.logs._findings import Finding, more, warning
from sfkd_jax.driving.logs._logs import Columns, Log
from sfkd_jax.driving.logs._motion import CHORD, Chords, agreement, find_chords

PLAUSIBLE_RATIO = (0.8, 1.25)
"""Range of path length over integrated speed of a plausible log."""
LEAST_TURN = 0.1
"""Standard deviation of the yaw from which on its size is checked [rad]."""
DEGREES = 9e-6
"""Degrees of latitude in a metre."""
CAUSES_OF_RATIO = (
    (1 / 3.6, "the speed is probably in km/h"),
    (0.44704, "the speed is probably in miles per hour"),
    (0.3048, "the speed is probably in feet per second"),
    (3.28084, "positions are probably in feet"),
    (1e2, "positions are probably in cm"),
    (1e3, "positions are probably in mm"),
    (1e-3, "time is probably in ms, or positions in km"),
    (1e-6, "time is probably in µs"),
    (1e-9, "time is probably in ns"),
    (DEGREES, "positions are probably degrees of latitude and longitude"),
    (57.29578, "the speed is probably an angular rate, or columns changed places"),
)
"""Ratios of path length over integrated speed, and the units that cause them."""


def check_units(log: Log, columns: Columns) -> Iterator[Finding]:
    """Check the speed against the positions, then yaw against the course."""
    speed = columns.state[3]
    chords = find_chords(log, log.states[:, 3])
    length = chords.length.sum()
    integrated = np.abs(chords.integrated).sum()
    if length == 0.0 and integrated == 0.0:
        yield warning(f"{log.whole}: neither position nor {speed} ever moves")
    elif length == 0.0:
        yield _stands_still(log, "the position", speed)
    elif integrated == 0.0:
        yield _stands_still(log, speed, "the position")
    elif not PLAUSIBLE_RATIO[0] <= length / integrated <= PLAUSIBLE_RATIO[1]:
        ratio = length / integrated
        yield Finding(
            f"{log.whole}: positions move {ratio:.3g} times as fast as "
            f"{speed}; {_cause_of_ratio(log, columns, ratio)}"
        )
    else:
        yield from _check_heading(log, columns, chords)


def _stands_still(log: Log, standing: str, moving: str) -> Finding:
    """Return the finding that of position and speed only one moves."""
    return Finding(
        f"{log.whole}: {standing} stands still while {moving} moves; "
        "have columns changed places?"
    )


def _cause_of_ratio(log: Log, columns: Columns, ratio: float) -> str:
    """Return a unit that explains the ratio, or a column that fits as the speed."""
    nearest, text = min(
        CAUSES_OF_RATIO, key=lambda cause: abs(math.log(ratio / cause[0]))
    )
    # A degree of longitude is shorter than one of latitude.
    tolerance = 0.5 if nearest == DEGREES else 0.1
    if abs(math.log(ratio / nearest)) < tolerance:
        return text
    for name, values in log.channels(columns).items():
        if name in (columns.time, *columns.state[:2]):
            continue
        chords = find_chords(log, values)
        integrated = np.abs(chords.integrated).sum()
        if 0.9 * integrated <= chords.length.sum() <= 1.1 * integrated:
            return f"{name} fits as the speed: have columns changed places?"
    return "wrong units, or columns changed places?"


def _check_heading(log: Log, columns: Columns, chords: Chords) -> Iterator[Finding]:
    """Check yaw against the direction of travel, and name a likely cause."""
    x, y, name, speed = columns.state[:4]
    yaw = chords.yaw
    agreed = agreement(chords.course - yaw)
    reversals = list(_reversals(log, columns, chords))
    if abs(agreed) > 0.7 and abs(np.angle(agreed)) < 0.5:
        yield from reversals
        if not reversals:
            yield from _check_size(log, columns, chords)
        return
    compass = f"{name} is probably a compass heading"
    # What the column may hold instead, and the yaw that would follow from it.
    readings = {
        f"{name} is probably in degrees": np.deg2rad(yaw),
        f"{name} probably counts clockwise": -yaw,
        f"{compass} (from north, clockwise), or {x} and {y} changed places": (
            0.5 * np.pi - yaw
        ),
        f"{compass} in degrees": 0.5 * np.pi - np.deg2rad(yaw),
        f"{name} probably counts from the y axis": yaw + 0.5 * np.pi,
        f"{speed} is probably of the wrong sign, or the robot drives backwards": (
            yaw + np.pi
        ),
    }
    # The mean over the whole run decides, so that single wrong rows change nothing.
    fit, best = max(
        (agreement(chords.course - reading).real, text)
        for text, reading in readings.items()
    )
    difference = f"{log.whole}: {name} and the direction of travel differ"
    if fit > 0.9:
        yield Finding(f"{difference}; {best}")
    elif reversals:
        yield from reversals
    elif abs(agreed) > 0.7:
        yield warning(
            f"{difference} by {np.angle(agreed):.2f} rad throughout; "
            "is the sensor mounted askew?"
        )
    else:
        yield warning(
            f"{difference} at random; a robot that drives sideways, "
            "or columns that changed places?"
        )


def _check_size(log: Log, columns: Columns, chords: Chords) -> Iterator[Finding]:
    """Compare how much the direction of travel turns with how much yaw does."""
    yaw = chords.yaw - chords.yaw.mean()
    if np.std(yaw) < LEAST_TURN:
        return
    off = chords.course - chords.yaw
    off = np.angle(np.exp(1j * (off - np.angle(agreement(off)))))
    gain = 1.0 + float(np.mean(off * yaw) / np.mean(yaw**2))
    rest = np.std(off - (gain - 1.0) * yaw)
    # Tyres that slip put the course beside the yaw, but not in proportion to it.
    if rest > 0.3 * np.std(yaw) or PLAUSIBLE_RATIO[0] < gain < PLAUSIBLE_RATIO[1]:
        return
    name = columns.state[2]
    yield Finding(
        f"{log.whole}: the direction of travel turns {gain:.3g} times as much as "
        f"{name}; has {name} another unit or scale?"
    )


def _reversals(log: Log, columns: Columns, chords: Chords) -> Iterator[Finding]:
    """Find the first stretch that is driven in reverse at a positive speed.

    There must be stretches ahead too; otherwise yaw or the sign of the speed is wrong
    throughout.
    """
    off = np.abs(np.angle(np.exp(1j * (chords.course - chords.yaw))))
    opposite = np.zeros(len(log.time), dtype=bool)
    opposite[chords.middle[off > np.pi - 0.5]] = True
    # A single jump of the position turns all chords over it, as many as a chord has
    # rows. A stretch has to be longer than twice that.
    least = round(2 * CHORD / log.period)
    edges = np.flatnonzero(np.diff(opposite)) + 1
    for rows in np.split(np.arange(len(opposite)), edges):
        if opposite[rows[0]] and len(rows) > least and (off < 0.5).sum() > least:
            yield Finding(
                f"{log.between(int(rows[0]), int(rows[-1]))}: the robot moves "
                f"against the sign of {columns.state[3]}{more(opposite)}; "
                "it is negative where the robot reverses"
            )
            return
