"""Run the controller in this folder. Needs jax, numpy and flatbuffers; nothing else.

    python run_controller.py --steps 20

checks the files and steps the controller on a straight road. In your own program:

    from run_controller import ExportedController

    controller = ExportedController("path/of/this/folder")
    state = controller.init(seed=0)
    control, state, info = controller.act(state, observation, env, reference)

Set JAX_COMPILATION_CACHE_DIR to a directory and JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0 before the start, and
later starts read back what the first one compiled.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.export
import numpy as np

FORMAT = 1
"""Version of controller.json that this file reads."""


class ExportError(Exception):
    """A file of the export that cannot be used: its name and the reason, in one line."""


class ExportedController:
    """A controller as it was exported: checked, deserialised and compiled once, when it is made.

    Attributes:
        manifest: what controller.json says: names, shapes, units, limits, hashes, settings.
    """

    def __init__(self, folder: str | Path = Path(__file__).parent) -> None:
        """Read and compile.

        Raises:
            ExportError: a file is missing, truncated, changed, or made for another jax or platform.
        """
        folder = Path(folder)
        self.manifest = _manifest(folder / "controller.json")
        self._init, self._act = (_compiled(folder, self.manifest, name) for name in ("init", "act"))

    def init(self, seed: int = 0) -> dict[str, jax.Array]:
        """The state before the first step; the seed fixes all samples that will be drawn."""
        key = jax.random.key(seed, impl=self.manifest["key_implementation"])
        return self._named("init", "state", self._init(jax.random.key_data(key)))

    def act(
        self, state: dict[str, jax.Array], observation: Any, env: Any, reference: Any
    ) -> tuple[jax.Array, dict[str, jax.Array], dict[str, jax.Array]]:
        """One control step: (control, next state, info).

        Values that are not finite are passed on; the controller then continues its last plan and `info` says so.

        Args:
            state: from `init` or the step before. observation: (p_x [m], p_y [m], yaw [rad], v [m/s], …).
            env: (friction [-], lateral wind [m/s]). reference: (horizon, 4): x, y, yaw, speed at the next steps.

        Raises:
            ValueError: an argument of the wrong shape, or a state that is not of this controller.
        """
        measured = {"observation": observation, "env": env, "reference": reference}
        given = {f"state.{name}": value for name, value in state.items()}
        given |= {name: np.asarray(value, dtype=np.float32) for name, value in measured.items()}
        expected = self.manifest["programs"]["act"]["inputs"]
        if list(given) != [leaf["name"] for leaf in expected]:
            raise ValueError("state must be what init or the last act of this controller returned")
        for leaf, value in zip(expected, given.values(), strict=True):
            if value.shape != tuple(leaf["shape"]):
                raise ValueError(f"{leaf['name']} must have shape {tuple(leaf['shape'])}, got {value.shape}")
        found = self._act(*given.values())
        return found[0], self._named("act", "state", found), self._named("act", "info", found)

    def _named(self, program: str, root: str, values: Any) -> dict[str, jax.Array]:
        """The results of a program whose names begin with `root`, without it."""
        names = [leaf["name"] for leaf in self.manifest["programs"][program]["outputs"]]
        pairs = zip(names, values, strict=True)
        return {name.removeprefix(f"{root}."): value for name, value in pairs if name.startswith(f"{root}.")}


def _manifest(path: Path) -> dict[str, Any]:
    """What controller.json says, if it is one."""
    try:
        manifest = json.loads(_content(path))
    except ValueError:
        raise ExportError(f"{path}: truncated or not JSON") from None
    if not isinstance(manifest, dict) or manifest.get("kind") != "controller":
        raise ExportError(f"{path}: not the manifest of a controller")
    if manifest.get("format") != FORMAT:
        raise ExportError(f"{path}: is of format {manifest.get('format')}, this file reads {FORMAT}")
    return manifest


def _compiled(folder: Path, manifest: dict[str, Any], name: str) -> Any:
    """A program of the export, compiled for the device that jax uses by itself."""
    program = manifest["programs"][name]
    path = folder / program["file"]
    content = _content(path)
    if len(content) < program["bytes"]:
        raise ExportError(f"{path}: truncated, {len(content)} of {program['bytes']} bytes")
    digest = hashlib.sha256(content).hexdigest()
    if digest != program["sha256"]:
        raise ExportError(f"{path}: changed, sha256 {digest[:12]}, recorded {program['sha256'][:12]}")
    inputs = [jax.ShapeDtypeStruct(tuple(leaf["shape"]), leaf["dtype"]) for leaf in program["inputs"]]
    try:
        return jax.jit(jax.export.deserialize(bytearray(content)).call).lower(*inputs).compile()
    except Exception as error:  # a blob of another version raises nearly anything
        reason = " ".join(str(error).split())[:200]
        raise ExportError(f"{path}: written by jax {manifest['jax']}, refused by {jax.__version__}: {reason}") from None


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror}") from None


def main() -> None:
    """Step the controller as if it stood still beside a straight road, and print what it does."""
    parser = argparse.ArgumentParser(description="Check an exported controller and step it on a straight road.")
    parser.add_argument("folder", nargs="?", default=Path(__file__).parent, type=Path)
    parser.add_argument("--steps", default=10, type=int)
    parser.add_argument("--seed", default=0, type=int)
    asked = parser.parse_args()
    try:
        controller = ExportedController(asked.folder)
    except ExportError as reason:
        sys.exit(f"run_controller: {reason}")
    manifest, speed = controller.manifest, 10.0
    ahead = speed * manifest["sampling_period_s"] * np.arange(1, manifest["horizon"] + 1)
    reference = np.stack([ahead, 0 * ahead, 0 * ahead, np.full_like(ahead, speed)], axis=1)
    observation = np.zeros(len(manifest["observation"]))
    observation[1], observation[3] = 0.3, speed
    env = np.mean([manifest["environment"]["low"], manifest["environment"]["high"]], axis=0)
    state, controls, times = controller.init(asked.seed), [], []
    for _ in range(asked.steps):
        began = time.perf_counter()
        control, state, _ = controller.act(state, observation, env, reference)
        controls.append(np.asarray(control).tolist())
        times.append(1e3 * (time.perf_counter() - began))
    names = [entry["name"] for entry in manifest["controls"]]
    print(json.dumps({"names": names, "controls": controls, "median_ms": float(np.median(times))}))


if __name__ == "__main__":
    main()
