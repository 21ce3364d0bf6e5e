"""Run the controller in this folder; requires jax, numpy and flatbuffers only.

    python run_controller.py --steps 20

checks the files and steps the controller on a straight road. In your own program:

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
from pathlib import Path
from typing import Any

import jax
import jax.export
import numpy as np

FORMAT = 2
"""Version of controller.json that this file reads."""
MAX_BYTES = 1 << 24
"""Size of controller.json, which has about 20 kB."""
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


class ExportedController:
    """An exported controller, checked and compiled when it is constructed.

    Attributes:
        manifest: content of controller.json: names, shapes, units, limits, hashes and
            settings.
    """

    def __init__(self, folder: str | Path = Path(__file__).parent) -> None:
        """Read and compile the programs.

        Args:
            folder: of the export.

        Raises:
            ExportError: a file is missing, no regular file, truncated, changed,
                malformed, or made for another jax or platform.
        """
        path = Path(folder) / "controller.json"
        self.manifest = _manifest(path)
        try:
            self._init, self._act = (
                _compiled(path.parent, self.manifest, name) for name in ("init", "act")
            )
            key, first = self._key(0), self.manifest["programs"]["init"]["inputs"][0]
            if (
                not isinstance(self.manifest["key_implementation"], str)
                or key.shape != tuple(first["shape"])
                or str(key.dtype) != first["dtype"]
            ):
                raise ValueError("key_implementation")
        except MALFORMED as error:
            raise ExportError(
                _line(f"{path}: malformed, {type(error).__name__}: {error}")
            ) from None

    def init(self, seed: int = 0) -> dict[str, jax.Array]:
        """Return the state before the first step; `seed` determines all samples."""
        return self._named("init", "state", self._init(self._key(seed)))

    def act(
        self, state: dict[str, jax.Array], observation: Any, env: Any, reference: Any
    ) -> tuple[jax.Array, dict[str, jax.Array], dict[str, jax.Array]]:
        """Return (control, next state, info) of one control step.

        Values that are not finite are passed on; the controller then continues its last
        plan, and `info` reports it.

        Args:
            state: from `init` or the previous step.
            observation: (p_x [m], p_y [m], yaw [rad], v [m/s], …).
            env: (friction [-], lateral wind [m/s]).
            reference: (horizon, 4): x, y, yaw, speed at the next steps.

        Raises:
            ValueError: an argument of the wrong shape, or a state of another
                controller.
        """
        measured = {"observation": observation, "env": env, "reference": reference}
        given = {f"state.{name}": value for name, value in state.items()}
        given |= {
            name: np.asarray(value, dtype=np.float32)
            for name, value in measured.items()
        }
        expected = self.manifest["programs"]["act"]["inputs"]
        if list(given) != [leaf["name"] for leaf in expected]:
            raise ValueError(
                "state must be what init or the last act of this controller returned"
            )
        for leaf, value in zip(expected, given.values(), strict=True):
            if value.shape != tuple(leaf["shape"]):
                raise ValueError(
                    f"{leaf['name']} must have shape {tuple(leaf['shape'])}, "
                    f"got {value.shape}"
                )
        outputs = self._act(*given.values())
        return (
            outputs[0],
            self._named("act", "state", outputs),
            self._named("act", "info", outputs),
        )

    def _key(self, seed: int) -> jax.Array:
        """Return the data of a random key."""
        return jax.random.key_data(
            jax.random.key(seed, impl=self.manifest["key_implementation"])
        )

    def _named(self, program: str, root: str, values: Any) -> dict[str, jax.Array]:
        """Return the outputs below `root` by name, without the prefix."""
        names = [leaf["name"] for leaf in self.manifest["programs"][program]["outputs"]]
        pairs = zip(names, values, strict=True)
        return {
            name.removeprefix(f"{root}."): value
            for name, value in pairs
            if name.startswith(f"{root}.")
        }


def _manifest(path: Path) -> dict[str, Any]:
    """Return the content of controller.json, checked against its hash."""
    try:
        manifest = json.loads(_content(path, MAX_BYTES).decode())
        if not isinstance(manifest, dict) or manifest.get("kind") != "controller":
            raise ExportError(f"{path}: not the manifest of a controller")
        if manifest.get("format") != FORMAT:
            raise ExportError(
                _line(
                    f"{path}: is of format {manifest.get('format')}, "
                    f"this file reads {FORMAT}"
                )
            )
        hashed = {name: value for name, value in manifest.items() if name != "sha256"}
        digest = hashlib.sha256(
            json.dumps(hashed, sort_keys=True, allow_nan=False).encode()
        ).hexdigest()
    except (ValueError, RecursionError):
        raise ExportError(f"{path}: truncated or not JSON") from None
    if digest != manifest.get("sha256"):
        raise ExportError(f"{path}: changed, its sha256 is not that of its content")
    return manifest


def _compiled(folder: Path, manifest: dict[str, Any], name: str) -> Any:
    """Return a program of the export, compiled for the default device."""
    program = manifest["programs"][name]
    if Path(program["file"]).name != program["file"] or program["file"] in ("", ".."):
        raise ValueError(
            f"{program['file']!r} is not the name of a file in this folder"
        )
    path = folder / program["file"]
    content = _content(path, int(program["bytes"]))
    if len(content) < program["bytes"]:
        raise ExportError(
            f"{path}: truncated, {len(content)} of {program['bytes']} bytes"
        )
    digest = hashlib.sha256(content).hexdigest()
    if digest != program["sha256"]:
        raise ExportError(
            f"{path}: changed, sha256 {digest[:12]}, recorded {program['sha256'][:12]}"
        )
    try:
        exported = jax.export.deserialize(bytearray(content))
        inputs = [
            jax.ShapeDtypeStruct(value.shape, value.dtype)
            for value in exported.in_avals
        ]
        compiled = jax.jit(exported.call).lower(*inputs).compile()
    except Exception as error:  # a blob of another version raises nearly anything
        written = f"written by jax {manifest['jax']}, refused by {jax.__version__}"
        raise ExportError(_line(f"{path}: {written}: {error}")) from None
    for side, values in (
        ("inputs", exported.in_avals),
        ("outputs", exported.out_avals),
    ):
        listed = [
            (type(leaf["name"]), tuple(leaf["shape"]), leaf["dtype"])
            for leaf in program[side]
        ]
        if listed != [(str, value.shape, str(value.dtype)) for value in values]:
            raise ExportError(f"{path}: has other {side} than its manifest")
    return compiled


def _content(path: Path, most: int) -> bytes:
    """Return the content of a regular file of at most `most` bytes."""
    try:
        # Opening anything else, such as a pipe, could wait for ever.
        if path.exists() and not path.is_file():
            raise ExportError(f"{path}: not a regular file")
        if (size := path.stat().st_size) > most:
            raise ExportError(f"{path}: {size} bytes, at most {most} belong to it")
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: an impossible file name
        reason = getattr(error, "strerror", None) or error
        raise ExportError(_line(f"{path}: {reason}")) from None


def _line(text: str) -> str:
    """Shorten a message to one printable line."""
    return "".join(
        letter if letter.isprintable() else " " for letter in " ".join(text.split())
    )[:500]


def main() -> None:
    """Step the controller at a fixed observation and print its controls."""
    parser = argparse.ArgumentParser(
        description="Check an exported controller and step it on a straight road."
    )
    parser.add_argument("folder", nargs="?", default=Path(__file__).parent, type=Path)
    parser.add_argument("--steps", default=10, type=int)
    parser.add_argument("--seed", default=0, type=int)
    arguments = parser.parse_args()
    try:
        controller = ExportedController(arguments.folder)
        observation, env, reference = _straight(controller.manifest)
        names = [entry["name"] for entry in controller.manifest["controls"]]
    except ExportError as reason:
        sys.exit(f"run_controller: {reason}")
    except MALFORMED as reason:
        message = f"malformed, {type(reason).__name__}: {reason}"
        sys.exit(_line(f"run_controller: {arguments.folder}: {message}"))
    state, controls, times = controller.init(arguments.seed), [], []
    for _ in range(arguments.steps):
        began = time.perf_counter()
        control, state, _ = controller.act(state, observation, env, reference)
        controls.append(np.asarray(control).tolist())
        times.append(1e3 * (time.perf_counter() - began))
    print(
        json.dumps(
            {"names": names, "controls": controls, "median_ms": float(np.median(times))}
        )
    )


def _straight(manifest: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observation, environment and reference of a car 0.3 m beside a straight road."""
    *_, observed, _, ahead = manifest["programs"]["act"]["inputs"]
    speed, observation = 10.0, np.zeros(observed["shape"])
    observation[1], observation[3] = 0.3, speed
    reference = np.zeros(ahead["shape"])
    reference[:, 0] = (
        speed * manifest["sampling_period_s"] * np.arange(1, len(reference) + 1)
    )
    reference[:, 3] = speed
    env = np.mean(
        [manifest["environment"]["low"], manifest["environment"]["high"]], axis=0
    )
    return observation, env, reference


if __name__ == "__main__":
    main()
