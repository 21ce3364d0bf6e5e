"""Stored episodes of the rows of a run or of a comparison."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax import store
from sfkd_jax.driving.simulation import SHARED
from sfkd_jax.driving.simulation.metrics import Row, switches
from sfkd_jax.report.style import family, rank
from sfkd_jax.report.tables import name_of

ENV_NAMES = ("friction [-]", "side wind [m/s]")
"""Entries of e in results that do not name them."""


class Episodes(NamedTuple):
    """The stored episodes of a row.

    Attributes:
        row: of results.json.
        dt: sampling period [s].
        lateral: signed deviation of x_1 … x_T from the path [m], left positive.
        states: x_0 … x_T of the first episode, beginning with x, y, yaw.
        envs: friction and wind [m/s] at every step of the first episode.
        path: x, y, yaw, curvature along the road of the first episode.
    """

    row: Row
    dt: float
    lateral: Float[np.ndarray, "episode time"]
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

    @property
    def env_names(self) -> list[str]:
        """Names of the entries of e, with units."""
        names = self.row.get("env_names") or ENV_NAMES
        return [str(name)[:30] for name in names]

    @property
    def switches(self) -> list[int]:
        """Steps at which friction or wind switch in the first episode."""
        if self.envs is None:
            return []
        return np.flatnonzero(switches(self.envs)).tolist()


def by_road(all_episodes: list[Episodes]) -> list[list[Episodes]]:
    """Group episodes that may be compared, which are those on one road.

    The group with most switches of the environment comes first.
    """

    def order_of_tables(episodes: Episodes) -> tuple[Any, ...]:
        return rank(episodes.system), episodes.name

    def most_switches_first(group: list[Episodes]) -> int:
        return -len(group[0].switches)

    groups: dict[tuple[Any, ...], list[Episodes]] = {}
    for episodes in sorted(all_episodes, key=order_of_tables):
        columns = [episodes.row.get(column) for column in SHARED]
        # By content: rows met the same road only if every byte of it is equal.
        road = [
            None if array is None else array.tobytes()
            for array in (episodes.envs, episodes.path)
        ]
        groups.setdefault((*columns, *road), []).append(episodes)
    return sorted(groups.values(), key=most_switches_first)


def of_rows(directory: Path, rows: list[Row]) -> list[Episodes]:
    """Return the episodes of those rows whose arrays exist below the directory."""
    stored = []
    for row in rows:
        name = PurePath(str(row.get("arrays")))
        # A row of somebody else's file must not make us read files elsewhere.
        if name.is_absolute() or ".." in name.parts:
            outside = "arrays of a row lie outside this folder"
            raise store.ArtefactError(f"{directory / 'results.json'}: {outside}")
        if not (directory / name).is_file():
            continue
        arrays, _ = store.read_arrays(directory / name, kind="episodes")
        episodes = _episodes(row, arrays)
        if episodes is not None:
            stored.append(episodes)
    return stored


def _episodes(row: Row, arrays: dict[str, np.ndarray]) -> Episodes | None:
    """Return the episodes of a row, or None if no deviation is finite."""
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
    return Episodes(
        row=row,
        dt=dt,
        lateral=lateral,
        states=first.get("states"),
        envs=first.get("envs"),
        path=first.get("path"),
    )
