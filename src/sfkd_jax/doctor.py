"""Show versions, devices and extras, with advice on what is missing."""

from __future__ import annotations

import os
import shutil
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import jax

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


def run(settings: Settings) -> dict[str, Any]:
    """Print and return the state of the installation, with advice."""
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


def _advice(root: Path, devices: list[str]) -> list[str]:
    """Return what would improve the installation, the most important first."""
    directory = root.resolve()
    while not directory.exists():
        directory = directory.parent
    on_cpu = all(device.startswith("cpu") for device in devices)
    advice = []
    if not os.access(directory, os.W_OK):
        advice.append(f"{directory} cannot be written; choose another with root=DIR")
    if on_cpu and shutil.which("nvidia-smi"):
        advice.append('jax sees no accelerator, but one is there: "jax[cuda12]"')
    return advice


if __name__ == "__main__":
    hydra_command(run)()
