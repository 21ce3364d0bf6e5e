"""Write the export folder: programs, manifest, weights and a script that runs them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sfkd_jax import build, policy, store
from sfkd_jax.export._programs import compile_iree, flat_programs
from sfkd_jax.ranges import Names

FORMAT = 2
"""Version of the manifest and of the order of arguments; run_controller.py reads no
other version.
"""
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
FILES = {"act": "controller", "init": "initial_state"}
MANIFEST, CERTIFICATE = "controller.json", "certificate.json"
SCRIPT = "run_controller.py"


def write_controller(
    trained: policy.Policy,
    folder: Path,
    *,
    made_from: Mapping[str, str],
    platforms: tuple[str, ...] = ("cpu", "cuda"),
    iree: bool = False,
    iree_flags: Names = ("--iree-llvmcpu-target-cpu=host",),
) -> dict[str, Any]:
    """Write a controller for processes without sfkd_jax, and return its manifest.

    The manifest is written last.

    Args:
        trained: the policy to export.
        folder: to write; an earlier export in it is replaced.
        made_from: hashes of the artefacts that the weights were made from.
        platforms: that the programs are compiled for.
        iree: whether to compile for C and C++ as well.
        iree_flags: for iree-compile.

    Raises:
        ValueError: unknown platform, a controller that cannot be exported, or IREE
            missing or failing.
        ArtefactError: the folder is not writable.
    """
    if not platforms or not set(platforms) <= set(PLATFORMS):
        raise ValueError(
            f"export.platforms must be some of {', '.join(PLATFORMS)}, "
            f"got {list(platforms)}"
        )
    # Everything that can refuse comes before the first file is written.
    flat = flat_programs(trained)
    programs = {name: getattr(flat, name) for name in FILES}
    modules = {
        name: compile_iree(program, flags=iree_flags)
        for name, program in programs.items()
        if iree
    }
    exported = {name: one.lower(*platforms) for name, one in programs.items()}
    # First the manifest goes: a folder half written is none.
    for stale in (MANIFEST, CERTIFICATE, *(f"{stem}.vmfb" for stem in FILES.values())):
        (folder / stale).unlink(missing_ok=True)
    # The policy too, so that `load` reads an export as it reads a run.
    stored = policy.save(
        folder / "policy.safetensors",
        trained.weights,
        trained.settings,
        made_from=made_from,
    )
    manifest = {
        "kind": "controller",
        "format": FORMAT,
        "jax": jax.__version__,
        "calling_convention_version": exported["act"].calling_convention_version,
        "platforms": list(platforms),
        "key_implementation": flat.key_implementation,
        "programs": {
            name: _write(
                folder / f"{FILES[name]}.stablehlo", bytes(exported[name].serialize())
            )
            | {
                "inputs": [leaf._asdict() for leaf in program.inputs],
                "outputs": [leaf._asdict() for leaf in program.outputs],
            }
            for name, program in programs.items()
        },
        "iree": {
            name: _write(folder / f"{FILES[name]}.vmfb", module)
            for name, module in modules.items()
        }
        or None,
        "iree_flags": list(iree_flags) if iree else None,
        "weights_sha256": stored["sha256"],
        "certificate_sha256": _certificate(trained, folder, stored["content_sha256"]),
        **_vehicle(trained),
        "parameters": sum(np.size(leaf) for leaf in jax.tree.leaves(trained.weights)),
        "settings": trained.settings,
        "versions": store.versions(),
    }
    script = resources.files("sfkd_jax.export").joinpath(f"_{SCRIPT}").read_bytes()
    store.write_bytes(folder / SCRIPT, script)
    # Last: a folder with a manifest is whole.
    manifest["sha256"] = store.sha256(manifest)
    store.write_json(folder / MANIFEST, manifest)
    return manifest


def _write(path: Path, content: bytes) -> dict[str, Any]:
    """Write a file and return its name, size and hash."""
    store.write_bytes(path, content)
    return {
        "file": path.name,
        "bytes": len(content),
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def _certificate(
    trained: policy.Policy, folder: Path, policy_sha256: str
) -> str | None:
    """Copy the verified certificate of a policy, if any, and return the file's hash.

    The copy refers to the settings as exported, perhaps with another controller.
    """
    if trained.certificate is None:
        return None
    store.write_json(
        folder / CERTIFICATE, trained.certificate | {"policy_sha256": policy_sha256}
    )
    return hashlib.sha256((folder / CERTIFICATE).read_bytes()).hexdigest()


def _vehicle(trained: policy.Policy) -> dict[str, Any]:
    """Names, units and limits of controls, observation, environment and reference."""
    settings = trained.settings
    plant = build.build_vehicle(settings["vehicle"])
    # With a speed loop the second control is what the loop is given.
    drive = "speed command [m/s]" if plant.speed_loop else "acceleration [m/s^2]"
    limits = zip(
        ("steering [rad]", drive), plant.control_low, plant.control_high, strict=True
    )
    box = {side: list(settings["environment"][side]) for side in ("low", "high")}
    return {
        "sampling_period_s": plant.dt,
        "horizon": build.controller_horizon(settings["controller"]),
        "controls": [
            {"name": name, "low": low, "high": high} for name, low, high in limits
        ],
        "observation": list(plant.state_names),
        "environment": {"names": ["friction [-]", "lateral wind [m/s]"], **box},
        "reference": ["x [m]", "y [m]", "yaw [rad]", "speed [m/s]"],
    }
