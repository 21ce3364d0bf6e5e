"""The certificate of a policy that drives."""

from __future__ import annotations

from dataclasses import dataclass

from sfkd_jax.certificate import Certificate
from sfkd_jax.driving.certificate._corridor import Corridor


@dataclass(frozen=True, kw_only=True)
class DrivingCertificate(Certificate):
    """A certificate of a policy that drives, with the corridor of its closed loop.

    Attributes:
        corridor: what is measured in the closed loop; None for a policy without one.
    """

    corridor: Corridor | None
