"""What was driven in one scenario, as it lies in `episodes.npz`, and where its hard moments are."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sfkd_jax.artefacts import read_npz


class Scene(NamedTuple):
    """One scenario as it was driven; only the first episode's tracks are kept.

    Attributes:
        name: of the scenario. dt: sampling period [s].
        envs: friction, wind of the first episode, (time, 2). path: x, y, yaw, curvature of it, (point, 4).
        lateral: by system, signed deviation of x_1 … x_T [m], left positive, (episode, time).
        states: by system, (time + 1, state). controls: by system, (time, control).
    """

    name: str
    dt: float
    envs: Float[np.ndarray, "time 2"] | None
    path: Float[np.ndarray, "point 4"] | None
    lateral: dict[str, Float[np.ndarray, "episode time"]]
    states: dict[str, Float[np.ndarray, "time_plus_1 state"]]
    controls: dict[str, Float[np.ndarray, "time control"]]


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
    rows = {name: np.nan_to_num(np.abs(values[0]), nan=0.0) for name, values in scene.lateral.items()}
    row = rows.get("nominal", max(rows.values(), key=np.max))
    return int(np.argmax(row))


def scenes_of(run: Path) -> list[Scene]:
    """What a run drove, the scenario with the most switches first; empty without an `episodes.npz`."""
    file = run / "episodes.npz"
    found = read_scenes(file).values() if file.exists() else []
    return sorted(found, key=lambda scene: len(switches(scene.envs)), reverse=True)


def read_scenes(path: Path) -> dict[str, Scene]:
    """The scenarios in an `episodes.npz` that have at least one lateral deviation, by name in order."""
    arrays = read_npz(path)
    dt = float(arrays.pop("dt", 0.1))
    parts = [(*name.split("/"), values) for name, values in arrays.items()]
    found: dict[str, Scene] = {}
    for name in sorted({part[1] for part in parts if len(part) == 4}):
        driven = {
            kind: {part[0]: part[3] for part in parts if len(part) == 4 and part[1:3] == (name, kind)}
            for kind in ("lateral", "states", "controls")
        }
        road = {part[1]: part[2][0] for part in parts if len(part) == 3 and part[0] == name and len(part[2])}
        lateral = {system: values for system, values in driven["lateral"].items() if values.size}
        first = [{key: rows[0] for key, rows in driven[kind].items() if rows.size} for kind in ("states", "controls")]
        if lateral:
            found[name] = Scene(name, dt, road.get("envs"), road.get("path"), lateral, *first)
    return found
