"""Certificates of contraction for all z, u and e, and the document of a policy."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np

from sfkd_jax.certification._attack import attack_claims
from sfkd_jax.certification._claims import (
    FLOAT32,
    Box,
    Claims,
    attack_limits,
    keeps_metrics,
    require_box,
    require_claims,
    with_room,
)
from sfkd_jax.certification._measured import (
    KINDS,
    Residuals,
    conformal_bounds,
    coverage,
    holds_for,
    residuals,
)
from sfkd_jax.certification._metrics import prove_lyapunov
from sfkd_jax.certification._search import prove
from sfkd_jax.certification._tubes import output_tubes, tubes
from sfkd_jax.certification._weights import (
    CertificateStale,
    CertificationRefused,
    Exported,
    exported,
    fingerprint,
    one_thread,
    require,
    well_formed,
)
from sfkd_jax.ranges import Fraction, NonNegativeInt
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.types import Model, Params, Trajectory

MARGIN = 1e-4
"""By which α must be below 1."""
PRECISION = (
    "bounds on the float32 weights as real numbers, checked in float64; "
    "float32 rounding of a step counts as d"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Certificate(Claims):
    """Proved constants with their witnesses, and how far attacks came.

    Attributes:
        transport_lipschitz: Lipschitz constant of T(e → e').
        env_box: [low, high].
        params_sha256: hash of the weights.
        precision: how float arithmetic is accounted for.
        attack: largest contraction factor reached by an attack on the float32 model.
        tightness: α / attack.
        attacks: all lower bounds by name.
        versions: of the libraries that computed it.
        seconds: duration of the proof and the attacks.
    """

    transport_lipschitz: float
    env_box: list[list[float]]
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
        """Read a certificate from JSON values; other keys are ignored."""
        names = [field.name for field in dataclasses.fields(cls)]
        missing = [name for name in names if name not in document]
        require(not missing, f"not a certificate: {', '.join(missing[:3])} missing")
        return cls(**{name: document[name] for name in names})


def certify(
    model: Model, params: Params, env_box: Box, *, attack_starts: int = 6
) -> Certificate:
    """Prove a contraction factor for all z, u and e, and attack all proved bounds.

    Args:
        model: a model with `explicit`.
        params: its weights as exported.
        env_box: lower and upper corner of E.
        attack_starts: starting points of the ascent on the float32 model; with 0 there
            is no ascent and tightness is None.

    Raises:
        CertificationRefused: the model cannot be certified; gives the reason.
        CertificateContradicted: an attack exceeds a proved bound.
    """
    began = time.perf_counter()
    box = require_box("env_box", env_box).astype(float).tolist()
    weights = exported(model, params)
    claims = prove(with_room(weights))
    require(
        claims.alpha <= 1.0 - MARGIN,  # refuses NaN as well
        f"alpha = {claims.alpha:.6f} (rho {claims.rho:.6f}, beta {claims.beta:.6f}) "
        f"is not below 1 by the margin {MARGIN:g}",
    )
    # After the proof: an attack that exceeds it is a fault of the code, see there.
    attacks = attack_claims(model, params, weights, claims, box, attack_starts)
    attack = attacks.get("step")
    return Certificate(
        **vars(claims),
        transport_lipschitz=1.0,
        env_box=box,
        # Of the parameters as they are stored: what a reader of the policy recomputes.
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

    Args:
        certificate: from an untrusted source.
        params: the weights.
        model: that they belong to.
        weights: explicit weights of `params`, if already computed.

    Raises:
        CertificateStale: it is about other weights.
        CertificationRefused: a claim does not follow from its witness.
    """
    # First the hash: a proof about other weights need not be read at all.
    if fingerprint(params) != certificate.params_sha256:
        raise CertificateStale("the certificate is about other weights")
    weights = exported(model, params) if weights is None else weights
    with well_formed(), one_thread():
        require_claims(certificate, weights, certificate.env_box)
        alpha = certificate.alpha
        limits = attack_limits(certificate, weights)
        require(
            alpha < 1.0 and certificate.transport_lipschitz == 1.0,
            f"alpha = {alpha} is not below 1, or the transport is not nonexpansive",
        )
        # A text that promises more than these checks cover must not pass.
        covered = certificate.precision == PRECISION
        require(covered, "precision is not what is covered")
        for name, value in certificate.attacks.items():
            limit = limits.get(name)
            # An attack above the proved bound would contradict the document itself.
            require(
                limit is not None and 0 <= value <= limit * (1 + FLOAT32),
                f"the attack {name} = {value!r} contradicts the bound {limit}",
            )
        step = certificate.attacks.get("step")
        tightness = alpha / step if step else None
        require(
            certificate.attack == step and certificate.tightness == tightness,
            "attack or tightness does not follow from the attacks",
        )


def issue(
    model: Model,
    params: Params,
    *,
    validation: Trajectory,
    calibration: Trajectory,
    held_out: Mapping[str, Trajectory],
    boxes: Mapping[str, Any],
    runs: Mapping[str, int] | None = None,
    horizon: int = 20,
    level: Fraction = 0.95,
    attack_starts: NonNegativeInt = 6,
) -> dict[str, Any]:
    """Certify a policy and return the certificate with its tubes as a document.

    Args:
        model: the model to certify.
        params: its weights as exported.
        validation: trajectories that fix the units of the scores.
        calibration: trajectories that set d̄.
        held_out: trajectories by name, on which coverage is counted; "test" is
            exchangeable with `calibration`.
        boxes: domain of s, u and e of the measurements; nothing is claimed outside.
        runs: number of independent runs that the trajectories of "calibration" and
            "test" were cut from; by default every trajectory is one. Guarantees are
            about new runs only if there are enough of them.
        horizon: of the tubes [steps].
        level: 1 − δ of the conformal bounds.
        attack_starts: starting points of the attack on the float32 model.

    Raises:
        CertificationRefused: the model cannot be certified; gives the reason.
    """
    began = time.perf_counter()
    # First the proof: where it refuses, nothing need be measured.
    certificate = certify(model, params, boxes["env"], attack_starts=attack_starts)
    weights = with_room(exported(model, params))
    start = None
    try:
        claim = prove_lyapunov(weights)
        lyapunov = claim.document()
        start = claim.metric
    # Nothing else depends on it, so that a missing solver does not stop the rest.
    except CertificationRefused as reason:
        lyapunov = {"reason": str(reason)}
    # Folded for measurements alone: the proof is about the stored weights.
    measure = partial(residuals, model, fold(model, params, on_host))
    reference = measure(validation)
    scores = measure(calibration)
    unseen = {name: measure(part) for name, part in held_out.items()}
    outputs = {}
    largest = None
    try:
        d_bar = _one_step_bounds(reference, scores, unseen, level, runs or {})
        if model.along_path and keeps_metrics(weights):
            outputs = output_tubes(
                weights, reference, scores, unseen["test"], level=level, start=start
            )
    except ValueError as reason:
        raise CertificationRefused(str(reason)) from None
    if not model.along_path:
        # The longest step seen: an error of yaw moves the car by at most that times
        # the angle.
        moves = np.diff(np.asarray(calibration.states, np.float64)[..., :2], axis=-2)
        largest = float(np.max(np.linalg.norm(moves, axis=-1)))
    tube = tubes(
        alpha=certificate.alpha,
        lipschitz=certificate.lipschitz,
        one_step=d_bar["one_step"],
        horizon=horizon,
        largest_increment=largest,
    )
    return certificate.document() | {
        "valid": True,
        "lyapunov": lyapunov,
        "decoder_lipschitz": certificate.lipschitz.get("decoder"),
        "d_bar": d_bar,
        "tube": tube,
        "outputs": outputs,
        "boxes": dict(boxes),
        "seconds_proof": certificate.seconds,
        "seconds": time.perf_counter() - began,
    }


def _one_step_bounds(
    reference: Residuals,
    measured: Residuals,
    unseen: Mapping[str, Residuals],
    level: float,
    runs: Mapping[str, int],
) -> dict[str, Any]:
    """Bounds at `level` for whole trajectories, and their coverage."""
    units = reference.largest()
    scores = measured.largest()
    # Units from validation, or the scores of calibration would not be exchangeable.
    bounds = conformal_bounds(units, scores, level=level)
    # Only of the test part it is known how many runs it was cut from.
    counts = {"test": runs.get("test")}
    shares = {
        name: coverage(bounds, part.largest(), counts.get(name))
        for name, part in unseen.items()
    }
    one_step = dict(zip(KINDS, bounds.tolist(), strict=True))
    independent = runs.get("calibration", len(scores))
    return {
        "value": one_step["latent"],
        "level": level,
        "trajectories": len(scores),
        "runs": independent,
        # Too few runs: the bound is then about these runs, and the text says so.
        "holds_for": holds_for(independent, level),
        **shares.pop("test"),
        "by_scenario": shares,
        "one_step": one_step,
        "validation": float(np.quantile(units[:, 0], level)),
    }
