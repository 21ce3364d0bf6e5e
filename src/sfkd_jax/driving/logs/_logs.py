"""Recorded runs in SI units, and the names of their columns in files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sfkd_jax.ranges import Names


class Columns(NamedTuple):
    """Names of the columns of a log.

    Attributes:
        time: [s].
        state: position [m], yaw [rad, counter-clockwise from the x axis], speed [m/s],
            then any others.
        control: the two commands.
        environment: any number of them, or none.
        run: a column that numbers the runs in one file, or None: every file is one run.
    """

    time: str = "t"
    state: tuple[str, ...] = ("p_x", "p_y", "yaw", "v")
    control: tuple[str, str] = ("steering", "acceleration")
    environment: Names = ("friction", "wind")
    run: str | None = None


@dataclass(frozen=True)
class Log:
    """One recorded run.

    Attributes:
        source: the file, and the run if there are several in it.
        rows: position of each row in the file.
        row_name: what `rows` counts, "line" or "row".
        time: [s].
        states: in SI units, pose first.
        controls: in SI units.
        envs: in SI units; zeros where nobody measured them.
        stretch: number of the uninterrupted stretch of rows that each row belongs to.
    """

    source: str
    rows: Int[np.ndarray, " time"]
    row_name: str
    time: Float[np.ndarray, " time"]
    states: Float[np.ndarray, "time state"]
    controls: Float[np.ndarray, "time control"]
    envs: Float[np.ndarray, "time environment"]
    stretch: Int[np.ndarray, " time"]

    def at(self, index: int) -> str:
        """Return where a row is, for messages."""
        return f"{self.source}, {self.row_name} {self.rows[index]}"

    def between(self, first: int, last: int) -> str:
        """Return where a range of rows is, for messages."""
        return (
            f"{self.source}, {self.row_name}s {self.rows[first]} to {self.rows[last]}"
        )

    @property
    def whole(self) -> str:
        """Where the run is, for messages."""
        return self.between(0, -1)

    @property
    def steps(self) -> Float[np.ndarray, "step channel"]:
        """The motion of every step in its own frame, and the other channels of its row.

        A copy of a run has the same steps, wherever and whenever it begins.
        """
        yaw = self.states[:-1, 2]
        x, y = np.diff(self.states[:, :2], axis=0).T
        ahead = np.cos(yaw) * x + np.sin(yaw) * y
        aside = np.cos(yaw) * y - np.sin(yaw) * x
        turned = np.diff(np.unwrap(self.states[:, 2]))
        others = np.column_stack([self.states[:, 3:], self.controls, self.envs])[:-1]
        return np.column_stack([ahead, aside, turned, others])

    @cached_property
    def joined(self) -> Bool[np.ndarray, " step"]:
        """Whether each row but the first one continues the row before it."""
        return self.stretch[1:] == self.stretch[:-1]

    @cached_property
    def waits(self) -> Float[np.ndarray, " step"]:
        """Time between rows [s]."""
        return np.diff(self.time)

    @cached_property
    def period(self) -> float:
        """Median time between joined rows [s]; 0 if there are no such rows."""
        if not self.joined.any():
            return 0.0
        return float(np.median(self.waits[self.joined]))

    @cached_property
    def moved(self) -> Float[np.ndarray, " step"]:
        """Distance between positions [m]."""
        return np.linalg.norm(np.diff(self.states[:, :2], axis=0), axis=1)

    @cached_property
    def integrated(self) -> Float[np.ndarray, " step"]:
        """Distance between rows by the integral of the speed [m]."""
        speed = np.abs(self.states[:, 3])
        return 0.5 * (speed[1:] + speed[:-1]) * self.waits

    def gaps(self, gap: float, dt: float) -> Bool[np.ndarray, " step"]:
        """Return which steps are too long to be bridged.

        Args:
            gap: longest wait that is bridged, in periods: of the log or of the model,
                whichever is longer.
            dt: period of the model [s].
        """
        return (self.waits > gap * max(self.period, dt)) & self.joined

    def parts(self, gap: float, dt: float) -> list[Int[np.ndarray, " time"]]:
        """Return the indices of the rows between gaps and cuts.

        The arguments are those of `gaps`.
        """
        edges = np.flatnonzero(self.gaps(gap, dt) | ~self.joined) + 1
        return np.split(np.arange(len(self.time)), edges)

    def channels(self, columns: Columns) -> dict[str, Float[np.ndarray, " time"]]:
        """Return every column by its name, without those of an unknown environment."""
        channels = {columns.time: self.time}
        channels.update(zip(columns.state, self.states.T, strict=True))
        channels.update(zip(columns.control, self.controls.T, strict=True))
        # The zeros that replace an unknown environment may have no names.
        if len(columns.environment) == self.envs.shape[1]:
            channels.update(zip(columns.environment, self.envs.T, strict=True))
        return channels

    def select(self, chosen: Bool[np.ndarray, " time"]) -> Log:
        """Return the chosen rows, cut where rows between them are left out."""
        # Every row that is left out raises the number of all later stretches.
        left_out = np.concatenate([[0], np.cumsum(~chosen)])[:-1]
        return replace(
            self,
            rows=self.rows[chosen],
            time=self.time[chosen],
            states=self.states[chosen],
            controls=self.controls[chosen],
            envs=self.envs[chosen],
            stretch=(self.stretch + left_out)[chosen],
        )

    def cut(self, steps: Bool[np.ndarray, " step"]) -> Log:
        """Return the same rows, cut at every step that is marked."""
        cuts = np.concatenate([[0], np.cumsum(steps)])
        return replace(self, stretch=self.stretch + cuts)
