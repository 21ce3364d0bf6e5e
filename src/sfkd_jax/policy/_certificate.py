"""The certificate beside a policy: read, verified, and whose signature it bears."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from sfkd_jax import certificate as certificates
from sfkd_jax import store
from sfkd_jax.certificate import Refusal
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.policy._files import CERTIFICATE, RECORDED
from sfkd_jax.policy._trained import TrainedModel, policy_file
from sfkd_jax.systems import SystemCertificate

Certified: TypeAlias = DrivingCertificate | SystemCertificate
"""The certificate of a policy."""


class SavedHashes(NamedTuple):
    """What a policy that was saved is known by.

    Attributes:
        weights_sha256: hash of its weights.
        certificate_sha256: hash of the file of its certificate; None without one.
    """

    weights_sha256: str
    certificate_sha256: str | None


def save_certificate(
    folder: Path, manifest: dict[str, Any], certificate: Certified | None
) -> SavedHashes:
    """Write the verified certificate of a policy beside it.

    It refers to the settings as they were saved, perhaps with another controller.

    Args:
        folder: of the policy.
        manifest: of the file of the policy.
        certificate: to write; None if there is none.
    """
    path = folder / CERTIFICATE
    if certificate is None:
        path.unlink(missing_ok=True)
        return SavedHashes(manifest["sha256"], None)
    provenance = replace(
        certificate.provenance, policy_sha256=manifest["content_sha256"]
    )
    # A signature stays if this changes nothing.
    certificates.write(path, replace(certificate, provenance=provenance))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return SavedHashes(manifest["sha256"], digest)


def read_certificate(
    path: str | Path, trained: TrainedModel, *, signed_by: str | Path | None = None
) -> tuple[DrivingCertificate | None, str]:
    """Verify the certificate beside a policy, in its run directory.

    Args:
        path: as of `load`.
        trained: the policy.
        signed_by: public key of who must have signed it, see `load`; None for anybody.

    Returns:
        The certificate and "", or None and the reason why there is none.

    Raises:
        ArtefactError: it is damaged, does not follow from its witnesses, or is not
            signed by this key.
    """
    from sfkd_jax import certification
    from sfkd_jax.driving import corridor  # loaded only if there is something to verify

    files = [policy_file(path).with_name(name) for name in (RECORDED, CERTIFICATE)]
    file = next((file for file in files if file.exists()), None)
    if file is None:
        if signed_by is not None:
            raise store.failure(files[-1], "is missing, and was to be signed")
        return None, f"{CERTIFICATE} is missing"
    certificate = certificates.read(file, DrivingCertificate)
    if signed_by is not None:
        _require_signature(file, certificate, signed_by)
    if isinstance(certificate, Refusal):
        reason = store.one_line(certificate.reason)
        return None, f"the certificate was refused: {reason}"
    # A signature that is there must hold, whether or not somebody asked for it.
    if certificate.signature is not None and certificates.can_check():
        _require_signature(file, certificate, certificate.signature.public_key)
    try:
        with store.as_artefact_error(file):
            corridor.verify_driving(certificate, trained)
    except certification.CertificateStale as reason:
        if signed_by is not None:
            raise store.failure(file, reason) from None
        return None, f"{reason}; certify again"
    except certification.CertificationRefused as reason:
        raise store.failure(file, reason) from None
    return certificate, ""


def _require_signature(
    file: Path, certificate: DrivingCertificate | Refusal, signer: str | Path
) -> None:
    """Raise an ArtefactError unless a certificate is signed by a key."""
    key = certificates.public_key_of(signer)
    if isinstance(certificate, Refusal) or certificate.signature is None:
        raise store.failure(file, f"is not signed, and was to be signed by {key}")
    signature = certificate.signature
    if signature.public_key != key:
        raise store.failure(file, f"is signed by {signature.public_key}, not by {key}")
    if not certificates.is_signed(certificate.sha256, signature):
        raise store.failure(file, f"the signature is not that of {key}")
