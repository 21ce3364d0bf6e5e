"""Motion of a recorded run over short chords, and how late one signal is after another.

A chord is the straight line between two positions about `CHORD` apart in time.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sfkd_jax.driving.logs._logs import Log

CHORD = 0.5
"""Duration of the chords over which motion is compared with other columns [s]."""
LARGEST_LAG = 1.0
"""Largest delay that is looked for [s]."""
LAGS = 401
"""Number of delays that are tried, from −`LARGEST_LAG` to `LARGEST_LAG`."""
ZERO_LAG = LAGS // 2
"""Index of the delay 0."""
FEWEST_CHORDS = 20
"""Number of chords that an estimate of a delay needs."""
CERTAIN = 10.0
"""Log-likelihood ratio from which on one of two delays is no matter of chance."""
QUANTILE = 1.92
"""Half of the 95 % quantile of χ² with one degree of freedom."""


class Chords(NamedTuple):
    """The chords of a run along which it moves.

    Attributes:
        length: of the chord [m].
        integrated: ∫ v dt [m].
        course: direction of the chord, reversed where v < 0 [rad].
        yaw: in the middle of the chord [rad].
        turn: yaw rate along the chord [rad/s].
        middle: index of the row in the middle.
    """

    length: Float[np.ndarray, " chord"]
    integrated: Float[np.ndarray, " chord"]
    course: Float[np.ndarray, " chord"]
    yaw: Float[np.ndarray, " chord"]
    turn: Float[np.ndarray, " chord"]
    middle: Int[np.ndarray, " chord"]


def find_chords(log: Log, speed: Float[np.ndarray, " time"]) -> Chords:
    """Return the chords along which a run moves, by its positions or by a speed.

    Args:
        log: the run.
        speed: of every row [m/s].
    """
    reach = min(max(1, round(CHORD / log.period)), len(log.time) - 1)
    along = np.cumsum(0.5 * (speed[1:] + speed[:-1]) * log.waits)
    along = np.concatenate([[0.0], along])
    chord = log.states[reach:, :2] - log.states[:-reach, :2]
    length = np.linalg.norm(chord, axis=1)
    integrated = along[reach:] - along[:-reach]
    duration = log.time[reach:] - log.time[:-reach]
    # A chord across a gap or a cut says nothing about the speed.
    whole = duration < 1.5 * reach * log.period
    whole &= log.stretch[reach:] == log.stretch[:-reach]
    # At standstill noise moves the position, and the course would be random.
    moving = np.zeros_like(whole)
    for distance in (length, np.abs(integrated)):
        moving |= distance > 0.2 * np.max(distance, where=whole, initial=0.0)
    moving &= whole
    course = np.arctan2(chord[:, 1], chord[:, 0]) + np.pi * (integrated < 0)
    yaw = np.unwrap(log.states[:, 2])
    first = np.flatnonzero(moving)
    # A chord of an odd number of steps has two rows next to its middle.
    middle = first + reach // 2
    after_middle = first + (reach + 1) // 2
    return Chords(
        length=length[moving],
        integrated=integrated[moving],
        course=course[moving],
        yaw=0.5 * (yaw[middle] + yaw[after_middle]),
        turn=(yaw[first + reach] - yaw[first]) / duration[moving],
        middle=middle,
    )


class Delay(NamedTuple):
    """How much later a motion comes than the rate that should be its derivative.

    Attributes:
        lag: delay at which they agree best [s]; negative if the motion comes first.
        alike: absolute correlation at that delay.
        gain: of the motion over the integrated rate.
        certain: whether a delay of zero agrees worse, beyond chance.
    """

    lag: float = 0.0
    alike: float = 0.0
    gain: float = 0.0
    certain: bool = False

    def line(self, late: str, early: str, dt: float) -> str:
        """Return a line about the delay, for messages.

        Args:
            late: name of the motion.
            early: name of the rate.
            dt: period of the model [s].
        """
        return (
            f"the lag of {late} behind {early} is {self.lag:.2g} s "
            f"({self.lag / dt:.2g} steps of vehicle.dt); shift one of them in time"
        )


class Profile(NamedTuple):
    """How well a motion agrees with a rate that is delayed, by every delay.

    The delays are `LAGS` between −`LARGEST_LAG` and `LARGEST_LAG`.

    Attributes:
        count: number of chords.
        gains: of the motion over the integrated rate.
        fit: squared correlation of both.
    """

    count: int
    gains: Float[np.ndarray, " lag"]
    fit: Float[np.ndarray, " lag"]

    @property
    def best(self) -> int:
        """Index of the delay at which both agree best."""
        return int(self.fit.argmax())

    def evidence(self, fit: Float[np.ndarray, "*lag"]) -> Float[np.ndarray, "*lag"]:
        """Return the log-likelihood ratio of the best delay to one with another fit."""
        # Half the count times the log of the ratio of residuals is a log-likelihood
        # ratio. A quarter, because every other chord overlaps its neighbours.
        ratio = (1.0 - fit + 1e-9) / (1.0 - self.fit[self.best] + 1e-9)
        return np.asarray(0.25 * self.count * np.log(ratio))

    def interval(self) -> tuple[float, float, float] | None:
        """Return the delay [s] and the ends of its 95 % confidence interval [s].

        The interval has all delays whose likelihood ratio to the best one is within
        χ²_{0.95}(1) / 2. Between the delays that were tried, the best one is at the
        vertex of a parabola, and the ends are interpolated linearly. None if motion and
        rate have nothing in common beyond chance, or if a delay at the end of the range
        may be right.
        """
        worse = self.evidence(self.fit)
        middle = self.best
        if self.evidence(np.zeros(())) < CERTAIN or middle in (0, LAGS - 1):
            return None
        before, here, after = worse[middle - 1 : middle + 2]
        bend = max(0.5 * (before - 2.0 * here + after), 1e-12)
        vertex = np.clip(0.25 * (before - after) / bend, -0.5, 0.5)
        worse = worse - (here - bend * vertex**2)
        likely = np.flatnonzero(worse < QUANTILE)
        if not likely.size:
            likely = np.array([middle])
        first = int(likely[0])
        last = int(likely[-1])
        if first == 0 or last == LAGS - 1:
            return None
        step = 2.0 * LARGEST_LAG / (LAGS - 1)
        outside = (first - 1, last + 1)
        ends = []
        for inner, outer in zip((first, last), outside, strict=True):
            rise = max(worse[outer] - worse[inner], 1e-12)
            share = (QUANTILE - worse[inner]) / rise
            ends.append(inner + np.clip(share, 0.0, 1.0) * (outer - inner))
        delay, low, high = (step * (at - ZERO_LAG) for at in (middle + vertex, *ends))
        return float(delay), float(min(low, delay)), float(max(high, delay))


def find_profile(
    tables: Iterable[Float[np.ndarray, "_ column"]], *, held: bool = False
) -> Profile | None:
    """Correlate a motion with a rate over chords, at every delay.

    The arguments are those of `find_delay`. None if there are too few chords or nothing
    moves.
    """
    motion, expected = _over_chords(tables, held)
    count = len(motion)
    if count < FEWEST_CHORDS:
        return None
    motion = motion - motion.mean()
    expected = expected - expected.mean(axis=1, keepdims=True)
    power = np.sum(expected**2, axis=1)
    if not (motion.any() and power.min() > 0.0):
        return None
    gains = expected @ motion / power
    return Profile(count, gains, gains**2 * power / np.sum(motion**2))


def find_delay(
    tables: Iterable[Float[np.ndarray, "_ column"]], *, held: bool = False
) -> Delay:
    """Find the delay of a motion behind a rate by their correlation over chords.

    Args:
        tables: of uninterrupted stretches, each with the columns time [s], motion and
            rate. A motion of two columns is a position, and its rate is a speed.
        held: whether the rate of a row holds until the next row, as a command does.
            Otherwise it is interpolated linearly.

    Returns:
        The delay, or an empty `Delay` if there are too few chords or nothing moves.
    """
    profile = find_profile(tables, held=held)
    if profile is None:
        return Delay()
    best = profile.best
    lags = np.linspace(-LARGEST_LAG, LARGEST_LAG, LAGS)
    return Delay(
        lag=float(lags[best]),
        alike=float(np.sqrt(profile.fit[best])),
        gain=float(profile.gains[best]),
        certain=bool(profile.evidence(profile.fit)[ZERO_LAG] > CERTAIN),
    )


def _over_chords(
    tables: Iterable[Float[np.ndarray, "_ column"]], held: bool
) -> tuple[Float[np.ndarray, " chord"], Float[np.ndarray, "lag chord"]]:
    """Return the motion over chords, and the integral of the rate at every delay.

    The arguments are those of `find_delay`. Chords begin half a chord apart.
    """
    lags = np.linspace(-LARGEST_LAG, LARGEST_LAG, LAGS)
    motions = [np.zeros(0)]
    integrals = [np.zeros((LAGS, 0))]
    for time, *moved, rate in (table.T for table in tables):
        between_rows = rate[:-1] if held else 0.5 * (rate[1:] + rate[:-1])
        integral = np.append(0.0, np.cumsum(between_rows * np.diff(time)))
        starts = np.arange(
            time[0] + LARGEST_LAG, time[-1] - LARGEST_LAG - CHORD, 0.5 * CHORD
        )
        ends = np.stack([starts, starts + CHORD])
        delayed = np.interp(ends[:, None] - lags[:, None], time, integral)
        integrals.append(np.diff(delayed, axis=0)[0])
        chords = [
            np.diff(np.interp(ends, time, channel), axis=0)[0] for channel in moved
        ]
        if len(chords) > 1:
            # The length of a chord has no sign, and takes that of the speed.
            sign = np.sign(integrals[-1][ZERO_LAG])
            chords = [sign * np.hypot(*chords)]
        motions += chords
    return np.concatenate(motions), np.concatenate(integrals, axis=1)


def agreement(angles: Float[np.ndarray, " chord"]) -> complex:
    """Return the mean of exp(i φ).

    Its length says how well the angles φ agree, its angle is their mean.
    """
    return complex(np.mean(np.exp(1j * angles)))
