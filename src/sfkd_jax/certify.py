"""Certify the policy of a run.

Exit codes: 0 certified, 2 refused, 3 stale.
"""

from __future__ import annotations

from typing import Any

from sfkd_jax import store
from sfkd_jax.certification import CertificateStale, CertificationRefused
from sfkd_jax.experiment import runs, stages
from sfkd_jax.experiment.command import hydra_command
from sfkd_jax.experiment.options import Settings

SECONDS = 2.3e-5
"""Training time on two cores per step, segment of the batch and time step of the
window, measured with +experiment=s3.
"""


@runs.exclusive
def run(settings: Settings) -> dict[str, Any]:
    """Certify the policy of the run, which is trained if it is missing.

    Raises:
        CertificateStale: there is a certificate of another policy, and
            `certification.renew` is false.
        CertificationRefused: nothing could be certified.
    """
    if not runs.policy_path(settings).is_file():
        store.print_message(_announcement(settings))
    trained = stages.ensure_policy(settings)
    path = stages.certificate_path(settings.run_dir)
    if path.exists() and not settings.certification.renew:
        certified = store.read_json(path).get("policy_sha256")
        if certified != trained.sha256:
            raise CertificateStale(
                f"{path} is about other weights or settings; "
                "certification.renew=true replaces it"
            )
    document = stages.certify_policy(settings)
    if not document["valid"]:
        raise CertificationRefused(document["reason"])
    d_bar = document.get("d_bar", {"value": None})["value"]
    keys = ("valid", "alpha", "alpha_separate", "rho", "beta", "tightness", "seconds")
    summary = {"certificate": str(path), "reason": None, "d_bar": d_bar}
    return summary | {key: document.get(key) for key in keys}


def _announcement(settings: Settings) -> str:
    """Return what happens before the certification of a policy that is not trained."""
    options = settings.training
    steps = options.steps
    seconds = SECONDS * steps * options.batch * options.window
    return (
        f"{settings.run_dir} holds no trained policy: "
        f"{settings.model.system} is trained first, at most {steps} steps, "
        f"about {max(1, round(seconds / 60))} min on two cores; then it is certified"
    )


if __name__ == "__main__":
    hydra_command(run)()
