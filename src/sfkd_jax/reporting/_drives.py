"""The first episode of every cell of a comparison, as far as its arrays are there."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.artefacts import ArtefactError, exists, read_arrays
from sfkd_jax.reporting._benchmark_rows import Contest, Line

KIND = "cell"


class Drive(NamedTuple):
    """The first episode of a line.

    Attributes:
        line: who drove.
        dt: sampling period [s].
        lateral: signed deviation of x_1 … x_T [m], left positive.
        states: x_0 … x_T, beginning with x, y, yaw.
        envs: friction and wind [m/s] at every step.
        path: x, y, yaw, curvature of its points.
    """

    line: Line
    dt: float
    lateral: Float[np.ndarray, " time"]
    states: Float[np.ndarray, "time_plus_1 state"] | None
    envs: Float[np.ndarray, "time 2"] | None
    path: Float[np.ndarray, "point column"] | None


def drives(
    directory: Path, contest: Contest, scenario: str
) -> tuple[list[Drive], list[str]]:
    """What was driven, and the names of those whose arrays are missing or hold no finite deviation."""
    lines = [line for line in contest.lines if scenario in line.rows]
    found = [_drive(directory, line, scenario) for line in lines]
    return [one for one in found if one], [
        line.name for line, one in zip(lines, found, strict=True) if one is None
    ]


def _drive(directory: Path, line: Line, scenario: str) -> Drive | None:
    file = _file(directory, line, scenario)
    arrays = read_arrays(file, kind=KIND)[0] if exists(file) else {}
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
        line, dt, lateral, *(first.get(name) for name in ("states", "envs", "path"))
    )


def _file(directory: Path, line: Line, scenario: str) -> Path:
    """Where a row says that its arrays lie, else where they lie by its identity."""
    row = line.rows[scenario]
    if isinstance(row.get("arrays"), str):
        if (
            PurePath(row["arrays"]).is_absolute()
            or ".." in PurePath(row["arrays"]).parts
        ):
            raise ArtefactError(
                f"{directory / 'results.json'}: arrays of a row lie outside this folder"
            )
        return directory / row["arrays"]
    place = (
        directory
        / "cells"
        / str(row.get("vehicle"))
        / scenario
        / str(row.get("sampling") or "qp")
    )
    return place / f"{line.system}-{line.env}.npz"
