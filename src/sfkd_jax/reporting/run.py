"""The files of a run that its page shows."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from sfkd_jax.evaluation.formats import dig, is_number
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.reporting.rows import groups_of, headline, model_of
from sfkd_jax.reporting.scene import Scene, scenes_of
from sfkd_jax.store import as_artefact_error, read_json, read_jsonl, read_manifest


class Run(NamedTuple):
    """Content of a run directory, as far as its files exist.

    Attributes:
        figures: folder of the figures of the page.
        settings: of the run.
        versions: of the packages, if recorded.
        command: that the results come from, if recorded.
        groups: its rows, by what may be compared.
        scenes: of episodes.safetensors, the one with most switches first.
        certificate: certificate.json, or a refusal.
        errors: open_loop.json.
        log: lines of metrics.jsonl.
    """

    figures: Path
    settings: dict[str, Any]
    versions: Any
    command: Any
    groups: list[list[Row]]
    scenes: list[Scene]
    certificate: dict[str, Any] | None
    errors: dict[str, Any] | None
    log: list[dict[str, Any]]

    @property
    def system(self) -> str:
        """The system that was trained."""
        return model_of(self.settings)

    @property
    def headline(self) -> list[Row]:
        """The group of rows that the summary is about."""
        return headline(self.groups, self.settings)


def read_run(path: Path, policy: dict[str, Any]) -> Run:
    """Read the files of a run.

    Args:
        path: of the run directory.
        policy: manifest of its weights, see `read_policy`.
    """
    log, results = path / "metrics.jsonl", read_optional(path / "results.json") or {}
    with as_artefact_error(path / "results.json", ValueError):
        groups, scenes = groups_of(results.get("rows") or []), scenes_of(path)
    return Run(
        figures=path / "report" / "figures",
        settings=policy.get("settings") or policy.get("config") or {},
        versions=policy.get("versions") or results.get("versions"),
        command=dig(results, "config", "command"),
        groups=groups,
        scenes=scenes,
        certificate=read_certificate(path, policy),
        errors=read_optional(path / "open_loop.json"),
        log=read_jsonl(log) if log.exists() else [],
    )


def read_policy(run: Path) -> dict[str, Any] | None:
    """The manifest of the weights of a run, or None without weights."""
    path = run / "policy.safetensors"
    return read_manifest(path, kind="policy") if path.exists() else None


def read_optional(path: Path) -> dict[str, Any] | None:
    """The JSON object in a file, or None without a file."""
    return read_json(path) if path.exists() else None


def read_certificate(run: Path, policy: dict[str, Any]) -> dict[str, Any] | None:
    """The certificate of a run, or a refusal if it is not about these weights."""
    certificate = read_optional(run / "certificate.json")
    own, named = policy.get("sha256"), dig(certificate, "weights_sha256")
    if own and named and own != named:
        reason = "the certificate in this run is about other weights"
        return {"valid": False, "reason": reason}
    return certificate


def holds(certificate: dict[str, Any] | None) -> bool:
    """Whether a certificate is valid, with a contraction factor below one."""
    alpha = dig(certificate, "alpha")
    return dig(certificate, "valid") is True and is_number(alpha) and alpha < 1
