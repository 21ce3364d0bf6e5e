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

from sfkd_jax import store
from sfkd_jax.experiment import TRAIN
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings

CORE = ("jaxlib", "flax", "optax", "orbax-checkpoint", "hydra-core", "scipy")
"""Packages whose versions are shown, beside those that every result records."""
EXTRAS = {
    "train": TRAIN,
    "brax": ("brax",),
    "gym": ("gymnasium",),
    "docs": ("mkdocs", "material", "mkdocstrings"),
    "plants": ("vehiclemodels",),
    "cpp": ("iree.compiler", "iree.runtime"),
    "sweeps": (
        *("hydra_plugins.hydra_joblib_launcher", "submitit"),
        "hydra_plugins.hydra_optuna_sweeper",
    ),
}
"""Extra -> the modules that it installs."""
NEEDED_MB = 500
"""Size of the data set, checkpoints and reports of one experiment, at most."""


def run(settings: Settings) -> dict[str, Any]:
    """Print and return the state of the installation, with advice.

    Raises:
        ValueError: jax cannot compute here.
    """
    installed = {one.name.lower(): one.version for one in metadata.distributions()}
    core = {name: installed.get(name, "missing") for name in CORE}
    versions = store.versions() | core
    print("  ".join(f"{name} {version}" for name, version in versions.items()))
    devices = [f"{device.platform}: {device.device_kind}" for device in jax.devices()]
    affinity = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))
    print(
        f"devices: {', '.join(devices)}; "
        f"{len(affinity(0))} processor cores for this process"
    )
    seconds = _backend_seconds()
    print(f"compiles and computes: yes, in {seconds:.1f} s")
    broken = {name: _broken(modules) for name, modules in EXTRAS.items()}
    for name, reason in broken.items():
        advice = f'; pip install "sfkd-jax[{name}]"' if reason else ""
        print(f"extra {name}: {reason or 'works'}{advice}")
    advice = _advice(Path(settings.root), devices)
    for line in advice:
        print(f"advice: {line}")
    return {
        "versions": versions,
        "devices": devices,
        "extras": [name for name, reason in broken.items() if reason is None],
        "advice": advice,
        "seconds": seconds,
    }


def _broken(modules: tuple[str, ...]) -> str | None:
    """Return why an extra does not work; None if all its modules import."""
    for module in modules:
        try:
            import_module(module)
        except ModuleNotFoundError as absent:
            return f"not installed ({absent.name})"
        except Exception as broken:
            reason = (str(broken) or type(broken).__name__).splitlines()[0]
            return f"{module} does not load: {reason}"
    return None


def _backend_seconds() -> float:
    """Return the seconds that it takes to compile and run a scan of products.

    Raises:
        ValueError: it fails, or its result is wrong.
    """
    began, start = time.perf_counter(), jnp.arange(32.0)
    turn = jnp.roll(jnp.eye(len(start)), 1, axis=0)
    rotate = jax.jit(lambda x: jax.lax.scan(lambda x, _: (turn @ x, None), x, start)[0])
    where = jax.default_backend()
    try:
        # As many turns as there are entries lead back to the start.
        right = bool(jnp.all(rotate(start) == start))
    except Exception as failure:
        raise ValueError(f"jax cannot compute on {where}: {failure}") from failure
    if not right:
        raise ValueError(f"jax computes wrongly on {where}: a full turn moves entries")
    return time.perf_counter() - began


def _advice(root: Path, devices: list[str]) -> list[str]:
    """Return what would improve the installation, the most important first."""
    directory = root.resolve()
    while not directory.exists():
        directory = directory.parent
    free = shutil.disk_usage(directory).free // 2**20
    on_cpu = all(device.startswith("cpu") for device in devices)
    advice = {
        f"{directory} cannot be written; choose another directory with root=DIR": (
            not os.access(directory, os.W_OK)
        ),
        f"{free} MB are free below {directory}; an experiment needs {NEEDED_MB}": (
            free < NEEDED_MB
        ),
        'there is an accelerator that jax does not see; pip install "jax[cuda12]"': (
            on_cpu and shutil.which("nvidia-smi") is not None
        ),
    }
    return [line for line, applies in advice.items() if applies]


if __name__ == "__main__":
    hydra_command(run)()
