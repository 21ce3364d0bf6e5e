"""Show versions, devices and extras, with advice on what is missing."""

from __future__ import annotations

import os
import shutil
import time
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from sfkd_jax import artefacts
from sfkd_jax.cli.entry import hydra_command

CORE = (
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "orbax-checkpoint",
    "hydra-core",
    "numpy",
    "scipy",
    "matplotlib",
)
EXTRAS = {
    "certify": ("cvxpy", "clarabel"),
    "brax": ("brax",),
    "gym": ("gymnasium",),
    "parquet": ("pyarrow",),
    "docs": ("mkdocs", "material", "mkdocstrings"),
    "plants": ("vehiclemodels",),
    "cpp": ("iree.compiler", "iree.runtime"),
    "sweeps": (
        "hydra_plugins.hydra_joblib_launcher",
        "hydra_plugins.hydra_optuna_sweeper",
        "submitit",
    ),
}
"""Extra -> the modules that it must bring."""
ROOM_MB = 500
"""What data sets, checkpoints and reports of one experiment need at most."""


def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Look, print what was found with advice, return it.

    Raises:
        ValueError: jax cannot compute here.
    """
    found = artefacts.versions() | {name: _version(name) for name in CORE}
    print("  ".join(f"{name} {version}" for name, version in found.items()))
    devices = [f"{device.platform}: {device.device_kind}" for device in jax.devices()]
    print(f"devices: {', '.join(devices)}; {_cores()} processor cores for this process")
    seconds = _computes()
    print(f"compiles and computes: yes, in {seconds:.1f} s")
    extras = {name: _extra(modules) for name, modules in EXTRAS.items()}
    for name, reason in extras.items():
        print(
            f"extra {name}: {reason or 'works'}"
            + (f'; pip install "sfkd-jax[{name}]"' if reason else "")
        )
    advice = _advice(Path(settings["root"]), devices)
    for line in advice:
        print(f"advice: {line}")
    working = [name for name, reason in extras.items() if reason is None]
    return {
        "versions": found,
        "devices": devices,
        "extras": working,
        "advice": advice,
        "seconds": seconds,
    }


def _cores() -> int | None:
    return (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count()
    )


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "missing"


def _extra(modules: tuple[str, ...]) -> str | None:
    """Why an extra does not work; None if it does. A package may be there and broken, so each is imported."""
    for module in modules:
        try:
            import_module(module)
        except ModuleNotFoundError as absent:
            return f"not installed ({absent.name})"
        except Exception as broken:
            return f"{module} does not load: {(str(broken) or type(broken).__name__).splitlines()[0]}"
    return None


def _computes() -> float:
    """Seconds that compiling and running a scan of products takes.

    Raises:
        ValueError: it fails, or its result is wrong.
    """
    began, size = time.perf_counter(), 32
    turn = jnp.roll(jnp.eye(size), 1, axis=0)

    @jax.jit
    def around(start: jax.Array) -> jax.Array:
        return jax.lax.scan(
            lambda state, _: (turn @ state, None), start, None, length=size
        )[0]

    start = jnp.arange(size, dtype=jnp.float32)
    try:
        right = bool(jnp.all(around(start) == start))
    except Exception as failure:
        raise ValueError(
            f"jax cannot compute on {jax.default_backend()}: {failure}"
        ) from failure
    if not right:
        raise ValueError(
            f"jax computes wrongly on {jax.default_backend()}: a full turn of a permutation is not the identity"
        )
    return time.perf_counter() - began


def _advice(root: Path, devices: list[str]) -> list[str]:
    """What would make work here better, in order of weight."""
    lines, place = [], root.resolve()
    while not place.exists():
        place = place.parent
    if not os.access(place, os.W_OK):
        lines.append(f"{place} cannot be written; choose another place with root=DIR")
    free = shutil.disk_usage(place).free // 2**20
    if free < ROOM_MB:
        lines.append(
            f"{free} MB are free below {place}; an experiment needs up to {ROOM_MB}"
        )
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        lines.append(
            "set JAX_COMPILATION_CACHE_DIR to a directory, and later runs compile nothing twice"
        )
    if all(device.startswith("cpu") for device in devices) and shutil.which(
        "nvidia-smi"
    ):
        lines.append(
            'there is an accelerator that jax does not see; pip install "jax[cuda12]"'
        )
    return lines


if __name__ == "__main__":
    hydra_command(run)()
