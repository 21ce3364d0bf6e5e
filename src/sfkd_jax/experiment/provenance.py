"""What a number was computed with: code, packages, device."""

from __future__ import annotations

import hashlib
import os
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import jax

from sfkd_jax.store import versions

PACKAGE = Path(__file__).resolve().parents[1]


@cache
def source_hash() -> str:
    """Return the SHA-256 of the package's Python files, with their paths.

    They are hashed as they are at the first call.
    """
    digest = hashlib.sha256()
    # Sorted, since file systems list files in any order.
    for file in sorted(PACKAGE.rglob("*.py")):
        # The zero byte keeps a path and what follows from running together.
        digest.update(file.relative_to(PACKAGE).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def provenance() -> dict[str, Any]:
    """Return what a result depends on besides its settings.

    Hash of the source, the commit if the package is a checkout ("+" if its files were
    changed since), version, jax, device, and the machine's load average.
    """
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
    """The commit of the checkout, with "+" if its files differ; None outside one."""
    if not (PACKAGE.parents[1] / ".git").exists():
        return None
    command = ["git", "-C", str(PACKAGE), "describe", "--always", "--exclude=*"]
    command += ["--abbrev=40", "--dirty=+"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
