"""Verification of certificates from an untrusted source, without any search.

What is proved is checked by the trusted core, and what follows from it is computed
again. A measured number can be bound to its author alone: the hash of the document
covers it, and a signature of the hash says who measured it.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from sfkd_jax.certificate import Certificate, StepErrors
from sfkd_jax.certification._proving import verify_proof
from sfkd_jax.certification._tubes import tubes
from sfkd_jax.certification._weights import (
    CertificateStale,
    exported,
    require,
    well_formed,
)
from sfkd_jax.types import Frame

Trained: TypeAlias = Any
"""A `policy.TrainedModel`: what a certificate is about."""

REPEATED = 1e-9
"""Relative tolerance of values that are computed again. The order of summation may be
another one.
"""
ROUNDED = 1e-6
"""The same of values that are float32 in one place, and float64 in another."""


def verify(certificate: Certificate, trained: Trained) -> None:
    """Check a certificate from an untrusted source against a policy.

    Args:
        certificate: as it was read.
        trained: the policy. The hash in the certificate is about its settings, too.

    Raises:
        CertificateStale: it is about other weights or settings.
        CertificationRefused: it does not hold; gives the reason.
    """
    provenance = certificate.provenance
    # The same weights under another controller are another policy. The hash therefore
    # covers the settings, too.
    hashes = (provenance.policy_sha256, provenance.weights_sha256)
    if hashes != (trained.sha256, trained.weights_sha256):
        raise CertificateStale("the certificate is about other weights or settings")
    weights = exported(trained.model, trained.params)
    proof = certificate.proof
    verify_proof(proof, trained.model, trained.params, weights=weights)
    with well_formed(), np.errstate(all="ignore"):
        _require_what_follows(certificate, trained)
        _require_sizes(certificate, trained)


def _require_what_follows(certificate: Certificate, trained: Trained) -> None:
    """Refuse an entry that does not follow from the policy and other entries."""
    proof = certificate.proof
    measured = certificate.measured
    frame = trained.model.frame
    _require_step_errors(measured.d_bar.one_step, frame)
    stated = measured.tube
    derived = tubes(
        alpha=proof.alpha,
        lipschitz=proof.lipschitz,
        frame=frame,
        one_step=measured.d_bar.one_step,
        horizon=len(stated.latent),
        largest_increment=stated.largest_increment_m,
    )
    require(
        (stated.largest_increment_m is not None) == frame.has_pose
        and near(vars(stated), vars(derived), REPEATED),
        "measured.tube does not follow from the proof and d_bar",
    )
    environment = trained.settings["environment"]
    box = [environment.get("low"), environment.get("high")]
    # The environments of logs are measured, and the settings may state no box of them.
    require(
        None in box or near(proof.env_box, box, ROUNDED),
        "proof.env_box is not that of the policy",
    )
    require(
        measured.boxes.env == proof.env_box, "measured.boxes.env is not proof.env_box"
    )


def _require_step_errors(stated: StepErrors, frame: Frame) -> None:
    """Refuse bounds of other errors than those of the latent and of the outputs."""
    where = "measured.d_bar.one_step"
    expected = ("latent", *frame.outputs)
    for name in expected:
        require(name in stated, f"{where}.{name} is missing")
    for name in stated:
        require(
            name in expected, f"{where}.{name!a:.80} is not an entry of a certificate"
        )


def _require_sizes(certificate: Certificate, trained: Trained) -> None:
    """Refuse lists of other lengths than the policy has, which readers would index."""
    space = trained.settings["space"]
    boxes = certificate.measured.boxes
    for box, part in (("state", "body"), ("control", "control"), ("env", "env")):
        low, _ = getattr(boxes, box)
        fits = len(low) == len(space[f"{part}_mean"])
        require(fits, f"measured.boxes.{box} is of another size than the policy")
    require(
        certificate.measured.outputs.keys() == certificate.proof.outputs.keys(),
        "measured.outputs are not those of the proof",
    )


def near(stated: Any, derived: Any, tolerance: float) -> bool:
    """Return whether numbers in equal structures are nearly equal, relative to derived.

    A forger can choose the stated value, and not the derived one.
    """
    if isinstance(derived, dict):
        return stated.keys() == derived.keys() and all(
            near(stated[key], derived[key], tolerance) for key in derived
        )
    if derived is None or stated is None:
        return stated is derived
    expected = np.asarray(derived, float)
    actual = np.asarray(stated, float)
    inside = np.abs(actual - expected) <= tolerance * np.abs(expected)
    return actual.shape == expected.shape and bool(np.all(inside))
