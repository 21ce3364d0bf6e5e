"""What was driven in one scenario, as it lies in `episodes.npz`, and where its hard moments are."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.artefacts import ROAD, SHARED, drive_of, read_npz
from sfkd_jax.reporting._benchmark_rows import search_words
from sfkd_jax.reporting._style import scenario_label


class Scene(NamedTuple):
    """One scenario as it was driven in one way; only the first episode's tracks are kept.

    Attributes:
        name: of the scenario.
        dt: sampling period [s].
        envs: friction, wind of the first episode, (time, 2).
        path: x, y, yaw, curvature of it, (point, 4).
        lateral: by system, signed deviation of x_1 … x_T [m], left positive, (episode,
            time).
        states: by system, (time + 1, state).
        controls: by system, (time, control).
    """

    name: str
    dt: float
    envs: Float[np.ndarray, "time 2"] | None
    path: Float[np.ndarray, "point 4"] | None
    lateral: dict[str, Float[np.ndarray, "episode time"]]
    states: dict[str, Float[np.ndarray, "time_plus_1 state"]]
    controls: dict[str, Float[np.ndarray, "time control"]]
    way: str = ""
    """How controls were searched, where the run drove the scenario in several ways."""
    number: int = 1
    """Of the scenes of this scenario."""

    @property
    def label(self) -> str:
        """What a reader sees for it."""
        return scenario_label(self.name) + (f", {self.way}" if self.way else "")

    @property
    def stem(self) -> str:
        """Its name as part of a file's name."""
        name = "".join(letter if letter.isalnum() else "_" for letter in self.name)
        return name if self.number == 1 else f"{name}_{self.number}"


def switches(envs: Float[np.ndarray, "time 2"] | None) -> list[int]:
    """Steps at which friction jumps, or the wind jumps between two steady levels (no gust's ramp)."""
    if envs is None or len(envs) < 2:
        return []
    friction, wind = np.abs(np.diff(envs, axis=0)).T
    steady = np.pad(wind, 1) < 1e-3
    jump = (friction > 0.02) | ((wind > 0.5) & steady[:-2] & steady[2:])
    return [int(step) + 1 for step in np.flatnonzero(jump)]


def hardest_step(scene: Scene) -> int:
    """The step of the first episode at which nominal (else whoever strays most) is furthest from its path."""
    rows = {
        name: np.nan_to_num(np.abs(values[0]), nan=0.0)
        for name, values in scene.lateral.items()
    }
    row = rows.get("nominal", max(rows.values(), key=np.max))
    return int(np.argmax(row))


def scenes_of(run: Path) -> list[Scene]:
    """What a run drove, the scenario with the most switches first; empty without an `episodes.npz`."""
    file = run / "episodes.npz"
    found = read_scenes(file) if file.exists() else []
    return sorted(found, key=lambda scene: len(switches(scene.envs)), reverse=True)


def read_scenes(path: Path) -> list[Scene]:
    """The scenes in an `episodes.npz` that have at least one lateral deviation, by scenario in order.

    A scene holds the systems that met the same road under the same controller.
    """
    arrays = read_npz(path)
    dt = float(arrays.pop("dt", 0.1))
    parts: dict[str, dict[str, np.ndarray]] = {}
    for name, values in arrays.items():
        drive, _, part = name.rpartition("/")
        parts.setdefault(drive, {})[part] = values
    together: dict[tuple[Any, ...], list[_Drive]] = {}
    for name, mine in parts.items():
        about = drive_of(name)
        if mine.get("lateral", np.zeros(0)).size:
            shared = parts.get(
                about.get("scenario", ""), {}
            )  # an earlier version kept one road a scenario
            road = {
                part: values[0]
                for part, values in (shared | mine).items()
                if part in ROAD and len(values)
            }
            same_road = tuple((part, road[part].tobytes()) for part in sorted(road))
            way = tuple(about.get(key) for key in SHARED)
            together.setdefault((way, same_road), []).append(_Drive(about, mine, road))
    scenes = [_scene(drives, dt) for drives in together.values()]
    counts = Counter(scene.name for scene in scenes)
    seen: Counter[str] = Counter()
    found = []
    usual = search_words({"sampling": "feedback"})
    for scene in sorted(
        scenes, key=lambda scene: (scene.name, scene.way != usual, scene.way)
    ):
        seen[scene.name] += 1
        way = scene.way if counts[scene.name] > 1 else ""
        found.append(scene._replace(way=way, number=seen[scene.name]))
    return found


class _Drive(NamedTuple):
    """Arrays of one row: what it is, what was driven, and the first episode's road."""

    about: dict[str, str]
    parts: dict[str, np.ndarray]
    road: dict[str, np.ndarray]


def _scene(drives: list[_Drive], dt: float) -> Scene:
    """Drives of one road as a scene; a system under two accesses to the environment is told apart."""
    drives = sorted(drives, key=lambda drive: drive.about.get("env") != "measured")
    lateral, states, controls = {}, {}, {}
    for about, parts, _ in drives:
        system = (
            about["system"]
            if about["system"] not in lateral
            else f"{about['system']} (e {about.get('env')})"
        )
        lateral[system] = parts["lateral"]
        for kind, kept in (("states", states), ("controls", controls)):
            if parts.get(kind, np.zeros(0)).size:
                kept[system] = parts[kind][0]
    about, _, road = drives[0]
    way = search_words(about)
    return Scene(
        about["scenario"],
        dt,
        road.get("envs"),
        road.get("path"),
        lateral,
        states,
        controls,
        way,
    )
