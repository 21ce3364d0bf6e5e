"""Verification of certificates from an untrusted source, without any search.

Proved constants are derived again from their witnesses, tubes and sums from the proved
and the measured constants, coverages from their counts. Measured bounds themselves
cannot be derived; they are checked to be consistent numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sfkd_jax.certification._certificate import PRECISION, Certificate
from sfkd_jax.certification._claims import (
    FLOAT32,
    OUTPUTS,
    OutputMetric,
    attack_limits,
    require_box,
    require_claims,
    require_lyapunov,
    require_output_metric,
)
from sfkd_jax.certification._measured import KINDS, counted, supports
from sfkd_jax.certification._tubes import ALONE, FORMS, JOINT, tubes
from sfkd_jax.certification._weights import (
    CertificateStale,
    Exported,
    exported,
    fingerprint,
    one_thread,
    require,
    well_formed,
)
from sfkd_jax.types import Model, Params

REPEATED = 1e-9
"""Relative tolerance of recomputed values, for another order of summation."""


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
        alpha, limits = certificate.alpha, attack_limits(certificate, weights)
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


def verify_document(
    document: Mapping[str, Any], params: Params, *, model: Model, policy_sha256: str
) -> None:
    """Check a document from an untrusted source against a policy, without any search.

    Args:
        document: from `issue`, with `policy_sha256`.
        params: the weights.
        model: the model that they belong to.
        policy_sha256: hash of the weights and of all settings of model and controller.

    Raises:
        CertificateStale: it is about other weights or settings.
        CertificationRefused: it does not hold; gives the reason.
    """
    # `is not True`: a text "false" or a number must not pass for a valid certificate.
    require(document.get("valid") is True, str(document.get("reason")))
    # Also the settings: the same weights under another controller are another policy.
    if document.get("policy_sha256") != policy_sha256:
        raise CertificateStale("the certificate is about other weights or settings")
    proof, weights = Certificate.from_document(document), exported(model, params)
    verify(proof, params, model=model, weights=weights)
    # After the proof: everything below is arithmetic on constants that hold.
    with well_formed():
        for name in ("state", "control", "env"):
            require_box(f"boxes.{name}", document["boxes"][name])
        _require_equal("boxes.env", document["boxes"]["env"], proof.env_box)
        _require_statistics(document["d_bar"])
        _require_tubes(document["tube"], proof, document["d_bar"])
        with one_thread():
            require_lyapunov(document["lyapunov"], weights)
            _require_outputs(document.get("outputs", {}), weights)
        require(
            document["decoder_lipschitz"] == proof.lipschitz.get("decoder"),
            "decoder_lipschitz is not that of lipschitz",
        )
        if (corridor := document.get("corridor")) is not None:
            outputs = document.get("outputs")
            require(outputs, "a corridor needs a metric of every output")
            require_corridor(corridor)


def _require_statistics(d_bar: Mapping[str, Any]) -> None:
    """Check measured bounds, level, counts, coverages and their intervals."""
    one_step = _numbers("d_bar.one_step", [d_bar["one_step"][kind] for kind in KINDS])
    require(np.all(one_step >= 0), "d_bar.one_step must be numbers, none below 0")
    # `value` repeats the latent bound; with two, it would be open which a tube uses.
    _require_equal("d_bar.value", d_bar["value"], d_bar["one_step"]["latent"])
    trajectories, runs, level = d_bar["trajectories"], d_bar["runs"], d_bar["level"]
    require(
        0 < level < 1 and supports(trajectories, level),
        f"d_bar.level = {level!r} is not possible with {trajectories!r} trajectories",
    )
    require(
        1 <= runs <= trajectories,
        f"d_bar.runs = {runs!r} does not fit {trajectories!r} trajectories",
    )
    for name, part in {"d_bar": d_bar, **d_bar["by_scenario"]}.items():
        _require_coverage(name, part)


def _require_tubes(
    tube: Mapping[str, Any], proof: Certificate, d_bar: Mapping[str, Any]
) -> None:
    """Check R_k, its limit, and the radii in metres and radians."""
    largest = None
    # With a decoder of increments the step length counts; it is measured.
    if "decoder" in proof.lipschitz:
        stated = tube["largest_increment_m"]
        largest = float(_numbers("tube.largest_increment_m", stated))
        require(largest >= 0, "tube.largest_increment_m is below 0")
    derived = tubes(
        alpha=proof.alpha,
        lipschitz=proof.lipschitz,
        one_step=d_bar["one_step"],
        horizon=len(tube["latent"]),
        largest_increment=largest,
    )
    _require_equal("tube", tube, derived)


def _require_outputs(outputs: Mapping[str, Any], weights: Exported) -> None:
    """Check output metrics from their witnesses, and the coverage of their tubes."""
    # All or none: a corridor needs both metrics.
    require(
        not outputs or set(outputs) == set(OUTPUTS),
        f"outputs must be {' and '.join(OUTPUTS)}, got {', '.join(map(str, outputs))}",
    )
    for name, part in outputs.items():
        require_output_metric(name, OutputMetric.from_document(part), weights)
        runs = part["coverage_runs"]
        for form in FORMS:
            radius = _numbers(f"outputs.{name}.tube", part["tube"][form])
            require(radius > 0, f"outputs.{name}.tube.{form} is no radius")
            stated = {key: part[key][form] for key in ("coverage", "coverage_ci95")}
            counts = {"coverage_trajectories": runs, "coverage_runs": runs}
            _require_coverage(f"outputs.{name}", stated | counts)


def require_corridor(corridor: Mapping[str, Any]) -> None:
    """Check sums, level and counts of the document's corridor."""
    bounds = corridor["bounds"]
    complete = set(bounds) == {*JOINT, *ALONE}
    require(
        complete and np.all(_numbers("corridor.bounds", [*bounds.values()]) > 0),
        "corridor.bounds must be positive numbers, one for each measured quantity",
    )
    # Car to nominal model plus nominal model to path: the triangle inequality.
    width = bounds["nominal"] + bounds["vehicle_to_nominal_position"]
    _require_equal("corridor.corridor_m", corridor["corridor_m"], width)
    runs, level = corridor["runs"], corridor["level"]
    require(
        isinstance(runs, int) and 0 < level < 1 and supports(runs, level),
        f"corridor.level = {level!r} is not possible with {runs!r} runs",
    )
    # The attack kept disturbances in their bound: leaving would refute the proof.
    require(
        corridor["attack"]["over_tube"] <= 1.0,
        "corridor.attack left the tube with disturbances within their bound",
    )
    for name, part in {"corridor": corridor, **corridor["by_scenario"]}.items():
        _require_coverage(name, part)


def _require_coverage(name: str, part: Mapping[str, Any]) -> None:
    """Check that a coverage is a count of trajectories, and its interval."""
    count, runs = part["coverage_trajectories"], part["coverage_runs"]
    share = part["coverage"]
    inside = round(share * count)
    require(
        0 <= inside <= count and 1 <= runs <= count,
        f"{name}: a coverage of {share!r} is not possible with {count!r} trajectories "
        f"of {runs!r} runs",
    )
    # A share must be a count over the number of trajectories, within rounding.
    for key, value in counted(inside / count, count, runs).items():
        _require_equal(f"{name}: {key}", part[key], value)


def _numbers(name: str, values: Any) -> np.ndarray:
    """Return a part of a document as an array of finite numbers."""
    array = np.asarray(values)
    # Booleans and strings are refused by the kind, before they compare as numbers.
    finite = array.dtype.kind in "if" and np.all(np.isfinite(array))
    require(finite, f"{name} must be finite numbers")
    return array


def _require_equal(name: str, stated: Any, derived: Any) -> None:
    """Check a stated value, or all by the same keys, against the derived ones."""
    if isinstance(derived, dict):
        # All keys: a value that is left out here would be checked nowhere.
        equal = set(stated) == set(derived)
        for key in derived if equal else ():
            _require_equal(f"{name}.{key}", stated[key], derived[key])
    elif derived is None:
        equal = stated is None
    else:
        # Both finite: any number is within a share of an infinite one.
        expected, actual = _numbers(name, derived), _numbers(name, stated)
        # Relative to the derived value, which an attacker cannot choose.
        equal = actual.shape == expected.shape and np.all(
            np.abs(actual - expected) <= REPEATED * np.abs(expected)
        )
    require(equal, f"{name} does not follow from the rest of the document")
