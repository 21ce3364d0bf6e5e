"""Certificates of contraction for all z, u and e, and the document of a policy.

`certify` proves and attacks, `verify` checks without a search, and `issue` adds what is
measured.
"""

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
    require_box,
    require_claims,
    with_room,
)
from sfkd_jax.certification._core import Matrix
from sfkd_jax.certification._measured import (
    RESIDUALS,
    Residuals,
    conformal_bounds,
    coverage,
    holds_for,
    residuals,
)
from sfkd_jax.certification._metric_claims import (
    keeps_metrics,
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
"""Distance from 1 below which α must be."""
PRECISION = (
    "bounds on the float32 weights as real numbers, checked in float64; "
    "float32 rounding of a step counts as d"
)
"""How a certificate accounts for the rounding of its numbers, as it states it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Certificate(Claims):
    """Proved constants with their witnesses, and how far attacks came.

    Attributes:
        transport_lipschitz: Lipschitz constant of T(e → e').
        env_box: [low, high], the corners of E.
        params_sha256: hash of the weights.
        precision: how the rounding of numbers is accounted for.
        attack: largest slope of a step that an attack on the float32 model reached;
            None without an attack.
        tightness: α / attack; None without an attack.
        attacks: slopes that all attacks reached, by name. They are lower bounds of the
            proved constants.
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
        """Read a certificate from JSON values; other keys are ignored.

        Raises:
            CertificationRefused: a key is missing.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        missing = [name for name in names if name not in document]
        require(not missing, f"not a certificate: {', '.join(missing[:3])} missing")
        return cls(**{name: document[name] for name in names})


def certify(
    model: Model, params: Params, env_box: Box, *, attack_starts: int = 6
) -> Certificate:
    """Prove a contraction factor for all z, u and e, and attack all proved bounds.

    Args:
        model: with explicit weights, `model.structure.explicit`.
        params: its weights as exported.
        env_box: lower and upper corner of E.
        attack_starts: number of starting points of each ascent on the float32 model.
            With 0 there is no ascent, and tightness is None.

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
    # The attacks come after the proof. One that exceeds it shows a fault of the code.
    attacks = attack_claims(model, params, weights, claims, box, attack_starts)
    attack = attacks.get("step")
    return Certificate(
        **vars(claims),
        transport_lipschitz=1.0,
        env_box=box,
        # Of the parameters as they are stored, so that a reader of the policy can
        # compute the hash again.
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
        weights: explicit weights of `params`; None to compute them here.

    Raises:
        CertificateStale: it is about other weights.
        CertificationRefused: a claim does not follow from its witness.
    """
    # The hash comes first: a proof about other weights need not be read at all.
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
        require(certificate.precision == PRECISION, "precision is not what is covered")
        for name, value in certificate.attacks.items():
            limit = limits.get(name)
            # With an attack above the proved bound the document contradicts itself.
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
        held_out: trajectories by name, on which coverage is counted. "test" is
            exchangeable with `calibration`.
        boxes: domain of s, u and e of the measurements; nothing is claimed outside.
        runs: number of independent runs that the trajectories of "calibration" and
            "test" were cut from. By default every trajectory is a run. Guarantees are
            about new runs only if there are enough of them.
        horizon: of the tubes [steps].
        level: 1 − δ of the conformal bounds.
        attack_starts: number of starting points of each ascent on the float32 model.

    Raises:
        CertificationRefused: the model cannot be certified; gives the reason.
    """
    began = time.perf_counter()
    # The proof comes first: where it is refused, nothing need be measured.
    certificate = certify(model, params, boxes["env"], attack_starts=attack_starts)
    weights = with_room(exported(model, params))
    lyapunov, start = _lyapunov(weights)
    # Folded for the measurements alone. The proof is about the stored weights.
    measure = partial(residuals, model, fold(model, params, on_host))
    reference = measure(validation)
    scores = measure(calibration)
    unseen = {name: measure(part) for name, part in held_out.items()}
    outputs = {}
    try:
        d_bar = _one_step_bounds(reference, scores, unseen, level, runs or {})
        if model.along_path and keeps_metrics(weights):
            outputs = output_tubes(
                weights, reference, scores, unseen["test"], level=level, start=start
            )
    except ValueError as reason:
        raise CertificationRefused(str(reason)) from None
    document = certificate.document()
    document.update(
        valid=True,
        lyapunov=lyapunov,
        decoder_lipschitz=certificate.lipschitz.get("decoder"),
        d_bar=d_bar,
        tube=tubes(
            alpha=certificate.alpha,
            lipschitz=certificate.lipschitz,
            one_step=d_bar["one_step"],
            horizon=horizon,
            largest_increment=(
                None if model.along_path else _longest_step(calibration)
            ),
        ),
        outputs=outputs,
        boxes=dict(boxes),
        seconds_proof=certificate.seconds,
        seconds=time.perf_counter() - began,
    )
    return document


def _lyapunov(weights: Exported) -> tuple[dict[str, Any], Matrix | None]:
    """Return the entry about a Lyapunov function of all operators, and its matrix.

    If there is none, the entry gives the reason and the matrix is None. Nothing else
    depends on it, so that a missing solver does not stop the rest.
    """
    try:
        claim = prove_lyapunov(weights)
    except CertificationRefused as reason:
        return {"reason": str(reason)}, None
    return claim.document(), claim.metric


def _longest_step(runs: Trajectory) -> float:
    """Return the longest way of a step in the runs [m].

    An error of yaw moves the car by at most this length times the angle.
    """
    moves = np.diff(np.asarray(runs.states, np.float64)[..., :2], axis=-2)
    return float(np.max(np.linalg.norm(moves, axis=-1)))


def _one_step_bounds(
    reference: Residuals,
    measured: Residuals,
    unseen: Mapping[str, Residuals],
    level: float,
    runs: Mapping[str, int],
) -> dict[str, Any]:
    """Return the entry about the errors of single steps.

    Args:
        reference: of the validation part, which fixes the units.
        measured: of the calibration part.
        unseen: of parts on which the coverage is counted, by name.
        level: with which the bounds hold for a whole trajectory.
        runs: number of independent runs of "calibration" and "test".
    """
    # If the scores of the calibration fixed their own units, they would not be
    # exchangeable with a new score.
    units = reference.largest()
    scores = measured.largest()
    bounds = conformal_bounds(units, scores, level=level)
    shares = {}
    for name, part in unseen.items():
        # Only of the test part it is known how many runs it was cut from.
        count = runs.get("test") if name == "test" else None
        shares[name] = coverage(bounds, part.largest(), count)
    one_step = dict(zip(RESIDUALS, bounds.tolist(), strict=True))
    independent = runs.get("calibration", len(scores))
    return {
        "value": one_step["latent"],
        "level": level,
        "trajectories": len(scores),
        "runs": independent,
        # With too few runs the bound is about these runs alone, and this text says so.
        "holds_for": holds_for(independent, level),
        **shares.pop("test"),
        "by_scenario": shares,
        "one_step": one_step,
        "validation": float(np.quantile(units[:, 0], level)),
    }
