"""Recorded drives as they stand in files, and the names of their columns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sfkd_jax.ranges import Names

UNKNOWN = 2
"""Entries of the constant environment that replaces one that nobody measured."""


class Columns(NamedTuple):
    """Names of the columns of a log.

    Attributes:
        time: [s].
        state: position [m], yaw [rad, counter-clockwise from the x axis], speed [m/s],
            then any others.
        control: the two commands.
        environment: any number of them, or none.
        drive: a column that numbers the drives in one file, or None: every file is one
            drive.
    """

    time: str = "t"
    state: tuple[str, ...] = ("p_x", "p_y", "yaw", "v")
    control: tuple[str, ...] = ("steering", "acceleration")
    environment: Names = ("friction", "wind")
    drive: str | None = None


class Log(NamedTuple):
    """One recorded drive.

    Attributes:
        source: file, and drive if there are several in it.
        rows: position of each row in the file, see `Table`.
        row_name: what `rows` counts, "line" or "row".
        time: [s].
        states: one row per moment.
        controls: one row per moment.
        envs: one row per moment; zeros where nobody measured them.
        stretch: number of the uninterrupted stretch that each row belongs to.
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
        """Return the position of a row, for messages."""
        return f"{self.source}, {self.row_name} {self.rows[index]}"

    @property
    def whole(self) -> str:
        """The position of the drive, for messages."""
        return f"{self.source}, {self.row_name}s {self.rows[0]} to {self.rows[-1]}"

    @property
    def joined(self) -> Bool[np.ndarray, " step"]:
        """Whether each row but the first continues the row before it."""
        return self.stretch[1:] == self.stretch[:-1]

    def select(self, chosen: Bool[np.ndarray, " time"]) -> Log:
        """Return the chosen rows, cut where rows between them are left out."""
        cut = np.concatenate([[0], np.cumsum(~chosen)])[:-1]
        kept = self._replace(stretch=self.stretch + cut)
        arrays = ("rows", "time", "states", "controls", "envs", "stretch")
        return kept._replace(**{name: getattr(kept, name)[chosen] for name in arrays})

    def cut(self, before: Bool[np.ndarray, " step"]) -> Log:
        """Return the same rows, cut before every row that is marked."""
        cuts = np.concatenate([[0], np.cumsum(before)])
        return self._replace(stretch=self.stretch + cuts)


def environment_columns(
    source: str, columns: Columns, present: set[str], needs_environment: bool
) -> tuple[str, ...]:
    """Return the environment's columns to read: all, or none if none is needed.

    Raises:
        ValueError: a column is missing.
    """
    absent = [name for name in columns.environment if name not in present]
    if not absent:
        return columns.environment
    if not needs_environment and len(absent) == len(columns.environment):
        return ()
    raise ValueError(
        f"{source}: no column {absent[0]} for the environment; "
        "pass environment.source=none, or map the columns with "
        "dataset.columns.environment"
    )
