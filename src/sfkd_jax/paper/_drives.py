"""The first episode of the rows of a comparison, if its arrays exist."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.reporting.rows import name_of
from sfkd_jax.reporting.style import family
from sfkd_jax.store import SUFFIX, ArtefactError, read_arrays

KIND = "cell"


class Drive(NamedTuple):
    """The first episode of a row.

    Attributes:
        row: of results.json.
        dt: sampling period [s].
        lateral: signed deviation of x_1 … x_T [m], left positive.
        states: x_0 … x_T, beginning with x, y, yaw.
        envs: friction and wind [m/s] at every step.
        path: x, y, yaw, curvature of its points.
    """

    row: Row
    dt: float
    lateral: Float[np.ndarray, " time"]
    states: Float[np.ndarray, "time_plus_1 state"] | None
    envs: Float[np.ndarray, "time 2"] | None
    path: Float[np.ndarray, "point column"] | None

    @property
    def name(self) -> str:
        """Name of the row."""
        return name_of(self.row)

    @property
    def system(self) -> str:
        """Name of the system, without its coordinates."""
        return family(str(self.row.get("system")))


def drives(directory: Path, rows: list[Row]) -> tuple[list[Drive], list[str]]:
    """Read the first episode of rows, and name the rows without a usable episode."""
    loaded = [_drive(directory, row) for row in rows]
    missing = [
        name_of(row) for row, one in zip(rows, loaded, strict=True) if one is None
    ]
    return [one for one in loaded if one], missing


def _drive(directory: Path, row: Row) -> Drive | None:
    file = _file(directory, row)
    arrays = read_arrays(file, kind=KIND)[0] if file.is_file() else {}
    first = {
        name: np.asarray(values[0], dtype=float)
        for name, values in arrays.items()
        if values.ndim and values.size
    }
    lateral = first.get("lateral")
    if lateral is None or not np.any(np.isfinite(lateral)):
        return None
    dt = float(arrays.get("dt", np.asarray(0.1)))
    return Drive(
        row, dt, lateral, *(first.get(name) for name in ("states", "envs", "path"))
    )


def _file(directory: Path, row: Row) -> Path:
    """The arrays of a row: those it names, else those of its identity."""
    if isinstance(row.get("arrays"), str):
        path = PurePath(row["arrays"])
        if path.is_absolute() or ".." in path.parts:
            raise ArtefactError(
                f"{directory / 'results.json'}: arrays of a row lie outside this folder"
            )
        return directory / row["arrays"]
    sampling = str(row.get("sampling") or "qp")
    cells = directory / "cells" / str(row.get("vehicle")) / str(row.get("scenario"))
    name = f"{family(str(row.get('system')))}-{row.get('env')}"
    return cells / sampling / f"{name}{SUFFIX}"
