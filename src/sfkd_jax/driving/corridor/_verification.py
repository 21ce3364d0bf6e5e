"""Verification of certificates that may have a corridor, without any search."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sfkd_jax.certification import (
    REPEATED,
    CertificationRefused,
    Trained,
    near,
    require,
    verify,
    well_formed,
)
from sfkd_jax.driving.certificate import Corridor, DrivingCertificate
from sfkd_jax.driving.path_following import WINDOWS


def verify_driving(certificate: DrivingCertificate, trained: Trained) -> None:
    """Check all that `verify` does, and the corridor if there is one.

    Args:
        certificate: as it was read.
        trained: the policy, with its law if there is a corridor.

    Raises:
        CertificateStale: it is about other weights or settings.
        CertificationRefused: it does not hold; gives the reason.
    """
    verify(certificate, trained)
    if certificate.corridor is None:
        return
    if trained.law is None or not certificate.proof.outputs:
        raise CertificationRefused("a corridor needs a law and metrics of the outputs")
    with well_formed(), np.errstate(all="ignore"):
        _require_what_follows(certificate.corridor)
        _require_sizes(certificate.corridor, trained)


def _require_what_follows(corridor: Corridor) -> None:
    """Refuse a width that does not follow from the bounds, and delays without order."""
    for part in filter(None, (corridor, corridor.recorded)):
        # The triangle inequality: from the car to the nominal model, and to the path.
        width = part.bounds.nominal + part.bounds.vehicle_to_nominal_position
        require(
            near(part.corridor_m, width, REPEATED),
            "corridor.corridor_m does not follow from its bounds",
        )
    for rows in (corridor.late_sensors, corridor.late_controls):
        require(
            all(one.later_s < next.later_s for one, next in pairwise(rows)),
            "the delays of the late corridors do not rise",
        )


def _require_sizes(corridor: Corridor, trained: Trained) -> None:
    """Refuse lists of other lengths than the policy has, which readers would index."""
    charts = trained.law.gain.shape[-1] + 1
    innovations = corridor.innovations
    shape = (len(innovations.levels), charts)
    env_size = len(trained.settings["space"]["env_mean"])
    fits = (
        np.shape(innovations.deviation) == shape
        and np.shape(innovations.threshold) == (len(WINDOWS), charts)
        and len(corridor.conditions.env_box[0]) == env_size
    )
    require(fits, "corridor is of another size than the policy")
