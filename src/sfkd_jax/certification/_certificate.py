"""The certificate: what is proved about the exported weights for all z, u and e, or a refusal with the reason."""

from __future__ import annotations

import dataclasses
import time
from importlib.metadata import version
from typing import Any

import numpy as np

from sfkd_jax.certification._attack_all import FLOAT32, attack_all, limits_of
from sfkd_jax.certification._claims import Claims, Refuted, claims_hold
from sfkd_jax.certification._core import Matrix
from sfkd_jax.certification._environments import Box
from sfkd_jax.certification._exported import (
    CertificationRefused,
    Exported,
    exported,
    fingerprint,
    one_thread,
)
from sfkd_jax.certification._proofs import prove
from sfkd_jax.types import Model, Params

MODES = ("joint", "separate")
MALFORMED = (
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    AttributeError,
    RecursionError,
)
"""What Python raises about a document whose parts are of other kinds than they should
be.
"""
PRECISION = "bounds on the float32 weights as real numbers, checked in float64; float32 rounding of a step counts as d"


class CertificateStale(Exception):
    """The certificate is about other weights."""


@dataclasses.dataclass(frozen=True)
class Certificate:
    """What is proved. Frozen; `document` and `from_document` carry it through JSON unchanged.

    Attributes:
        mode: "joint" or "separate".
        scope: how all environments are covered.
        alpha: contraction factor of a step, |F(z) − F(z')|_P ≤ α |z − z'|_P for all z,
            z', u and all e of the scope.
        alpha_separate: ρ + β √κ.
        alpha_joint: of z ↦ A(e) z + r(z; u, e) as one map, or None.
        rho: sup_e ||A(e)||_P.
        beta: Lipschitz constant of r in z.
        kappa: condition of P, 1 for P = I.
        lipschitz: of the decoder's parts "position" [m], "yaw" [rad], both ("decoder")
            and of "body".
        transport_lipschitz: of T(e → e').
        env_box: [low, high].
        witnesses: multipliers (and P) that prove all of it; `verify` needs no search.
        params_sha256: of the weights.
        precision: what float arithmetic is covered how.
        attack: largest contraction factor that an attack on the running model found.
        tightness: α / attack.
        attacks: all lower bounds by name.
        versions, seconds: of how it was made.
    """

    mode: str
    scope: str
    alpha: float
    alpha_separate: float
    alpha_joint: float | None
    rho: float
    beta: float
    kappa: float
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
        """As JSON has it."""
        return dataclasses.asdict(self)

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> Certificate:
        """Back from JSON; keys that are not the certificate's own are left out.

        Raises:
            CertificationRefused: a key is missing.
        """
        names = [field.name for field in dataclasses.fields(cls)]
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
    mode: str = "joint",
    margin: float = 1e-4,
    metric: Matrix | None = None,
    attack_starts: int = 6,
    seed: int = 0,
) -> Certificate:
    """Prove a contraction factor for all z, all u and all e, and attack what was proved.

    Args:
        model, params: with `explicit`; the weights as exported.
        env_box: lower and upper corner of E.
        mode: "joint" bounds A(e) z + r(z; u, e) as one map; "separate" only ρ + β.
        margin: how far below 1 α must lie.
        metric: P of a common Lyapunov function, proposed by anyone; ρ and κ are
            recomputed (separate mode).
        attack_starts: of the ascent on the running model; 0 leaves it out and tightness
            None.
        seed: of the attacks.

    Raises:
        CertificationRefused: with the reason. CertificateContradicted: an attack beat
            the bound.
        ValueError: unknown mode, a metric in joint mode, or a box that is none.
    """
    began = time.perf_counter()
    corners = np.asarray(env_box, dtype=np.float64)
    if corners.ndim != 2 or len(corners) != 2 or not np.all(corners[0] <= corners[1]):
        raise ValueError(f"env_box must be a lower and an upper corner, got {env_box}")
    if mode not in MODES or (metric is not None and mode == "joint"):
        raise ValueError(
            f"mode must be one of {', '.join(MODES)}, and separate with a metric; got {mode!r}"
        )
    weights = exported(model, params)
    try:
        with one_thread():
            claims = prove(weights, env_box, joint=mode == "joint", metric=metric)
    except Refuted as reason:
        raise CertificationRefused(str(reason)) from None
    if not claims.alpha <= 1.0 - margin:  # so that NaN is refused as well
        shown = f"alpha = {claims.alpha:.6f} (rho {claims.rho:.6f}, beta {claims.beta:.6f}, kappa {claims.kappa:.3g})"
        raise CertificationRefused(f"{shown} is not below 1 by the margin {margin:g}")
    attacks = attack_all(model, params, weights, claims, env_box, attack_starts, seed)
    attack = attacks.get("step")
    return Certificate(
        mode=mode,
        **claims._asdict(),
        transport_lipschitz=1.0,
        env_box=corners.tolist(),
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
    """Check a certificate against weights, without any search: milliseconds, once `model.explicit` is compiled.

    Args:
        certificate: of unknown origin.
        params: weights.
        model: what turns them into explicit ones.
        weights: the explicit ones, where they are at hand.

    Raises:
        CertificateStale: it is about other weights.
        CertificationRefused: a claim does not follow from its witness.
    """
    if fingerprint(params) != certificate.params_sha256:
        raise CertificateStale("the certificate is about other weights")
    weights = exported(model, params) if weights is None else weights
    claims = Claims(**{name: getattr(certificate, name) for name in Claims._fields})
    try:
        with one_thread():
            claims_hold(claims, weights, certificate.env_box)
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
    """Refuse a certificate whose parts contradict each other.

    Raises:
        Refuted: naming the first part.
    """
    if not claims.alpha < 1.0 or certificate.transport_lipschitz != 1.0:
        raise Refuted(
            f"alpha = {claims.alpha} is not below 1, or the transport is not nonexpansive"
        )
    if certificate.mode not in MODES or (certificate.mode == "joint") != (
        claims.alpha_joint is not None
    ):
        raise Refuted(
            f"mode {certificate.mode!r} does not fit alpha_joint = {claims.alpha_joint}"
        )
    if certificate.precision != PRECISION:
        raise Refuted("precision is not what is covered")
    limits = limits_of(claims, weights)
    for name, value in certificate.attacks.items():
        if name not in limits or not 0 <= value <= limits[name] * (1 + FLOAT32):
            raise Refuted(
                f"the attack {name} = {value!r} contradicts the bound {limits.get(name)}"
            )
    step = certificate.attacks.get("step")
    if certificate.attack != step or certificate.tightness != (
        claims.alpha / step if step else None
    ):
        raise Refuted("attack or tightness is not what the attacks found")
