"""Stored episodes of the rows of a run or of a comparison."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax import store
from sfkd_jax.evaluation import SHARED
from sfkd_jax.evaluation.metrics import Row, switches
from sfkd_jax.report.style import family, rank
from sfkd_jax.report.tables import name_of


class Episodes(NamedTuple):
    """The stored episodes of a row."""

    row: Row
    dt: float
    # Signed deviation of x_1 … x_T from the path [m], left positive.
    lateral: Float[np.ndarray, "episode time"]
    # x_0 … x_T of the first episode, beginning with x, y, yaw.
    states: Float[np.ndarray, "time_plus_1 state"] | None
    # Friction and wind [m/s] at every step of the first episode.
    envs: Float[np.ndarray, "time 2"] | None
    # x, y, yaw, curvature along the road of the first episode.
    path: Float[np.ndarray, "point column"] | None

    @property
    def name(self) -> str:
        """Name of the row."""
        return name_of(self.row)

    @property
    def system(self) -> str:
        """Name of the system, without its coordinates."""
        return family(str(self.row.get("system")))

    @property
    def switches(self) -> list[int]:
        """Steps at which friction or wind switch in the first episode."""
        return [] if self.envs is None else np.flatnonzero(switches(self.envs)).tolist()


def by_road(episodes: list[Episodes]) -> list[list[Episodes]]:
    """Episodes that may be compared, on one road; the one with most switches first."""
    groups: dict[tuple[Any, ...], list[Episodes]] = {}
    for one in sorted(episodes, key=lambda one: (rank(one.system), one.name)):
        # By content: rows met the same road only if every byte of it is equal.
        road = (None if a is None else a.tobytes() for a in (one.envs, one.path))
        key = (*(one.row.get(column) for column in SHARED), *road)
        groups.setdefault(key, []).append(one)
    return sorted(groups.values(), key=lambda group: -len(group[0].switches))


def of_rows(directory: Path, rows: list[Row]) -> list[Episodes]:
    """The episodes of those rows whose arrays exist below the directory."""
    found = []
    for row in rows:
        name = PurePath(str(row.get("arrays")))
        # A row of somebody else's file must not make us read files elsewhere.
        if name.is_absolute() or ".." in name.parts:
            outside = "arrays of a row lie outside this folder"
            raise store.ArtefactError(f"{directory / 'results.json'}: {outside}")
        if (directory / name).is_file():
            arrays = store.read_arrays(directory / name, kind="episodes")[0]
            one = _episodes(row, arrays)
            found += [one] if one else []
    return found


def _episodes(row: Row, arrays: dict[str, np.ndarray]) -> Episodes | None:
    """The episodes of a row, None without a finite deviation."""
    dt = float(arrays.get("dt", 0.1))
    lateral = np.asarray(arrays.get("lateral", np.zeros((0, 0))), dtype=float)
    # All NaN, as of a run that diverged at once: there is nothing to draw.
    if not np.any(np.isfinite(lateral)):
        return None
    first = {
        name: np.asarray(values[0], dtype=float)
        for name, values in arrays.items()
        if values.ndim > 1 and values.size
    }
    return Episodes(row, dt, lateral, *map(first.get, ("states", "envs", "path")))
