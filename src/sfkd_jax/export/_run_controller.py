"""Run the controller in this folder; requires jax, numpy and flatbuffers only.

    python run_controller.py --steps 20

checks the files and steps the controller in one place. In your own program:

    from run_controller import ExportedController

    controller = ExportedController("path/of/this/folder")
    state = controller.init(seed=0)
    control, state, info = controller.act(state, observation, env, reference)

Set JAX_COMPILATION_CACHE_DIR to a directory and
JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0 before the start, and later starts load
the compiled programs of the first one.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.export
import numpy as np

FORMAT = 3
"""Version of controller.json that this file reads."""
CELL = 2048.0
"""Spacing of the origins that positions are made relative to [m]."""
MALFORMED = (
    KeyError,
    TypeError,
    ValueError,
    IndexError,
    AttributeError,
    OverflowError,
    RecursionError,
)
"""Exceptions that a manifest of wrong content can raise."""


class ExportError(Exception):
    """A file of the export cannot be used; one line with its name and the reason."""

    def __init__(self, path: Path, reason: object) -> None:
        """Shorten to one printable line."""
        text = " ".join(f"{path}: {reason}".split())
        # A file may put anything into its message, also what moves a cursor.
        line = "".join(letter if letter.isprintable() else " " for letter in text)
        super().__init__(line[:500])


class ExportedController:
    """An exported controller, checked and compiled when it is constructed.

    Attributes:
        manifest: content of controller.json: names, shapes, units, limits, hashes and
            settings.
    """

    def __init__(self, folder: str | Path = Path(__file__).parent) -> None:
        """Read and compile the programs, or raise an ExportError with the reason."""
        path = Path(folder) / "controller.json"
        try:
            self.manifest = _manifest(path)
            self._init = _compiled(path.parent, self.manifest, "init")
            self._act = _compiled(path.parent, self.manifest, "act")
        except MALFORMED as error:
            reason = f"malformed, {type(error).__name__}: {error}"
            raise ExportError(path, reason) from None

    def init(self, seed: int = 0) -> dict[str, jax.Array]:
        """Return the state before the first step; `seed` determines all samples."""
        key = jax.random.key(seed, impl=str(self.manifest["key_implementation"]))
        return self._named("init", "state", self._init(jax.random.key_data(key)))

    def act(
        self,
        state: dict[str, jax.Array],
        observation: Any,
        env: Any,
        reference: Any,
        *,
        elapsed: float | None = None,
    ) -> tuple[jax.Array, dict[str, jax.Array], SimpleNamespace]:
        """Return (control, next state, info) of one control step.

        Values that are not finite are passed on; the controller then continues its last
        plan, and `info` reports it, such as `info.healthy` and `info.claim.bound`.
        Positions on Earth must be float64.

        Args:
            state: from `init` or the previous step.
            observation: the states that the manifest names, of a vehicle
                (p_x [m], p_y [m], yaw [rad], v [m/s], …).
            env: what the manifest names, such as (friction [-], lateral wind [m/s]).
            reference: of a vehicle (horizon, 4): x, y, yaw, speed at the next steps; in
                a lane a dict of all other inputs that the manifest lists. Of a system
                (horizon + 1, states): now and at the next steps.
            elapsed: sampling periods since the last call; None for one.
        """
        expected = self.manifest["programs"]["act"]["inputs"]
        inputs = self._inputs(expected, state, observation, env, reference)
        names = [name for name in inputs if not name.startswith("state.")]
        origin = np.zeros(2)
        places = self.manifest["places"]
        # As `sfkd_jax.relative`: before the cast, and never of what was float32 before.
        if places and min(inputs[name].dtype.itemsize for name in places) == 8:
            # The first point of what is ahead: the road, or the reference.
            first_point = inputs[names[2]][0, :2]
            first_point = np.nan_to_num(first_point, posinf=0.0, neginf=0.0)
            origin = CELL * np.round(first_point / CELL)
            for name in places:
                inputs[name] = _shifted(inputs[name], -origin)
        for leaf in expected:
            name = leaf["name"]
            if name in names:
                inputs[name] = inputs[name].astype(leaf["dtype"])
            elif name.endswith("tuning.elapsed") and elapsed is not None:
                inputs[name] = np.asarray(elapsed, np.float32)
        values = self._act(*inputs.values())
        after = self._named("act", "state", values)
        info = self._named("act", "info", values)
        self._warn_outside_box(info)
        if origin.any():
            for name in {"plan.states", "lane.reference"} & set(info):
                moved: Any = _shifted(info[name], origin)
                info[name] = moved
        return values[0], after, _nested(info)

    def _inputs(
        self,
        expected: list[dict[str, Any]],
        state: dict[str, jax.Array],
        observation: Any,
        env: Any,
        reference: Any,
    ) -> dict[str, Any]:
        """Return the inputs of the program by name, or raise a ValueError."""
        names = [
            leaf["name"] for leaf in expected if not leaf["name"].startswith("state.")
        ]
        measured = {"observation": observation, "env": env}
        if isinstance(reference, dict):
            measured.update(reference)
        else:
            measured[names[-1]] = reference
        if set(measured) != set(names):
            raise ValueError(f"inputs must be {names}, got {list(measured)}")
        inputs: dict[str, Any] = {}
        for name, value in state.items():
            inputs[f"state.{name}"] = value
        for name in names:
            inputs[name] = np.asarray(measured[name])
        # By name and order: two states may have the same shapes.
        if list(inputs) != [leaf["name"] for leaf in expected]:
            raise ValueError(
                "state must be what init or the last act of this controller returned"
            )
        for leaf in expected:
            name = leaf["name"]
            shape = tuple(leaf["shape"])
            if inputs[name].shape != shape:
                raise ValueError(
                    f"{name} must have shape {shape}, got {inputs[name].shape}"
                )
        return inputs

    def _warn_outside_box(self, info: dict[str, Any]) -> None:
        """Warn if e is outside its box, where no corridor holds."""
        if np.all(info.get("env_inside", True)):
            return
        box = self.manifest["environment"]
        rows = zip(box["names"], box["low"], box["high"], strict=True)
        limits = ", ".join(f"{name} {low:.3g} … {high:.3g}" for name, low, high in rows)
        # 3: `act` stands between this function and its caller.
        warnings.warn(f"e left {limits}: no corridor. The unit?", stacklevel=3)

    def _named(self, program: str, root: str, values: Any) -> dict[str, jax.Array]:
        """Return the outputs below `root` by name, without the prefix."""
        names = [leaf["name"] for leaf in self.manifest["programs"][program]["outputs"]]
        return {
            name.removeprefix(f"{root}."): value
            for name, value in zip(names, values, strict=True)
            if name.startswith(f"{root}.")
        }


def _nested(values: dict[str, Any]) -> SimpleNamespace:
    """Return values with names such as `plan.cost` as attributes of attributes."""
    root = SimpleNamespace()
    for name, value in values.items():
        *parts, last = name.split(".")
        node = root
        for part in parts:
            if not hasattr(node, part):
                setattr(node, part, SimpleNamespace())
            node = getattr(node, part)
        setattr(node, last, value)
    return root


def _shifted(states: Any, by: np.ndarray) -> np.ndarray:
    """Return states whose positions are moved by (x, y) [m], in float64."""
    moved = np.array(states, np.float64)
    moved[..., :2] += by
    return moved


def _manifest(path: Path) -> dict[str, Any]:
    """Return the content of controller.json, checked against its hash."""
    manifest = json.loads(_content(path))
    if manifest["kind"] != "controller":
        raise ExportError(path, "not the manifest of a controller")
    if manifest["format"] != FORMAT:
        raise ExportError(
            path, f"is of format {manifest['format']}, this file reads {FORMAT}"
        )
    hashed = {name: value for name, value in manifest.items() if name != "sha256"}
    text = json.dumps(hashed, sort_keys=True)
    if hashlib.sha256(text.encode()).hexdigest() != manifest["sha256"]:
        raise ExportError(path, "changed, its sha256 is not that of its content")
    return manifest


def _compiled(folder: Path, manifest: dict[str, Any], name: str) -> Any:
    """Return a program of the export, compiled for the default device."""
    program = manifest["programs"][name]
    path = folder / program["file"]
    content = _content(path)
    if hashlib.sha256(content).hexdigest() != program["sha256"]:
        raise ExportError(path, "changed, its sha256 is not that of the manifest")
    try:
        exported = jax.export.deserialize(bytearray(content))
        inputs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in exported.in_avals]
        compiled = jax.jit(exported.call).lower(*inputs).compile()
    except Exception as error:  # a blob of another version raises nearly anything
        written = f"written by jax {manifest['jax']}, refused by {jax.__version__}"
        raise ExportError(path, f"{written}: {error}") from None
    return compiled


def _content(path: Path) -> bytes:
    """Return the content of a file."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ExportError(path, error.strerror) from None


def main() -> None:
    """Step the controller in one place and print its controls."""
    parser = argparse.ArgumentParser(
        description="Check an exported controller and step it in one place."
    )
    parser.add_argument("folder", nargs="?", default=Path(__file__).parent, type=Path)
    parser.add_argument("--steps", default=10, type=int)
    arguments = parser.parse_args()
    try:
        controller = ExportedController(arguments.folder)
        manifest = controller.manifest
        measured = (
            _at_operating_point(manifest)
            if "operating_point" in manifest
            else _straight(manifest)
        )
        names = [entry["name"] for entry in manifest["controls"]]
    except (ExportError, *MALFORMED) as reason:
        sys.exit(f"run_controller: {type(reason).__name__}: {reason}")
    state = controller.init()
    controls = []
    times = []
    # Nothing moves: what is checked is the program, not the driving.
    for _ in range(arguments.steps):
        began = time.perf_counter()
        control, state, _ = controller.act(state, *measured)
        controls.append(np.asarray(control).tolist())
        times.append(1e3 * (time.perf_counter() - began))
    result = {
        "names": names,
        "controls": controls,
        "median_ms": float(np.median(times)),
    }
    print(json.dumps(result))


def _at_operating_point(
    manifest: dict[str, Any],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the inputs of a system at a reference that does not move."""
    point = manifest["operating_point"]
    box = manifest["environment"]
    rows = manifest["horizon"] + 1
    return (
        np.asarray(point["observation"], np.float32),
        np.mean([box["low"], box["high"]], axis=0),
        np.tile(np.asarray(point["reference"], np.float32), (rows, 1)),
    )


def _straight(manifest: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, Any]:
    """Return the inputs of a car 0.3 m beside a straight road, after the state.

    These are observation, environment and reference; in a lane the last is a dict of
    all other inputs.
    """
    speed = 10.0
    leaves = manifest["programs"]["act"]["inputs"]
    ahead = {
        leaf["name"]: np.zeros(leaf["shape"], leaf["dtype"])
        for leaf in leaves
        if not leaf["name"].startswith("state.")
    }
    observation = ahead.pop("observation")
    observation[1] = 0.3
    observation[3] = speed
    del ahead["env"]
    if "reference" in ahead:
        points = ahead["reference"]
        points[:, 3] = speed
        spacing = speed * manifest["sampling_period_s"]
    else:
        # A free lane: 5 m to each side, and no obstacle is present.
        points = ahead["road"]
        spacing = 0.5
        ahead["spacing"] = np.asarray(spacing)
        for name in ("left", "right"):
            ahead[name] = ahead[name] + 5.0
        ahead["speed"] = ahead["speed"] + speed
    points[:, 0] = spacing * np.arange(1, len(points) + 1)
    box = manifest["environment"]
    return observation, np.mean([box["low"], box["high"]], axis=0), ahead


if __name__ == "__main__":
    main()
