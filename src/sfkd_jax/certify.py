"""python -m sfkd_jax.certify: certify the policy of a run. Exit 2 refused, 3 stale."""

from __future__ import annotations

from typing import Any

from sfkd_jax import artefacts
from sfkd_jax.certification import CertificateStale, CertificationRefused
from sfkd_jax.cli.config import door
from sfkd_jax.pipeline import certificates, stages, store


@store.exclusive
def run(settings: dict[str, Any]) -> dict[str, Any]:
    """Certify the policy of the run, which is trained if it is missing.

    Raises:
        CertificateStale: there is a certificate of another policy, and
            `certification.renew` is false.
        CertificationRefused: nothing could be certified.
    """
    trained = stages.ensure_policy(settings)
    path = certificates.certificate_path(store.run_directory(settings))
    if path.exists() and not settings["certification"]["renew"]:
        certified = artefacts.read_json(path).get("policy_sha256")
        if certified != trained.sha256:
            raise CertificateStale(
                f"{path} is about other weights or settings; "
                "certification.renew=true replaces it"
            )
    document = certificates.certify_policy(settings)
    if not document["valid"]:
        raise CertificationRefused(document["reason"])
    path = certificates.certificate_path(store.run_directory(settings))
    d_bar = document.get("d_bar", {"value": None})["value"]
    keys = ("valid", "alpha", "alpha_separate", "rho", "beta", "tightness", "seconds")
    summary = {"certificate": str(path), "reason": None, "d_bar": d_bar}
    return summary | {key: document.get(key) for key in keys}


if __name__ == "__main__":
    door(run)()
