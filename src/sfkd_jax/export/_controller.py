"""Write a controller as programs of flat arrays: StableHLO, and IREE made from it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sfkd_jax import policy, store
from sfkd_jax.driving.lanes import Lane, Obstacles
from sfkd_jax.driving.path_following import InLane, moved_on
from sfkd_jax.driving.paths import Path as Road
from sfkd_jax.driving.sizes import length_scale
from sfkd_jax.export._programs import (
    Program,
    Shape,
    compile_iree,
    flat_programs,
    key_implementation,
)
from sfkd_jax.export._proof import CHECKER, DOCUMENT, exported_proof
from sfkd_jax.policy import Policy, SystemPolicy
from sfkd_jax.ranges import MayBeEmpty, Names, Positive
from sfkd_jax.types import Controller

FORMAT = 3
"""Version of the manifest and of the order of arguments; run_controller.py reads no
other version.
"""
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
FILES = {"act": "controller", "init": "initial_state"}
"""Program -> the name of its files, without a suffix."""
PLACES = ("observation", "reference", "road", "position")
"""Inputs of a vehicle that begin with x and y [m]."""
MANIFEST = "controller.json"
SCRIPT = "run_controller.py"
"""The program in the export that runs it without sfkd_jax."""


def write_controller(
    trained: Policy | SystemPolicy,
    folder: Path,
    *,
    platforms: tuple[str, ...] = ("cpu", "cuda"),
    lane: Annotated[tuple[int, ...], MayBeEmpty()] = (),
    car: tuple[Positive, Positive] | None = None,
    iree: bool = False,
    iree_flags: Names = ("--iree-llvmcpu-target-cpu=host",),
) -> dict[str, Any]:
    """Write a controller for processes without sfkd_jax, and return its manifest.

    Args:
        trained: the policy.
        folder: to write; an earlier export in it is replaced.
        platforms: some of `PLATFORMS`, for which the programs are compiled.
        lane: (points of the road, obstacles, predicted steps of each) for a controller
            that drives in a lane; () for one that follows a reference.
        car: length and width of the car [m], for a lane; None for those of the vehicle.
        iree: whether to compile for C and C++ as well.
        iree_flags: for iree-compile.
    """
    if not platforms or not set(platforms) <= set(PLATFORMS):
        raise ValueError(
            f"export.platforms must be some of {', '.join(PLATFORMS)}, "
            f"got {list(platforms)}"
        )
    # Everything that can refuse comes before the first file is written.
    ahead = None
    is_system = isinstance(trained, SystemPolicy)
    if lane:
        if is_system:
            raise ValueError("export.lane is for vehicles, and this is a system")
        car = car or trained.vehicle.size
        trained, ahead = in_window(trained, lane, car)
    programs = flat_programs(trained, ahead)
    exported = {name: program.lower(*platforms) for name, program in programs.items()}
    modules = _compile_all_for_iree(programs, iree_flags) if iree else {}
    proof = exported_proof(trained)
    names = [leaf.name for leaf in programs["act"].inputs]
    places = [] if is_system else [name for name in PLACES if name in names]
    _remove_earlier_export(folder)
    # The policy too, so that `load` reads an export as it reads a run.
    saved = trained.save(folder)
    manifest = {
        "kind": "controller",
        "format": FORMAT,
        "jax": jax.__version__,
        "calling_convention_version": exported["act"].calling_convention_version,
        "platforms": list(platforms),
        "key_implementation": key_implementation(),
        "programs": {
            name: _write_program(folder, name, program, programs[name])
            for name, program in exported.items()
        },
        "iree": _write_modules(folder, modules) or None,
        "iree_flags": list(iree_flags) if iree else None,
        "proof": _write_proof(folder, proof) if proof else None,
        **saved._asdict(),
        **trained.interface,
        "places": places,
        "car_m": list(car) if lane and car else None,
        "parameters": sum(np.size(leaf) for leaf in jax.tree.leaves(trained.weights)),
        "settings": trained.settings,
        "versions": store.versions(),
    }
    store.write_bytes(folder / SCRIPT, _source(f"_{SCRIPT}"))
    # Last: a folder with a manifest is whole.
    manifest["sha256"] = store.sha256(manifest)
    store.write_json(folder / MANIFEST, manifest)
    return manifest


def _compile_all_for_iree(
    programs: Mapping[str, Program], flags: Sequence[str]
) -> dict[str, bytes]:
    """Return the IREE module of each program, by its name."""
    return {
        name: compile_iree(program.lower("cpu").mlir_module(), flags)
        for name, program in programs.items()
    }


def _remove_earlier_export(folder: Path) -> None:
    """Remove what would belong to another export than the one that is written next.

    The manifest goes first: a folder without it is no export.
    """
    modules = [f"{file}.vmfb" for file in FILES.values()]
    for name in (MANIFEST, policy.CERTIFICATE, DOCUMENT, CHECKER, *modules):
        (folder / name).unlink(missing_ok=True)


def _write_program(
    folder: Path, name: str, exported: jax.export.Exported, program: Program
) -> dict[str, Any]:
    """Write a program as StableHLO, and return its entry in the manifest."""
    path = folder / f"{FILES[name]}.stablehlo"
    return {
        **_write(path, bytes(exported.serialize())),
        "inputs": [leaf._asdict() for leaf in program.inputs],
        "outputs": [leaf._asdict() for leaf in program.outputs],
    }


def _write_modules(folder: Path, modules: Mapping[str, bytes]) -> dict[str, Any]:
    """Write IREE modules, and return their entries in the manifest."""
    return {
        name: _write(folder / f"{FILES[name]}.vmfb", module)
        for name, module in modules.items()
    }


def _write_proof(folder: Path, proof: bytes) -> dict[str, Any]:
    """Write a proof with the program that checks it, and return its entry."""
    store.write_bytes(folder / CHECKER, _source(CHECKER))
    return _write(folder / DOCUMENT, proof)


def _source(name: str) -> bytes:
    """Return a file of this package that an export has as it is."""
    return resources.files("sfkd_jax.export").joinpath(name).read_bytes()


def _write(path: Path, content: bytes) -> dict[str, Any]:
    """Write a file and return its name, size and hash."""
    store.write_bytes(path, content)
    digest = hashlib.sha256(content).hexdigest()
    return {"file": path.name, "bytes": len(content), "sha256": digest}


def in_window(
    trained: Policy, lane: Sequence[int], car: tuple[float, float]
) -> tuple[Policy, dict[str, Shape]]:
    """Return a policy in its lane that takes a scene as arrays, and their shapes.

    The road is a window of points. `moved` is by how many of them the window has moved
    on since the step before. It must reach from behind the car to beyond what is
    planned, or the car stops at its end.

    Args:
        trained: the policy.
        lane: (points of the road, obstacles, predicted steps of each).
        car: length and width of the car [m].
    """
    if len(lane) != 3 or min(lane) < 1:
        raise ValueError(
            "export.lane must be [points of the road, obstacles, predicted steps], "
            f"got {list(lane)}"
        )
    points, obstacles, steps = lane
    driver = trained.in_lane(car=(car[0], car[1]))
    apart = length_scale(trained.vehicle.wheelbase) * InLane.spacing
    shapes: dict[str, tuple[int, ...]] = {
        "road": (points, 4),
        "spacing": (),
        "left": (points,),
        "right": (points,),
        "speed": (points,),
        "position": (obstacles, steps, 2),
        "yaw": (obstacles,),
        "half": (obstacles, 2),
        "radius": (obstacles,),
        "present": (obstacles,),
        "moved": (),
    }

    def act(
        params: Any, state: Any, observation: Any, env: Any, *ahead: Array
    ) -> tuple[Any, Any, Any]:
        road, spacing, left, right, speed, *obstacles, moved = ahead
        window = Road(road, spacing)
        scene = Lane(window, left, right, speed), Obstacles(*obstacles)
        state = moved_on(state, window, moved, apart)
        return driver.act(params, state, observation, env, scene)

    dtypes = {"present": bool, "moved": jnp.int32}
    ahead = {
        name: Shape(shape, dtypes.get(name, jnp.float32))
        for name, shape in shapes.items()
    }
    return replace(trained, controller=Controller(driver.init, act)), ahead
