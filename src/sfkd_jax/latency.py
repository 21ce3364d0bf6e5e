"""Latency: how old an observation is when it arrives, and when a command acts.

At call k a controller receives an observation of the time k − d_s, and returns a
command that acts from k + d_u on, for one sampling period. Delays are constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor
from typing import Annotated, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.geometry import along_arc
from sfkd_jax.ranges import Interval, MayBeEmpty, check_intervals
from sfkd_jax.types import BODY, POSE, Control, Scalar, State

Delay = Annotated[float, Interval("[0, 2]")]
"""A delay [s]."""
Delays: TypeAlias = Annotated[tuple[Delay, ...], MayBeEmpty()]
"""Delays [s] of several variables; one number stands for all of them, () for none."""


@dataclass(frozen=True)
class Latency:
    """The delays of a system.

    Attributes:
        sensors: from a state to the call of the controller that receives it [s], one
            for each entry of the observation.
        controls: from a call of the controller to the effect of its command [s], one
            for each control.

    Raises:
        ValueError: a delay is negative, longer than 2 s, or not finite.
    """

    sensors: Delays = ()
    controls: Delays = ()

    def __post_init__(self) -> None:
        check_intervals(self)

    def __str__(self) -> str:
        """Return both in words, as in "sensors 0.1 s, controls 0.05 s"."""
        kinds = {"sensors": self.sensors or (0.0,), "controls": self.controls or (0.0,)}
        parts = []
        for kind, delays in kinds.items():
            shown = delays[:1] if len(set(delays)) == 1 else delays
            parts.append(f"{kind} {', '.join(f'{delay:g}' for delay in shown)} s")
        return ", ".join(parts)

    def sized(self, states: int, controls: int) -> Latency:
        """Return the same delays, one for each variable.

        Raises:
            ValueError: there are neither as many delays as variables, nor one or none.
        """
        return Latency(
            _one_each("sensors", self.sensors, states),
            _one_each("controls", self.controls, controls),
        )

    @property
    def is_none(self) -> bool:
        """Whether nothing is late."""
        return not any((*self.sensors, *self.controls))

    def hold_back(self, dt: float) -> tuple[float, ...]:
        """Return by how many periods each measured entry is younger than the oldest."""
        oldest = max(self.sensors, default=0.0)
        return tuple(_periods(oldest - delay, dt) for delay in self.sensors)

    def observation(self, dt: float) -> tuple[float, ...]:
        """Return the delays of the sensors, in sampling periods."""
        return tuple(_periods(delay, dt) for delay in self.sensors)

    def actuators(self, dt: float) -> CommandDelay:
        """Return the delays of the commands after the call that returns them."""
        return CommandDelay(tuple(_periods(delay, dt) for delay in self.controls))

    def loop(self, dt: float, tolerance: float = 0.0) -> CommandDelay:
        """Return the delays of the commands after the oldest entry of an observation.

        A controller that holds the younger entries back sees states of that one time.

        Args:
            dt: sampling period [s].
            tolerance: largest error of the delays [s].
        """
        oldest = max(self.sensors, default=0.0)
        delays = tuple(_periods(oldest + delay, dt) for delay in self.controls)
        return CommandDelay(delays, _periods(tolerance, dt))


NO_LATENCY = Latency()
"""Of a system that is always on time."""


@dataclass(frozen=True)
class CommandDelay:
    """When commands act, counted from the time of an observation.

    The delays that are stated may be wrong by up to `tolerance`. `later` is then by how
    much the commands really act later, and may be estimated while driving.

    Attributes:
        periods: stated delay of every control, in sampling periods. () stands for none.
        tolerance: largest error of these delays, in sampling periods.
    """

    periods: tuple[float, ...] = ()
    tolerance: float = 0.0

    @property
    def steps(self) -> int:
        """Number of earlier commands that may still act after an observation."""
        return ceil(max(self.periods, default=0.0) + self.tolerance)

    @property
    def first(self) -> float:
        """Periods until the first control acts, to which a controller predicts."""
        return self.periods[0] if self.periods else 0.0

    @property
    def hypotheses(self) -> tuple[float, ...]:
        """By how many whole periods the commands may act later than stated.

        Half a period is within the margin of a law, and is hard to see. Commands never
        act before they are sent.
        """
        whole = floor(self.tolerance)
        later = map(float, range(-whole, whole + 1))
        return tuple(one for one in later if one >= -self.first)

    def acting(
        self,
        sent: Float[Array, "step control"],
        control: Control,
        period: int = 0,
        later: Scalar | float = 0.0,
    ) -> Control:
        """Return the mean command over a period after an observation.

        Args:
            sent: at least the last `steps` commands before this one, newest last; NaN
                stands for the command of this call.
            control: the command of this call, which also stands for later ones.
            period: 0 for the period that begins at the observation, and so on.
            later: periods by which the commands act later than stated.
        """
        if not self.steps:
            return control
        last = sent[len(sent) - self.steps :]
        known = jnp.where(jnp.isnan(last), control, last)
        commands = jnp.concatenate([known, control[None]])
        return jnp.sum(self._shares(period, later) * commands, axis=0)

    def _shares(
        self, period: int, later: Scalar | float
    ) -> Float[Array, "command control"]:
        """Return the shares of a period during which each command acts."""
        delays = jnp.maximum(jnp.asarray(self.periods or (0.0,)) + later, 0.0)
        starts = jnp.arange(-self.steps, 1)[:, None] + delays
        never = jnp.full((1, starts.shape[1]), jnp.inf)
        ends = jnp.concatenate([starts[1:], never])
        overlap = jnp.minimum(ends, period + 1) - jnp.maximum(starts, period)
        return jnp.maximum(overlap, 0.0)


ON_TIME = CommandDelay()
"""Of commands that act at once."""


def delayed(
    past: Float[Array, "time state"], periods: tuple[float, ...]
) -> Float[Array, " state"]:
    """Return each entry of a state as it was some periods ago.

    Between two periods the pose is on the arc that joins its values, and the other
    entries are interpolated linearly.

    Args:
        past: states at the last periods, newest last; at least as many as are needed.
        periods: delay of each entry, in sampling periods; () for none.
    """
    if not any(periods):
        return past[-1]

    def at(delay: float) -> State:
        whole = ceil(delay)
        share = whole - delay
        before = past[-1 - whole]
        after = past[min(-whole, -1)]
        pose = along_arc(before[POSE], after[POSE], share)
        body = before[BODY] + share * (after[BODY] - before[BODY])
        return jnp.concatenate([pose, body])

    times = {delay: at(delay) for delay in set(periods)}
    return jnp.stack([times[delay][i] for i, delay in enumerate(periods)])


class ReadingBuffer:
    """Makes readings whose delays vary readings of one delay.

        buffer = ReadingBuffer(latest=0.2)
        buffer.push(reading_time, observation)      # whenever one arrives
        observation = buffer.at(now)                # at every call of the controller

    Every reading is handed over when the latest one could have arrived. At a call the
    buffer returns the state of `latest` seconds ago, on the arc between the readings
    before and after that time. A controller with `Latency((latest,), …)` predicts from
    there. It lives on the host, and takes readings in any order.

    Attributes:
        latest: longest delay of a reading [s].
        gap: longest time between two readings to interpolate between [s]. Where they
            are farther apart, nothing is known.
    """

    def __init__(self, latest: float, *, gap: float = 0.25) -> None:
        """Return an empty buffer.

        Raises:
            ValueError: a time is negative or not finite.
        """
        if not (0.0 <= latest < np.inf and 0.0 < gap < np.inf):
            raise ValueError(
                f"latest must be in [0, inf) and gap in (0, inf), got {latest}, {gap}"
            )
        self.latest = latest
        self.gap = gap
        self._readings: dict[float, np.ndarray] = {}

    def push(self, time: float, observation: Float[np.ndarray, " state"]) -> None:
        """Add a reading; one of the same time is replaced, one without a time ignored.

        Args:
            time: at which the state was measured [s].
            observation: pose, and what follows it.
        """
        if np.isfinite(time):
            self._readings[float(time)] = np.asarray(observation, dtype=float)

    def at(self, now: float) -> Float[np.ndarray, " state"]:
        """Return the state of `latest` seconds ago; NaN where it is not known.

        Args:
            now: time of the call [s]; readings that no later call needs are dropped.

        Raises:
            ValueError: nothing was ever pushed.
        """
        if not self._readings:
            raise ValueError("no reading was pushed yet")
        wanted = now - self.latest + 1e-9
        before = max((t for t in self._readings if t <= wanted), default=None)
        after = min((t for t in self._readings if t > wanted), default=None)
        unknown = np.full_like(next(iter(self._readings.values())), np.nan)
        if before is None:
            return unknown
        first = self._readings[before]
        self._readings = {t: x for t, x in self._readings.items() if t >= before}
        if wanted - before < 1e-6:
            return first
        if after is None or after - before > self.gap:
            return unknown
        share = (wanted - before) / (after - before)
        second = self._readings[after]
        # From the first position on: far away float32 does not resolve it.
        way = second[POSE] - np.append(first[:2], 0.0)
        start = np.append(np.zeros(2), first[2])
        pose = np.array(along_arc(jnp.asarray(start), jnp.asarray(way), share), float)
        pose[:2] += first[:2]
        body = first[BODY] + share * (second[BODY] - first[BODY])
        return np.concatenate([pose, body])


def pushed(past: Float[Array, "time n"], newest: Float[Array, " n"]) -> Array:
    """Return the rows with a newest one at the end, and without the oldest."""
    return jnp.concatenate([past, newest[None]])[1:]


def rows_needed(periods: tuple[float, ...]) -> int:
    """Return how many rows `delayed` needs for these delays."""
    return 1 + ceil(max(periods, default=0.0))


def _one_each(name: str, delays: tuple[float, ...], count: int) -> tuple[float, ...]:
    """Return one delay for each of `count` variables."""
    if len(delays) <= 1:
        return (delays or (0.0,)) * count
    if len(delays) != count:
        raise ValueError(
            f"latency.{name} needs one number or {count}, got {len(delays)}"
        )
    return delays


def _periods(delay: float, dt: float) -> float:
    """Return a delay in sampling periods, without the rounding error of a quotient."""
    return round(delay / dt, 9)
