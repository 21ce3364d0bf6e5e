"""Proof of contraction for all z, u and e, and its check without a search."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfkd_jax.certificate import Claims, LyapunovClaim, OutputMetric, Proof
from sfkd_jax.certification._attack import attack_claims
from sfkd_jax.certification._claims import (
    FLOAT32,
    attack_limits,
    readouts,
    require_box,
    require_claims,
    with_room,
)
from sfkd_jax.certification._measured import residuals, worst_gaps
from sfkd_jax.certification._metric_claims import (
    outputs_with_metric,
    require_lyapunov,
    require_output_metrics,
)
from sfkd_jax.certification._metrics import (
    ProvedMetric,
    propose_metric,
    prove_lyapunov,
)
from sfkd_jax.certification._search import prove_claims
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
from sfkd_jax.ranges import NonNegativeInt
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.types import Model, Params, Trajectory

MARGIN = 1e-4
"""Distance from 1 below which α must be."""
PRECISION = (
    "bounds on the float32 weights as real numbers, checked in float64; "
    "float32 rounding of a step counts as d"
)
"""How a certificate accounts for the rounding of its numbers, as it states it."""


def prove(
    model: Model,
    params: Params,
    env_box: Any,
    *,
    validation: Trajectory | None = None,
    attack_starts: NonNegativeInt = 6,
) -> Proof:
    """Prove a contraction factor for all z, u and e, and attack all proved bounds.

    Args:
        model: with explicit weights, `model.structure.explicit`.
        params: its weights as exported.
        env_box: lower and upper corner of E.
        validation: runs for whose errors metrics of the outputs are searched, beside a
            common Lyapunov function. Without them the proof is in the 2-norm alone.
        attack_starts: number of starting points of each ascent on the float32 model.
            With 0 there is no ascent, and tightness is None.

    Raises:
        CertificationRefused: the model cannot be certified; gives the reason.
        CertificateContradicted: an attack exceeds a proved bound.
    """
    box = require_box("env_box", env_box)
    weights = exported(model, params)
    larger = with_room(weights)
    claims = prove_claims(larger, model.frame)
    require(
        claims.alpha <= 1.0 - MARGIN,  # refuses NaN as well
        f"alpha = {claims.alpha:.6f} (rho {claims.rho:.6f}, beta {claims.beta:.6f}) "
        f"is not below 1 by the margin {MARGIN:g}",
    )
    # The attacks come after the proof. One that exceeds it shows a fault of the code.
    attacks = attack_claims(model, params, weights, claims, box, attack_starts)
    lyapunov = refused = None
    outputs = {}
    if validation is not None:
        lyapunov, refused = _lyapunov(larger)
        proved = _proved_metrics(larger, claims, lyapunov)
        outputs = _metrics_of_outputs(model, params, larger, proved, validation)
    return Proof(
        **vars(claims),
        transport_lipschitz=1.0,
        lyapunov=lyapunov,
        lyapunov_refused=refused,
        outputs=outputs,
        env_box=box,
        # Of the parameters as they are stored, so that a reader of the policy can
        # compute the hash again.
        params_sha256=fingerprint(params),
        precision=PRECISION,
        attacks=attacks,
        tightness=_tightness(claims.alpha, attacks),
    )


def _lyapunov(weights: Exported) -> tuple[LyapunovClaim | None, str | None]:
    """Return a common Lyapunov function, or the reason why there is none.

    Nothing else depends on it, so that a missing solver does not stop the rest.
    """
    try:
        return prove_lyapunov(weights), None
    except CertificationRefused as reason:
        return None, str(reason)


def _proved_metrics(
    weights: Exported, claims: Claims, lyapunov: LyapunovClaim | None
) -> list[ProvedMetric]:
    """Return the metrics in which a step is known to contract."""
    proved: list[ProvedMetric] = []
    joint = claims.witnesses.joint
    if claims.alpha_joint < 1.0:
        identity = np.eye(weights.operators.vertices.shape[-1])
        proved.append((identity, joint))
    if lyapunov is not None:
        proved.append((np.asarray(lyapunov.metric), lyapunov.joint))
    return proved


def _metrics_of_outputs(
    model: Model,
    params: Params,
    weights: Exported,
    proved: list[ProvedMetric],
    validation: Trajectory,
) -> dict[str, OutputMetric]:
    """Return a metric for each output that may have one.

    There is none if there is no metric for one of them: a proof is about all outputs,
    or says that it is about none.
    """
    names = outputs_with_metric(weights, model.frame)
    if not names:
        return {}
    rows = readouts(weights, model.frame)
    gaps = worst_gaps(residuals(model, fold(model, params, on_host), validation))
    try:
        return {
            name: propose_metric(weights, rows[name], gaps, proved) for name in names
        }
    except CertificationRefused:
        return {}


def _tightness(alpha: float, attacks: dict[str, float]) -> float | None:
    """Return α over the largest slope of a step, None without such an attack."""
    step = attacks.get("step")
    return alpha / step if step else None


def verify_proof(
    proof: Proof, model: Model, params: Params, *, weights: Exported | None = None
) -> None:
    """Check every entry of a proof against weights, without any search.

    Args:
        proof: from an untrusted source.
        model: that the weights belong to.
        params: the weights.
        weights: explicit weights of `params`; None to compute them here.

    Raises:
        CertificateStale: it is about other weights.
        CertificationRefused: a claim does not follow from its witness.
    """
    # The hash comes first: a proof about other weights need not be read at all.
    if fingerprint(params) != proof.params_sha256:
        raise CertificateStale("the certificate is about other weights")
    weights = exported(model, params) if weights is None else weights
    with well_formed(), one_thread():
        require_claims(proof, weights, model.frame)
        require_box("env_box", proof.env_box)
        require(
            proof.alpha < 1.0 and proof.transport_lipschitz == 1.0,
            f"alpha = {proof.alpha} is not below 1, or the transport expands",
        )
        # A text that promises more than these checks cover must not pass.
        require(proof.precision == PRECISION, "precision is not what is covered")
        _require_attacks(proof, weights)
        require_lyapunov(proof, weights)
        require_output_metrics(proof.outputs, weights, model.frame)


def _require_attacks(proof: Proof, weights: Exported) -> None:
    """Refuse attacks above their bounds, with which a proof contradicts itself."""
    limits = attack_limits(proof, weights)
    for name, value in proof.attacks.items():
        limit = limits.get(name)
        require(
            limit is not None and 0 <= value <= limit * (1 + FLOAT32),
            f"the attack {name} = {value!r} contradicts the bound {limit}",
        )
    require(
        proof.tightness == _tightness(proof.alpha, proof.attacks),
        "tightness does not follow from the attacks",
    )
