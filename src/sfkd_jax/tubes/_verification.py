"""Verification of the certificate of a system, without any search."""

from __future__ import annotations

import numpy as np

from sfkd_jax.certification import (
    REPEATED,
    Trained,
    near,
    require,
    verify,
    well_formed,
)
from sfkd_jax.systems import SystemCertificate


def verify_system(certificate: SystemCertificate, trained: Trained) -> None:
    """Check all that `certification.verify` does, and the tubes of the closed loop.

    Args:
        certificate: as it was read.
        trained: the policy, with its closed loop.

    Raises:
        CertificateStale: it is about other weights or settings.
        CertificationRefused: it does not hold; gives the reason.
    """
    verify(certificate, trained)
    tubes = certificate.tubes
    loop = trained.loop
    with well_formed(), np.errstate(all="ignore"):
        names = list(loop.tracked.rows)
        require(
            sorted(certificate.proof.outputs) == sorted(names),
            f"proof.outputs must be {', '.join(names)}",
        )
        require(
            sorted(tubes.outputs) == sorted(names),
            f"tubes.outputs must be {', '.join(names)}",
        )
        for name, bounds in tubes.outputs.items():
            # The triangle inequality: to the nominal model, and to the reference.
            require(
                near(bounds.total, bounds.tube + bounds.nominal, REPEATED),
                f"tubes.outputs.{name}.total does not follow from its parts",
            )
        _require_conditions(certificate, trained)


def _require_conditions(certificate: SystemCertificate, trained: Trained) -> None:
    """Refuse tubes that were measured on runs of another system, frame or law."""
    conditions = certificate.tubes.conditions
    tracked = trained.loop.tracked
    system = tracked.system
    frame = tracked.frame
    expected = {
        "input_box": frame.input_box,
        "reference_dwell_s": frame.dwell,
        "env_box": system.env_box,
        "env_dwell_s": trained.settings["settings"]["dwell"],
        "duration_s": trained.settings["settings"]["duration"],
        "sensor_noise": system.sensor_noise,
        "perturbation": np.asarray(trained.loop.law.perturbation).tolist(),
    }
    for name, value in expected.items():
        require(
            near(getattr(conditions, name), value, REPEATED),
            f"tubes.conditions.{name} is not that of the policy",
        )
    for name in ("level", "runs"):
        require(
            getattr(certificate.tubes, name) == trained.settings["settings"][name],
            f"tubes.{name} is not that of the policy",
        )
