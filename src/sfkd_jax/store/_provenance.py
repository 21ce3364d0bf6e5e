"""What a number was computed with: code, packages, device."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[1]


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that numbers depend on."""
    installed = {"python": platform.python_version()}
    for name in ("numpy", "jax", "sfkd_jax"):
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed[name] = import_module(name).__version__
    return installed


@cache
def source_hash() -> str:
    """Return the SHA-256 of the package's Python files, with their paths.

    They are hashed as they are at the first call.
    """
    digest = hashlib.sha256()
    for file in sorted(PACKAGE.rglob("*.py")):
        digest.update(file.relative_to(PACKAGE).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def provenance() -> dict[str, Any]:
    """Return what a result depends on besides its settings.

    Hash of the source, the commit if the package is a checkout ("+" if its files were
    changed since), version, jax, device, and the machine's load average.
    """
    import jax

    device = jax.devices()[0]
    installed = versions()
    return {
        "source": source_hash(),
        "commit": _commit(),
        "version": installed["sfkd_jax"],
        "jax": installed["jax"],
        "device": f"{device.platform} {device.device_kind}".strip(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


@cache
def _commit() -> str | None:
    """The commit of the checkout, with "+" if the package differs; None outside one."""
    if not (PACKAGE.parents[1] / ".git").exists():
        return None

    def git(*words: str) -> str:
        command = ["git", "-C", str(PACKAGE), *words]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--", ".")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None
