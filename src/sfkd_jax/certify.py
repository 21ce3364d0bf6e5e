"""Certify the policy of a run.

Exit codes: 0 certified, 2 refused, 3 stale.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sfkd_jax import store
from sfkd_jax.certificate import Refusal
from sfkd_jax.certification import CertificateStale, CertificationRefused
from sfkd_jax.experiment import stages
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.run import Run


def main(run: Run) -> dict[str, Any]:
    """Certify the policy of the run, which is trained if it is missing."""
    path = run.certificate_path
    with store.locked(run.directory):
        trained = run.policy
        is_kept = path.exists() and not run.settings.certification.renew
        if is_kept and _certified_policy(path) != trained.sha256:
            raise CertificateStale(
                f"{path} is about other weights or settings; "
                "certification.renew=true replaces it"
            )
        certificate = stages.certify_policy(run)
    if isinstance(certificate, Refusal):
        raise CertificationRefused(certificate.reason)
    proof = certificate.proof
    return {
        "certificate": str(path),
        "reason": None,
        "d_bar": certificate.measured.d_bar.one_step["latent"],
        "valid": True,
        "alpha": proof.alpha,
        "alpha_separate": proof.alpha_separate,
        "rho": proof.rho,
        "beta": proof.beta,
        "tightness": proof.tightness,
        "seconds": certificate.provenance.seconds,
    }


def _certified_policy(path: Path) -> str | None:
    """Return the hash of the policy that a certificate is about.

    None if the file is of an earlier format.
    """
    provenance = store.read_json(path).get("provenance")
    return provenance.get("policy_sha256") if isinstance(provenance, dict) else None


if __name__ == "__main__":
    hydra_command(main)()
