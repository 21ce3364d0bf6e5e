"""What a run left: null where a file is missing, a refusal where the certificate is about other weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax.artefacts import read_json


def read(path: Path) -> dict[str, Any] | None:
    """The JSON object in a file, or None where there is no file."""
    return read_json(path) if path.exists() else None


def about(
    policy: dict[str, Any], certificate: dict[str, Any] | None
) -> dict[str, Any] | None:
    """The certificate, or a refusal if it names other weights than the policy's manifest."""
    mine, named = policy.get("sha256"), (certificate or {}).get("weights_sha256")
    if mine and named and mine != named:
        return {
            "valid": False,
            "reason": "the certificate in this run is about other weights",
        }
    return certificate
