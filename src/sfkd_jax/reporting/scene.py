"""Simulated episodes of one scenario, from `episodes.safetensors`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from sfkd_jax.evaluation import ROAD, SHARED, parse_episode_name
from sfkd_jax.reporting.rows import search_words
from sfkd_jax.reporting.style import file_stem, literal, scenario_label
from sfkd_jax.store import read_arrays

_Arrays: TypeAlias = dict[str, np.ndarray]
_Drive: TypeAlias = tuple[dict[str, str], _Arrays, _Arrays]
"""A row, its arrays, and the road of its first episode."""


class Scene(NamedTuple):
    """One scenario with one kind of search for controls.

    Only the first episode has environment, path, states and controls.

    Attributes:
        name: of the scenario.
        dt: sampling period [s].
        envs: friction and wind.
        path: x, y, yaw, curvature.
        lateral: by system, signed deviation of x_1 … x_T [m], left positive.
        states: by system.
        controls: by system.
        search: of controls, where the run has the scenario with several kinds.
        number: among the scenes of this scenario.
    """

    name: str
    dt: float
    envs: Float[np.ndarray, "time 2"] | None
    path: Float[np.ndarray, "point 4"] | None
    lateral: dict[str, Float[np.ndarray, "episode time"]]
    states: dict[str, Float[np.ndarray, "time_plus_1 state"]]
    controls: dict[str, Float[np.ndarray, "time control"]]
    search: str = ""
    number: int = 1

    def elapsed(self, values: np.ndarray) -> np.ndarray:
        """Time of the states after every step [s]."""
        return self.dt * np.arange(1, len(values) + 1)

    @property
    def label(self) -> str:
        """What a reader sees."""
        return scenario_label(self.name) + (f", {self.search}" if self.search else "")

    @property
    def title(self) -> str:
        """The label for a figure of the first episode."""
        return f"{literal(self.label)}, first episode"

    @property
    def stem(self) -> str:
        """The name as part of a file name."""
        name = file_stem(self.name)
        return name if self.number == 1 else f"{name}_{self.number}"


def switches(envs: Float[np.ndarray, "time 2"] | None) -> list[int]:
    """Steps at which friction jumps, or wind jumps between two steady levels.

    The ramp of a gust is no jump.
    """
    if envs is None or len(envs) < 2:
        return []
    friction, wind = np.abs(np.diff(envs, axis=0)).T
    steady = np.pad(wind, 1) < 1e-3
    jump = (friction > 0.02) | ((wind > 0.5) & steady[:-2] & steady[2:])
    return [int(step) + 1 for step in np.flatnonzero(jump)]


def hardest_step(scene: Scene) -> int:
    """The step at which nominal, or else any system, is farthest from the path."""
    rows = {
        name: np.nan_to_num(np.abs(values[0]), nan=0.0)
        for name, values in scene.lateral.items()
    }
    return int(np.argmax(rows.get("nominal", max(rows.values(), key=np.max))))


def scenes_of(run: Path) -> list[Scene]:
    """The scenes of a run, the one with most switches first; empty without a file.

    A scene holds the systems that drove the same road with the same kind of search.
    """
    path = run / "episodes.safetensors"
    arrays = read_arrays(path, kind="episodes")[0] if path.exists() else {}
    dt = float(arrays.pop("dt", 0.1))
    parts: dict[str, _Arrays] = {}
    for name, values in arrays.items():
        drive, _, part = name.rpartition("/")
        parts.setdefault(drive, {})[part] = values
    groups: dict[tuple[Any, ...], list[_Drive]] = {}
    for name, own in parts.items():
        row = parse_episode_name(name)
        if own.get("lateral", np.zeros(0)).size:
            # Earlier versions store one road per scenario.
            available = parts.get(row.get("scenario", ""), {}) | own
            road = {
                part: values[0]
                for part, values in available.items()
                if part in ROAD and len(values)
            }
            key = tuple((part, road[part].tobytes()) for part in sorted(road))
            search = tuple(row.get(column) for column in SHARED)
            groups.setdefault((search, key), []).append((row, own, road))
    scenes = _numbered([_scene(drives, dt) for drives in groups.values()])
    return sorted(scenes, key=lambda scene: len(switches(scene.envs)), reverse=True)


def _numbered(scenes: list[Scene]) -> list[Scene]:
    """Sorted scenes, numbered within a scenario; a single one has no search."""
    counts, seen = Counter(scene.name for scene in scenes), Counter()
    usual = search_words({"sampling": "feedback"})
    scenes.sort(key=lambda scene: (scene.name, scene.search != usual, scene.search))
    numbered = []
    for scene in scenes:
        seen[scene.name] += 1
        search = scene.search if counts[scene.name] > 1 else ""
        numbered.append(scene._replace(search=search, number=seen[scene.name]))
    return numbered


def _scene(drives: list[_Drive], dt: float) -> Scene:
    """Drives of one road as a scene; a second row of a system is named by its env."""
    drives = sorted(drives, key=lambda drive: drive[0].get("env") != "measured")
    lateral, states, controls = {}, {}, {}
    for row, parts, _ in drives:
        system = row["system"]
        if system in lateral:
            system = f"{system} (e {row.get('env')})"
        lateral[system] = parts["lateral"]
        for kind, of_system in (("states", states), ("controls", controls)):
            if parts.get(kind, np.zeros(0)).size:
                of_system[system] = parts[kind][0]
    row, _, road = drives[0]
    arrays = road.get("envs"), road.get("path"), lateral, states, controls
    return Scene(row["scenario"], dt, *arrays, search_words(row))
