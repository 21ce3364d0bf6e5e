"""What the pages of all runs have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax import store
from sfkd_jax.evaluation.formats import dig, is_number
from sfkd_jax.report import figures, style
from sfkd_jax.report.pages import Part, Picture, Section
from sfkd_jax.report.tables import record_table

PROOF = (
    "Proved: recomputed from the stored weights, for every state, command and "
    "environment in the boxes. Measured: a quantile over runs that training never saw, "
    "promised for further runs under the same conditions. Unsigned: whoever can write "
    "the file can change such a number. Outside the boxes nothing is claimed."
)


def read_optional(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file; it is empty if there is no file."""
    return store.read_json(path) if path.exists() else {}


def certificate_document(run: Path, policy: dict[str, Any]) -> dict[str, Any]:
    """Return the certificate of a run; one about other weights is not valid."""
    certificate = read_optional(run / "certificate.json")
    weights = policy.get("sha256")
    certified_weights = dig(certificate, "provenance", "weights_sha256")
    # Valid for other weights is not valid here: the page must not show it.
    if weights and certified_weights and weights != certified_weights:
        reason = "the certificate in this run is about other weights"
        return {"valid": False, "reason": reason}
    return certificate


def holds(certificate: dict[str, Any]) -> bool:
    """Return whether a certificate is valid, with a contraction factor below one."""
    alpha: Any = dig(certificate, "proof", "alpha")
    return certificate.get("valid") is True and is_number(alpha) and alpha < 1


def empty_folder(folder: Path) -> Path:
    """Make a folder for images, without those of an earlier page."""
    folder.mkdir(parents=True, exist_ok=True)
    # An earlier page may have had more figures, which would stay among the new ones.
    for stale in (*folder.glob("*.png"), *folder.glob("*.gif")):
        stale.unlink()
    return folder


def made_with(config: dict[str, Any], versions: Any) -> Section:
    """Return a folded section with the command, the settings and the versions."""
    parts: list[Part] = [
        record_table("Setting", config, "value"),
        record_table("Package", versions or {}, "version"),
    ]
    return Section("Command, settings and versions", parts, folded=True)


def learned(run_dir: Path, images: Path) -> list[Part]:
    """Return a figure of the loss by optimisation step, if it was recorded."""
    log = run_dir / "metrics.jsonl"
    lines = store.read_jsonl(log) if log.exists() else []
    if not lines:
        return []
    path = style.save(images / "learning.png", figures.learning, lines)
    return [Picture(path, "Loss by optimisation step")]
