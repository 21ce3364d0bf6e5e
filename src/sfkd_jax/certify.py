"""Certify the policy of a run.

Exit codes: 0 certified, 2 refused, 3 stale.
"""

from __future__ import annotations

from typing import Any

from sfkd_jax import store
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
        if is_kept and store.read_json(path).get("policy_sha256") != trained.sha256:
            raise CertificateStale(
                f"{path} is about other weights or settings; "
                "certification.renew=true replaces it"
            )
        document = stages.certify_policy(run)
    if not document["valid"]:
        raise CertificationRefused(document["reason"])
    keys = ("valid", "alpha", "alpha_separate", "rho", "beta", "tightness", "seconds")
    return {
        "certificate": str(path),
        "reason": None,
        "d_bar": document.get("d_bar", {"value": None})["value"],
        **{key: document.get(key) for key in keys},
    }


if __name__ == "__main__":
    hydra_command(main)()
