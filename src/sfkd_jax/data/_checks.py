"""Check recorded runs row by row and against their motion; cut them where asked."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sfkd_jax.data._logs import (
    FEWEST,
    LOOK,
    Chords,
    Columns,
    Delay,
    Log,
    agreement,
    find_chords,
    find_delay,
)
from sfkd_jax.data._tables import DROP

Bounds: TypeAlias = tuple[tuple[float, ...] | None, tuple[float, ...] | None]
"""Lowest and highest of every channel, or None where there is no bound."""
Jumps: TypeAlias = tuple[Bool[np.ndarray, " step"], Callable[[int], str]]
SHORTEST = 3
"""Rows that a run needs to be checked at all."""
SLOWER = 1.2
"""A log whose period is this many times the model's is refused: rows between its own
would be invented.
"""
LARGEST = 1e38
"""Largest number whose differences float32, which segments are stored in, can hold."""
STALE = 0.2
"""Share of driving rows that repeat the position of the row before, from which
positions count as stale.
"""
COARSEST = 0.02
"""Resolution of positions up to which a log is used [m]."""
AGREE = (0.8, 1.25)
"""Path length over integrated speed of a plausible log."""
DEGREES = 9e-6
"""Degrees of latitude in a metre."""
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
    (DEGREES, "positions are probably degrees of latitude and longitude"),
    (57.29578, "the speed is probably an angular rate, or columns changed places"),
)
LATE = 1.5
"""Steps by which positions or yaw may be late: a model knows the last state alone."""
CUT_THERE = "; the run is cut there"


class Finding(NamedTuple):
    """One line about a log, and whether the log is refused for it."""

    line: str
    refused: bool = True


def warning(line: str) -> Finding:
    """A line for which the log is not refused."""
    return Finding(line, refused=False)


@dataclass(frozen=True)
class Checks:
    """What recorded runs are checked against: the arguments of `from_logs`."""

    columns: Columns
    dt: float
    steps: int
    wheelbase: float
    gap: float
    min_speed: float
    split_at_jumps: bool
    drop_missing: bool
    limits: Bounds
    box: Bounds

    def apply(self, logs: list[Log]) -> tuple[list[Log], list[Finding]]:
        """Return the runs that can be used, after cutting, and all findings."""
        sound: list[Log] = []
        findings: list[Finding] = []
        for recorded in logs:
            log, found = self._one(recorded)
            findings += found
            if not any(one.refused for one in found) and _has_rows(log):
                sound.append(log)
        return sound, findings

    def _one(self, log: Log) -> tuple[Log, list[Finding]]:
        """A run after cutting, and the findings about it alone."""
        log, found = self._drop_rows(log)
        wrong: list[Finding] = []
        for name, values in log.channels(self.columns).items():
            bad = ~np.isfinite(values) | (np.abs(values) > LARGEST)
            wrong += _first(
                log,
                bad,
                lambda k, n=name, v=values: (
                    f"{n} is {v[k]}{DROP * bool(np.isnan(v[k]))}"
                ),
            )
        # A NaN jumps nowhere: it must be refused, not cut out.
        if self.split_at_jumps and not wrong:
            log, cuts = self._cut_at_jumps(log)
            found += cuts
        several = "; two runs in one file? dataset.columns.run, dataset.split_at_jumps"
        wrong += self._time(log, several)
        found += wrong
        if wrong or not len(log.time):
            return log, found
        edges = np.flatnonzero(~log.joined) + 1
        longest = max(float(np.ptp(part)) for part in np.split(log.time, edges))
        if longest < (self.steps - 1e-3) * self.dt:
            needed = f"a segment is {self.steps * self.dt:.4g} s; not used"
            found.append(warning(f"{log.whole}: only {longest:.4g} s, {needed}"))
        if not _has_rows(log):
            return log, found
        found += (units := list(self._units(log)))
        # Wrong units make every step look like a jump.
        if not any(one.refused for one in units):
            found += self._sampling(log)
            found += self._motion(log)
            found += self._delays(log)
        return log, found

    def _drop_rows(self, log: Log) -> tuple[Log, list[Finding]]:
        """Drop rows that lack a number, if asked, and slow ones; cut the run there."""
        found: list[Finding] = []
        if self.drop_missing:
            named = log.channels(self.columns)
            missing = np.isnan(np.column_stack([*named.values()]))
            rows: Bool[np.ndarray, " time"] = np.any(missing, axis=1)
            found += _first(
                log,
                rows,
                lambda k: f"{[*named][int(missing[k].argmax())]} is nan",
                hint=f", {100 * rows.mean():.2g} % of the rows, dropped by "
                f"dataset.missing=drop{CUT_THERE}",
                refused=False,
            )
            log = log.select(~rows)
        speed = log.states[:, 3]
        name = self.columns.state[3]
        slow = np.abs(speed) < self.min_speed
        found += _first(
            log,
            slow,
            lambda k: f"{name} is {speed[k]:.3g} m/s",
            hint=f", dropped by dataset.min_speed={self.min_speed:g}{CUT_THERE}",
            refused=False,
        )
        return log.select(~slow), found

    def _cut_at_jumps(self, log: Log) -> tuple[Log, list[Finding]]:
        """Cut a run where time goes back and where position or yaw jump.

        Stale positions jump at every update: such a run is left as it is.
        """
        found = list(self._time(log, CUT_THERE, refused=False))
        log = log.cut(_backwards(log))
        if not log.joined.any() or _stale(log).any():
            return log, found
        for find in (self._position_jumps, self._yaw_jumps):
            if log.joined.any():  # else the cuts have left single rows
                jumps, text = find(log)
                found += _first(log, jumps, text, hint=CUT_THERE, refused=False)
                log = log.cut(jumps)
        return log, found

    def _time(self, log: Log, hint: str, *, refused: bool = True) -> Iterator[Finding]:
        """Time that repeats or goes back."""

        def text(k: int) -> str:
            before = log.time[k]
            after = log.time[k + 1]
            if before == after:
                return f"{self.columns.time} repeats {after:.12g}"
            return f"{self.columns.time} goes back from {before:.12g} to {after:.12g}"

        return _first(log, _backwards(log), text, hint=hint, refused=refused)

    def _sampling(self, log: Log) -> Iterator[Finding]:
        """Slow sampling, which is refused, gaps and uneven sampling."""
        waits = log.waits
        period = log.period
        gaps = log.gaps(self.gap, self.dt)
        if period > SLOWER * self.dt:
            yield Finding(
                f"{log.whole}: recorded every {period:.4g} s, slower than "
                f"vehicle.dt={self.dt:g}; pass vehicle.dt={period:.2g}"
            )
        yield from _first(
            log,
            gaps,
            lambda k: f"{waits[k]:.4g} s without rows; runs are split there",
            refused=False,
        )
        # A few uneven steps are usual; a gap has been reported already.
        uneven = (np.abs(waits - period) > 0.5 * period) & ~gaps & log.joined
        if uneven.mean() > 0.1:
            yield from _first(
                log,
                uneven,
                lambda k: f"uneven sampling, {waits[k]:.4g} s after the row before",
                refused=False,
            )

    def _motion(self, log: Log) -> Iterator[Finding]:
        """Stale positions, else rounded ones, else jumps of position and yaw."""
        if (stale := _stale(log)).any():
            speed = log.states[1:, 3]
            advice = "; log positions as often as "
            yield from _first(
                log,
                stale,
                lambda k: f"the position of the row before at {speed[k]:.3g} m/s",
                hint=f"{advice}{self.columns.time}, or leave rows out",
            )
        elif rounded := list(self._rounded(log)):
            yield from rounded
        else:
            for find in (self._position_jumps, self._yaw_jumps):
                yield from _first(log, *find(log))

    def _rounded(self, log: Log) -> Iterator[Finding]:
        """Axes with few values, as float32 has far from the origin."""
        speed, yaw = (log.states[:, k] for k in (3, 2))
        driven = (0.5 * (speed[1:] + speed[:-1]) * log.waits)[log.joined]
        for axis, part in enumerate((np.cos, np.sin)):
            places = log.states[:, axis]
            along = driven * part(yaw[1:][log.joined])
            reach = float(np.ptp(np.cumsum(along)))
            # Of a metre, not of the way: a car takes every value of a grid only once.
            count = len(np.unique(np.round(places % 1.0, 6) % 1.0))
            off = float(np.std(np.diff(places)[log.joined] - along))
            # A simulated car may move in whole metres, and is where its speed says.
            few = count < min(1.0 / COARSEST, len(along) / 3)
            if few and reach > 1.0 and off * count > 0.2:
                yield Finding(
                    f"{log.whole}: {self.columns.state[axis]} has a resolution of "
                    f"{1 / count:.2g} m; log positions as float64, or near the origin"
                )

    def _reversals(self, log: Log, chords: Chords) -> Iterator[Finding]:
        """A stretch in reverse at a speed without a sign, among others ahead."""
        off = np.abs(np.angle(np.exp(1j * (chords.course - chords.yaw))))
        opposite = np.zeros(len(log.time), dtype=bool)
        opposite[chords.middle[off > np.pi - 0.5]] = True
        # A single jump turns as many chords as there are over it.
        least = round(2 * LOOK / log.period)
        edges = np.flatnonzero(np.diff(opposite)) + 1
        for rows in np.split(np.arange(len(opposite)), edges):
            if opposite[rows[0]] and len(rows) > least and (off < 0.5).sum() > least:
                yield Finding(
                    f"{log.between(int(rows[0]), int(rows[-1]))}: the robot moves "
                    f"against the sign of {self.columns.state[3]}{more(opposite)}; "
                    "it is negative where the robot reverses"
                )
                return

    def _delays(self, log: Log) -> Iterator[Finding]:
        """Positions and yaw that are late against speed, yaw rate and course."""
        if not log.joined.any() or _stale(log).any():
            return
        x, y, yaw, speed = self.columns.state[:4]
        parts = log.parts(self.gap, self.dt)
        yaws = np.unwrap(log.states[:, 2])

        def delay(*columns: Float[np.ndarray, "time ..."]) -> Delay:
            table = np.column_stack([log.time, *columns])
            return find_delay(table[rows] for rows in parts)

        found = {
            (f"{x}, {y}", speed): delay(log.states[:, :2], log.states[:, 3]),
            (yaw, "the direction of travel"): self._behind_course(log),
        }
        for k, name in enumerate(self.columns.state[4:], start=4):
            rated = delay(yaws, log.states[:, k])
            # Whatever else its unit, this column is the yaw rate.
            if rated.alike > 0.95 and 0.8 < abs(rated.gain) < 1.25:
                found[yaw, name] = rated
        for (late, early), one in found.items():
            size = max(0.9 * log.period, 0.1 * self.dt)
            if one.certain and one.alike > 0.7 and abs(one.lag) >= size:
                yield Finding(
                    f"{log.whole}: {one.line(late, early, self.dt)}",
                    refused=abs(one.lag) >= LATE * self.dt,
                )

    def _behind_course(self, log: Log) -> Delay:
        """How late yaw is, of how its angle to the course follows the yaw rate.

        A position ahead of the rear axle turns the course by its distance times yaw
        rate over speed. That distance is fitted too, about half a wheelbase.
        """
        chords = find_chords(log, log.states[:, 3])
        speed = log.states[chords.middle, 3]
        count = len(speed) * log.period / LOOK
        if count < 0.5 * FEWEST or not speed.all() or np.std(chords.turn) < 1e-3:
            return Delay()
        off = chords.course - chords.yaw
        off = np.angle(np.exp(1j * (off - np.angle(agreement(off)))))
        causes = np.column_stack([np.ones_like(off), chords.turn, chords.turn / speed])
        rest = off - causes @ np.linalg.lstsq(causes, off, rcond=None)[0]
        # Neighbouring chords overlap: as many count as fit one after another.
        weight = count / len(off) / max(float(np.mean(rest**2)), 1e-12)
        prior = np.array([1e-9, 1e-9, 16.0 / self.wheelbase**2])
        inverse = np.linalg.inv(weight * causes.T @ causes + np.diag(prior))
        mean = inverse @ (weight * causes.T @ off + prior * 0.5 * self.wheelbase)
        lag = float(mean[1])
        spread = float(np.sqrt(inverse[1, 1]))
        alike = np.sqrt(max(0.0, 1.0 - np.mean(rest**2) / max(np.var(off), 1e-12)))
        # Tyres that slip make yaw look early.
        return Delay(lag, float(alike), certain=lag > 5.0 * spread)

    def _position_jumps(self, log: Log) -> Jumps:
        """Steps much longer than the speed explains."""
        excess = log.moved - log.integrated
        # By the median: the jumps themselves must not widen what is usual.
        spread = 1.4826 * np.median(np.abs(excess)[log.joined])
        jumps = excess > log.integrated + 15.0 * spread + 1e-6
        x, y = self.columns.state[:2]
        return (
            jumps & ~log.gaps(self.gap, self.dt) & log.joined,
            lambda k: (
                f"{x}, {y} jump {log.moved[k]:.3g} m at {log.states[k, 3]:.3g} m/s"
            ),
        )

    def _yaw_jumps(self, log: Log) -> Jumps:
        """Steps that turn much more than the others, between rows near in time."""
        turned = np.abs(np.diff(np.unwrap(log.states[:, 2])))
        # Small robots turn fast: only what stands out of their own turns is a jump.
        jumps = turned > max(1.0, 10.0 * float(np.median(turned[log.joined])))
        return (
            jumps & ~log.gaps(self.gap, self.dt) & log.joined,
            lambda k: f"{self.columns.state[2]} jumps by {turned[k]:.3g} rad",
        )

    def _units(self, log: Log) -> Iterator[Finding]:
        """The speed against positions, then yaw against the direction of travel."""
        speed = self.columns.state[3]
        chords = find_chords(log, log.states[:, 3])
        moved = chords.length.sum()
        integrated = np.abs(chords.integrated).sum()
        if moved == 0.0 and integrated == 0.0:
            yield warning(f"{log.whole}: neither position nor {speed} ever moves")
        elif moved == 0.0 or integrated == 0.0:
            names = ("the position", speed)
            still, goes = names if moved == 0.0 else names[::-1]
            yield Finding(
                f"{log.whole}: {still} stands still while {goes} moves; "
                "have columns changed places?"
            )
        elif not AGREE[0] <= (ratio := moved / integrated) <= AGREE[1]:
            yield Finding(
                f"{log.whole}: positions move {ratio:.3g} times as fast as "
                f"{speed}; {self._cause(log, ratio)}"
            )
        else:
            yield from self._heading(log, chords)

    def _cause(self, log: Log, ratio: float) -> str:
        """A unit that explains a factor, else a column that fits as the speed."""
        nearest, text = min(FACTORS, key=lambda one: abs(math.log(ratio / one[0])))
        # A degree of longitude is shorter than one of latitude.
        tolerance = 0.5 if nearest == DEGREES else 0.1
        if abs(math.log(ratio / nearest)) < tolerance:
            return text
        for name, values in log.channels(self.columns).items():
            chords = find_chords(log, values)
            integrated = np.abs(chords.integrated).sum()
            if (
                name not in (self.columns.time, *self.columns.state[:2])
                and 0.9 * integrated <= chords.length.sum() <= 1.1 * integrated
            ):
                return f"{name} fits as the speed: have columns changed places?"
        return "wrong units, or columns changed places?"

    def _heading(self, log: Log, chords: Chords) -> Iterator[Finding]:
        """Yaw against the direction of travel, with a likely cause."""
        x, y, name, speed = self.columns.state[:4]
        yaw = chords.yaw
        agreed = agreement(chords.course - yaw)
        reverses = list(self._reversals(log, chords))
        if abs(agreed) > 0.7 and abs(np.angle(agreed)) < 0.5:
            yield from reverses
            return
        compass = f"{name} is probably a compass heading"
        # What yaw may be instead, and the yaw that follows.
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
        # A mean over the whole run: single wrong rows change no reading.
        fit, best = max(
            (agreement(chords.course - read).real, text)
            for text, read in readings.items()
        )
        off = f"{log.whole}: {name} and the direction of travel differ"
        if fit > 0.9:
            yield Finding(f"{off}; {best}")
        elif reverses:
            yield from reverses
        elif abs(agreed) > 0.7:
            yield warning(
                f"{off} by {np.angle(agreed):.2f} rad throughout; "
                "is the sensor mounted askew?"
            )
        else:
            yield warning(
                f"{off} at random; a robot that drives sideways, "
                "or columns that changed places?"
            )


def _has_rows(log: Log) -> bool:
    """Whether there are steps to check."""
    return len(log.time) >= SHORTEST and bool(log.joined.any())


def _first(
    log: Log,
    bad: Bool[np.ndarray, " row"],
    text: Callable[[int], str],
    *,
    hint: str = "",
    refused: bool = True,
) -> Iterator[Finding]:
    """One line about the first of some rows or steps, and how many there are.

    `bad` is one per row, or one per step, which is named by the row after it.
    """
    if bad.any():
        k = int(bad.argmax())
        row = k + len(log.time) - len(bad)
        yield Finding(f"{log.at(row)}: {text(k)}{more(bad)}{hint}", refused)


def more(bad: Bool[np.ndarray, " row"]) -> str:
    """How many rows there are like the first."""
    return f" ({bad.sum()} rows like this)" if bad.sum() > 1 else ""


def _backwards(log: Log) -> Bool[np.ndarray, " step"]:
    """The steps at which time repeats or goes back."""
    return (log.waits <= 0) & log.joined


def _stale(log: Log) -> Bool[np.ndarray, " step"]:
    """Steps without motion while driving; none if they are few."""
    usual = np.quantile(log.integrated[log.joined], 0.9)
    # At standstill positions repeat rightly.
    driving = (log.integrated > 0.1 * usual) & log.joined
    stale = driving & (log.moved == 0.0)
    return stale & (stale.sum() > STALE * max(driving.sum(), 1))
