"""Check recorded runs row by row and against their motion; cut them where asked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from sfkd_jax.driving.logs._findings import Finding, first_of, warning
from sfkd_jax.driving.logs._logs import Columns, Log
from sfkd_jax.driving.logs._motion import (
    CHORD,
    FEWEST_CHORDS,
    Delay,
    agreement,
    find_chords,
    find_delay,
)
from sfkd_jax.driving.logs._tables import DROP
from sfkd_jax.driving.logs._unit_checks import check_units

Bounds: TypeAlias = tuple[tuple[float, ...] | None, tuple[float, ...] | None]
"""Lowest and highest value of every channel, or None where there is no bound."""
Jumps: TypeAlias = tuple[Bool[np.ndarray, " step"], Callable[[int], str]]
"""Which steps are jumps, and a function that describes the jump at an index."""
SHORTEST = 3
"""Number of rows that a run needs to be checked at all."""
SLOWER = 1.2
"""Ratio of the period of a log to that of the model, from which on the log is refused:
rows between its own would be invented.
"""
BURSTS = 0.5
"""Ratio of the median wait between rows to the mean of the shortest 95 %, below which
rows come in bursts.
"""
UNEVEN = 0.3
"""Share of the period by which a wait may differ from it."""
LARGEST = 1e38
"""Largest number that is accepted. Segments are stored in float32, which can hold
differences of such numbers.
"""
STALE = 0.2
"""Share of the steps of driving, above which repeated positions count as stale."""
COARSEST = 0.02
"""Resolution of positions up to which a log is used [m]."""
LATE = 1.5
"""Steps by which positions or yaw may be late. A model knows the last state alone, so
that it cannot make up for more.
"""
CUT_THERE = "; the run is cut there"


@dataclass(frozen=True)
class Checks:
    """Checks of recorded runs; the attributes are arguments of `from_logs`."""

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
    roles: tuple[str, ...] = ()

    def apply(self, logs: list[Log]) -> tuple[list[Log], list[Finding]]:
        """Return the runs that can be used, after cutting, and all findings."""
        usable: list[Log] = []
        findings: list[Finding] = []
        for recorded in logs:
            log, findings_of_log = self._check(recorded)
            findings += findings_of_log
            if not _any_refused(findings_of_log) and _has_steps(log):
                usable.append(log)
        return usable, findings

    def _check(self, log: Log) -> tuple[Log, list[Finding]]:
        """Return a run after cutting, and the findings about it alone.

        Later checks presuppose what earlier ones have found to be in order.
        """
        log, findings = self._drop_rows(log)
        refusals = self._numbers(log)
        # Runs are not cut before all numbers are finite: a NaN must be refused, and it
        # would never look like a jump.
        if self.split_at_jumps and not refusals:
            log, cuts = self._cut_at_jumps(log)
            findings += cuts
        several = "; two runs in one file? dataset.columns.run, dataset.split_at_jumps"
        refusals += self._time(log, several)
        findings += refusals
        if refusals or not len(log.time):
            return log, findings
        findings += self._duration(log)
        if not _has_steps(log):
            return log, findings
        # Without the times of the measurements no motion can be compared.
        bursts = list(self._bursts(log))
        if bursts:
            return log, findings + bursts
        unit_findings = list(check_units(log, self.columns))
        findings += unit_findings
        # With wrong units every step would look like a jump.
        if not _any_refused(unit_findings):
            findings += self._sampling(log)
            findings += self._motion(log)
            findings += self._delays(log)
        return log, findings

    def _drop_rows(self, log: Log) -> tuple[Log, list[Finding]]:
        """Leave out slow rows and, if asked, those that lack a number."""
        findings: list[Finding] = []
        if self.drop_missing:
            channels = log.channels(self.columns)
            names = list(channels)
            missing = np.isnan(np.column_stack(list(channels.values())))
            rows: Bool[np.ndarray, " time"] = np.any(missing, axis=1)
            findings += first_of(
                log,
                rows,
                lambda k: f"{names[int(missing[k].argmax())]} is nan",
                hint=f", {100 * rows.mean():.2g} % of the rows, dropped by "
                f"dataset.missing=drop{CUT_THERE}",
                refused=False,
            )
            log = log.select(~rows)
        speed = log.states[:, 3]
        slow = np.abs(speed) < self.min_speed
        findings += first_of(
            log,
            slow,
            lambda k: f"{self.columns.state[3]} is {speed[k]:.3g} m/s",
            hint=f", dropped by dataset.min_speed={self.min_speed:g}{CUT_THERE}",
            refused=False,
        )
        return log.select(~slow), findings

    def _numbers(self, log: Log) -> list[Finding]:
        """Find channels with numbers that are missing, infinite or too large."""
        findings: list[Finding] = []
        for name, values in log.channels(self.columns).items():
            bad = ~np.isfinite(values) | (np.abs(values) > LARGEST)

            def text(k: int, name: str = name, values: np.ndarray = values) -> str:
                advice = DROP if np.isnan(values[k]) else ""
                return f"{name} is {values[k]}{advice}"

            findings += first_of(log, bad, text)
        return findings

    def _cut_at_jumps(self, log: Log) -> tuple[Log, list[Finding]]:
        """Cut a run where time goes back and where position or yaw jump.

        A run with stale positions is not cut at jumps, since its positions jump
        whenever they are updated.
        """
        findings = list(self._time(log, CUT_THERE, refused=False))
        log = log.cut(_backwards(log))
        if not log.joined.any() or _stale(log).any():
            return log, findings
        for find_jumps in (self._position_jumps, self._yaw_jumps):
            # The cuts before may have left single rows only.
            if log.joined.any():
                jumps, text = find_jumps(log)
                findings += first_of(log, jumps, text, hint=CUT_THERE, refused=False)
                log = log.cut(jumps)
        return log, findings

    def _time(self, log: Log, hint: str, *, refused: bool = True) -> Iterator[Finding]:
        """Find time that repeats or goes back."""

        def text(k: int) -> str:
            before = log.time[k]
            after = log.time[k + 1]
            if before == after:
                return f"{self.columns.time} repeats {after:.12g}"
            return f"{self.columns.time} goes back from {before:.12g} to {after:.12g}"

        return first_of(log, _backwards(log), text, hint=hint, refused=refused)

    def _duration(self, log: Log) -> Iterator[Finding]:
        """Find a run that is too short for a segment."""
        edges = np.flatnonzero(~log.joined) + 1
        longest = max(float(np.ptp(part)) for part in np.split(log.time, edges))
        if longest < (self.steps - 1e-3) * self.dt:
            yield warning(
                f"{log.whole}: only {longest:.4g} s, a segment is "
                f"{self.steps * self.dt:.4g} s; not used"
            )

    def _bursts(self, log: Log) -> Iterator[Finding]:
        """Find rows that were stamped when several of them arrived together."""
        waits = np.sort(log.waits[log.joined])
        # A few pauses are no bursts.
        usual = float(np.mean(waits[: max(round(0.95 * len(waits)), 1)]))
        if log.period < BURSTS * usual:
            others = float(np.median(waits[waits > usual]))
            yield Finding(
                f"{log.whole}: rows come in bursts, most of them {log.period:.2g} s "
                f"after the row before and the others {others:.2g} s; log when a row "
                "was measured and not when it arrived, or keep one row of each burst"
            )

    def _sampling(self, log: Log) -> Iterator[Finding]:
        """Find slow sampling, which is refused, gaps and uneven sampling."""
        waits = log.waits
        period = log.period
        gaps = log.gaps(self.gap, self.dt)
        if period > SLOWER * self.dt:
            yield Finding(
                f"{log.whole}: recorded every {period:.4g} s, slower than "
                f"vehicle.dt={self.dt:g}; pass vehicle.dt={period:.2g}"
            )
        yield from first_of(
            log,
            gaps,
            lambda k: f"{waits[k]:.4g} s without rows; runs are split there",
            refused=False,
        )
        # A few uneven steps are usual. Gaps have been reported above.
        uneven = (np.abs(waits - period) > UNEVEN * period) & ~gaps & log.joined
        if uneven.mean() > 0.1:
            yield from first_of(
                log,
                uneven,
                lambda k: f"uneven sampling, {waits[k]:.4g} s after the row before",
                refused=False,
            )

    def _motion(self, log: Log) -> Iterator[Finding]:
        """Find stale positions, or else rounded ones, or else jumps."""
        stale = _stale(log)
        if stale.any():
            speed = log.states[1:, 3]
            yield from first_of(
                log,
                stale,
                lambda k: f"the position of the row before at {speed[k]:.3g} m/s",
                hint=f"; log positions as often as {self.columns.time}, "
                "or leave rows out",
            )
            return
        rounded = list(self._rounded(log))
        if rounded:
            yield from rounded
            return
        for find_jumps in (self._position_jumps, self._yaw_jumps):
            yield from first_of(log, *find_jumps(log))

    def _rounded(self, log: Log) -> Iterator[Finding]:
        """Find positions of few values, as those in float32 far from the origin."""
        speed = log.states[:, 3]
        yaw = log.states[1:, 2][log.joined]
        driven = (0.5 * (speed[1:] + speed[:-1]) * log.waits)[log.joined]
        for axis, direction in enumerate((np.cos, np.sin)):
            positions = log.states[:, axis]
            expected = driven * direction(yaw)
            reach = float(np.ptp(np.cumsum(expected)))
            # Different values within a metre. Along its whole way a car may take every
            # value of a coarse grid only once.
            count = len(np.unique(np.round(positions % 1.0, 6) % 1.0))
            few = count < min(1.0 / COARSEST, len(expected) / 3)
            # A simulated car may move in whole metres. It is where its speed says, and
            # is not refused.
            off = float(np.std(np.diff(positions)[log.joined] - expected))
            if few and reach > 1.0 and off * count > 0.2:
                yield Finding(
                    f"{log.whole}: {self.columns.state[axis]} has a resolution of "
                    f"{1 / count:.2g} m; log positions as float64, or near the origin"
                )

    def _delays(self, log: Log) -> Iterator[Finding]:
        """Find positions and yaw that are late against speed, yaw rate and course."""
        if not log.joined.any() or _stale(log).any():
            return
        x, y, yaw, speed = self.columns.state[:4]
        parts = log.parts(self.gap, self.dt)
        unwrapped_yaw = np.unwrap(log.states[:, 2])

        def delay_of(
            motion: Float[np.ndarray, "time ..."], rate: Float[np.ndarray, " time"]
        ) -> Delay:
            table = np.column_stack([log.time, motion, rate])
            return find_delay(table[rows] for rows in parts)

        delays = {
            (f"{x}, {y}", speed): delay_of(log.states[:, :2], log.states[:, 3]),
            (yaw, "the direction of travel"): self._delay_behind_course(log),
        }
        for k, name in enumerate(self.columns.state[4:], start=4):
            delay = delay_of(unwrapped_yaw, log.states[:, k])
            # Only a yaw rate in rad/s agrees so well with the yaw.
            if delay.alike > 0.95 and 0.8 < abs(delay.gain) < 1.25:
                delays[yaw, name] = delay
        smallest = max(0.9 * log.period, 0.1 * self.dt)
        for (late, early), delay in delays.items():
            if delay.certain and delay.alike > 0.7 and abs(delay.lag) >= smallest:
                yield Finding(
                    f"{log.whole}: {delay.line(late, early, self.dt)}",
                    refused=abs(delay.lag) >= LATE * self.dt,
                )

    def _delay_behind_course(self, log: Log) -> Delay:
        """Return how late yaw is behind the direction of travel.

        The angle between course and yaw is regressed on yaw rate and on yaw rate over
        speed. A yaw that is late by some time is behind by that time times the yaw
        rate. If the position is ahead of the rear axle, the course turns by the
        distance to the axle times yaw rate over speed; that distance is about half a
        wheelbase.
        """
        chords = find_chords(log, log.states[:, 3])
        speed = log.states[chords.middle, 3]
        # Neighbouring chords overlap. The independent ones are those that fit one after
        # another.
        independent = len(speed) * log.period / CHORD
        too_few = independent < 0.5 * FEWEST_CHORDS
        if too_few or not speed.all() or np.std(chords.turn) < 1e-3:
            return Delay()
        off = chords.course - chords.yaw
        off = np.angle(np.exp(1j * (off - np.angle(agreement(off)))))
        causes = np.column_stack([np.ones_like(off), chords.turn, chords.turn / speed])
        rest = off - causes @ np.linalg.lstsq(causes, off, rcond=None)[0]
        # Bayesian regression: only the distance has an informative prior.
        weight = independent / len(off) / max(float(np.mean(rest**2)), 1e-12)
        prior = np.array([1e-9, 1e-9, 16.0 / self.wheelbase**2])
        covariance = np.linalg.inv(weight * causes.T @ causes + np.diag(prior))
        mean = covariance @ (weight * causes.T @ off + prior * 0.5 * self.wheelbase)
        lag = float(mean[1])
        spread = float(np.sqrt(covariance[1, 1]))
        alike = np.sqrt(max(0.0, 1.0 - np.mean(rest**2) / max(np.var(off), 1e-12)))
        # A negative lag is never certain: tyres that slip make yaw look early.
        return Delay(lag, float(alike), certain=lag > 5.0 * spread)

    def _position_jumps(self, log: Log) -> Jumps:
        """Find steps that are much longer than the speed explains."""
        excess = log.moved - log.integrated
        # The spread is taken from the median, which jumps do not widen.
        spread = 1.4826 * np.median(np.abs(excess)[log.joined])
        jumps = excess > log.integrated + 15.0 * spread + 1e-6
        x, y = self.columns.state[:2]

        def text(k: int) -> str:
            return f"{x}, {y} jump {log.moved[k]:.3g} m at {log.states[k, 3]:.3g} m/s"

        return jumps & ~log.gaps(self.gap, self.dt) & log.joined, text

    def _yaw_jumps(self, log: Log) -> Jumps:
        """Find steps that turn much more than the others, between rows near in time."""
        turned = np.abs(np.diff(np.unwrap(log.states[:, 2])))
        # Small robots turn fast, so that a jump has to stand out of their other steps.
        jumps = turned > max(1.0, 10.0 * float(np.median(turned[log.joined])))

        def text(k: int) -> str:
            return f"{self.columns.state[2]} jumps by {turned[k]:.3g} rad"

        return jumps & ~log.gaps(self.gap, self.dt) & log.joined, text


def _any_refused(findings: list[Finding]) -> bool:
    """Return whether the log is refused for one of the findings."""
    return any(finding.refused for finding in findings)


def _has_steps(log: Log) -> bool:
    """Return whether there are steps to check."""
    return len(log.time) >= SHORTEST and bool(log.joined.any())


def _backwards(log: Log) -> Bool[np.ndarray, " step"]:
    """Return the steps at which time repeats or goes back."""
    return (log.waits <= 0) & log.joined


def _stale(log: Log) -> Bool[np.ndarray, " step"]:
    """Return the steps without motion while driving; none if they are few."""
    usual = np.quantile(log.integrated[log.joined], 0.9)
    # At standstill it is right that positions repeat.
    driving = (log.integrated > 0.1 * usual) & log.joined
    stale = driving & (log.moved == 0.0)
    return stale & (stale.sum() > STALE * max(driving.sum(), 1))
