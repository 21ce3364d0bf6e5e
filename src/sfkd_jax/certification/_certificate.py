"""Certificates of contraction for all z, u and e: proof and verification."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np

from sfkd_jax.certification._attack import (
    FLOAT32,
    attack_claims,
    attack_slopes,
    limits_of,
)
from sfkd_jax.certification._claims import Box, Claims, Refuted, require_claims
from sfkd_jax.certification._search import joint_bound, prove, residual_bound
from sfkd_jax.certification._weights import (
    CertificationRefused,
    Exported,
    exported,
    fingerprint,
    one_thread,
)
from sfkd_jax.types import Model, Params

MALFORMED = (
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    AttributeError,
    RecursionError,
)
"""Errors that Python raises on a document with values of unexpected types."""
PRECISION = (
    "bounds on the float32 weights as real numbers, checked in float64; "
    "float32 rounding of a step counts as d"
)


class CertificateStale(Exception):
    """The certificate is about other weights."""


@dataclasses.dataclass(frozen=True)
class Certificate:
    """Proved constants in the 2-norm with their witnesses.

    Attributes:
        scope: the environments, and how all of them are covered.
        alpha: contraction factor of a step, |F(z) − F(z')| ≤ α |z − z'| for all z, z',
            u and all e of the scope: the smaller of the next two.
        alpha_separate: ρ + β.
        alpha_joint: of z ↦ A(e) z + r(z; u, e) as one map.
        rho: sup_e ||A(e)||.
        beta: Lipschitz constant of r in z.
        lipschitz: Lipschitz constants of the decoder's outputs "position" [m], "yaw"
            [rad], both ("decoder") and of "body".
        transport_lipschitz: Lipschitz constant of T(e → e').
        env_box: [low, high].
        witnesses: multipliers of all proofs; `verify` needs no search.
        params_sha256: hash of the weights.
        precision: how float arithmetic is accounted for.
        attack: largest contraction factor reached by an attack on the float32 model.
        tightness: α / attack.
        attacks: all lower bounds by name.
        versions: of the libraries that computed it.
        seconds: duration of the proof and the attacks.
    """

    scope: str
    alpha: float
    alpha_separate: float
    alpha_joint: float
    rho: float
    beta: float
    lipschitz: dict[str, float]
    transport_lipschitz: float
    env_box: list[list[float]]
    witnesses: dict[str, Any]
    params_sha256: str
    precision: str
    attack: float | None
    tightness: float | None
    attacks: dict[str, float]
    versions: dict[str, str]
    seconds: float

    def document(self) -> dict[str, Any]:
        """Return the certificate as JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Certificate:
        """Read a certificate from JSON values; other keys are ignored.

        Raises:
            CertificationRefused: a key is missing.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        # Read by name: a document may have more keys, such as tubes.
        missing = [name for name in names if name not in document]
        if missing:
            raise CertificationRefused(
                f"not a certificate: {', '.join(missing[:3])} missing"
            )
        return cls(**{name: document[name] for name in names})


def certify(
    model: Model,
    params: Params,
    env_box: Box,
    *,
    margin: float = 1e-4,
    attack_starts: int = 6,
    seed: int = 0,
) -> Certificate:
    """Prove a contraction factor for all z, u and e, and attack all proved bounds.

    Args:
        model: a model with `explicit`.
        params: its weights as exported.
        env_box: lower and upper corner of E.
        margin: α must be at most 1 − margin.
        attack_starts: starting points of the ascent on the float32 model; with 0 there
            is no ascent and tightness is None.
        seed: of the attacks.

    Raises:
        CertificationRefused: the model cannot be certified; gives the reason.
        CertificateContradicted: an attack exceeds a proved bound.
        ValueError: an invalid box.
    """
    began = time.perf_counter()
    corners = np.asarray(env_box, dtype=np.float64)
    if corners.ndim != 2 or len(corners) != 2 or not np.all(corners[0] <= corners[1]):
        raise ValueError(f"env_box must be a lower and an upper corner, got {env_box}")
    # In float64 and on the host, before anything is searched.
    weights = exported(model, params)
    try:
        with one_thread():
            claims = prove(weights)
    except Refuted as reason:
        raise CertificationRefused(str(reason)) from None
    if not claims.alpha <= 1.0 - margin:  # refuses NaN as well
        raise CertificationRefused(
            f"alpha = {claims.alpha:.6f} (rho {claims.rho:.6f}, "
            f"beta {claims.beta:.6f}) is not below 1 by the margin {margin:g}"
        )
    box = corners.tolist()
    # After the proof: an attack that exceeds it is a fault of the code, see there.
    attacks = attack_claims(model, params, weights, claims, box, attack_starts, seed)
    attack = attacks.get("step")
    return Certificate(
        **claims._asdict(),
        transport_lipschitz=1.0,
        env_box=box,
        # Of the parameters as they are stored: what
        # a reader of the policy can recompute.
        params_sha256=fingerprint(params),
        precision=PRECISION,
        attack=attack,
        tightness=claims.alpha / attack if attack else None,
        attacks=attacks,
        versions={name: version(name) for name in ("jax", "numpy", "scipy")},
        seconds=time.perf_counter() - began,
    )


def verify(
    certificate: Certificate,
    params: Params,
    *,
    model: Model,
    weights: Exported | None = None,
) -> None:
    """Check a certificate against weights without any search.

    Takes milliseconds once `model.structure.explicit` is compiled.

    Args:
        certificate: from an untrusted source.
        params: the weights.
        model: provides `explicit`.
        weights: explicit weights of `params`, if already computed.

    Raises:
        CertificateStale: it is about other weights.
        CertificationRefused: a claim does not follow from its witness.
    """
    # First the hash: a proof about other weights need not be read at all.
    if fingerprint(params) != certificate.params_sha256:
        raise CertificateStale("the certificate is about other weights")
    weights = exported(model, params) if weights is None else weights
    # The proved part alone; attacks and times are compared afterwards.
    claims = Claims(**{name: getattr(certificate, name) for name in Claims._fields})
    try:
        with one_thread():
            require_claims(claims, weights, certificate.env_box)
        # Outside: it compares numbers, and no matrix is touched.
        _require_consistent(certificate, claims, weights)
    except Refuted as reason:
        raise CertificationRefused(str(reason)) from None
    except MALFORMED as reason:
        raise CertificationRefused(
            f"the certificate is malformed: {' '.join(str(reason).split())}"
        ) from None


def _require_consistent(
    certificate: Certificate, claims: Claims, weights: Exported
) -> None:
    """Check that the parts of a certificate agree with each other.

    Raises:
        Refuted: names the first part that does not.
    """
    if not claims.alpha < 1.0 or certificate.transport_lipschitz != 1.0:
        raise Refuted(
            f"alpha = {claims.alpha} is not below 1, "
            "or the transport is not nonexpansive"
        )
    # A text that promises more than the checks below cover must not pass.
    if certificate.precision != PRECISION:
        raise Refuted("precision is not what is covered")
    limits = limits_of(claims, weights)
    for name, value in certificate.attacks.items():
        # A stated attack above the proved bound would contradict the document itself.
        if name not in limits or not 0 <= value <= limits[name] * (1 + FLOAT32):
            raise Refuted(
                f"the attack {name} = {value!r} "
                f"contradicts the bound {limits.get(name)}"
            )
    step = certificate.attacks.get("step")
    tightness = claims.alpha / step if step else None
    if certificate.attack != step or certificate.tightness != tightness:
        raise Refuted("attack or tightness does not follow from the attacks")


def contraction_metrics(model: Model, params: Params) -> dict[str, float]:
    """Return a quick estimate of α for the log of a training run; no certificate.

    Args:
        model: any model.
        params: its weights as exported.

    Returns:
        "alpha", "alpha_separate" and "tightness" (α over the largest factor that an
        attack on the slopes reaches); empty if nothing can be proved.
    """
    try:
        weights = exported(model, params)
    # A model without explicit weights trains like any other, just without this log.
    except CertificationRefused:
        return {}
    vertices = weights.operators.vertices
    with one_thread():
        rho = max(float(np.linalg.norm(vertex, 2)) for vertex in vertices)
        separate = rho + residual_bound(weights)
        # Few iterations: an estimate at every checkpoint, not the certificate.
        joint, _ = joint_bound(weights, weights.residual_multipliers, iterations=15)
        slopes = max(
            attack_slopes(weights.residual, vertex, starts=4) for vertex in vertices
        )
    values = {
        "alpha": min(joint, separate),
        "alpha_separate": separate,
        "tightness": min(joint, separate) / slopes,
    }
    # JSON has no infinity: what is not proved is absent.
    return {name: value for name, value in values.items() if np.isfinite(value)}
