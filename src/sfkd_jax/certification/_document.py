"""Verification of certificate.json: proofs from their witnesses, and all arithmetic."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sfkd_jax.certification._calibration import KINDS, coverage_interval, supports
from sfkd_jax.certification._certificate import (
    MALFORMED,
    Certificate,
    CertificateStale,
    verify,
)
from sfkd_jax.certification._claims import Refuted
from sfkd_jax.certification._corridor_claims import require_corridor
from sfkd_jax.certification._exported import (
    CertificationRefused,
    Exported,
    exported,
    one_thread,
)
from sfkd_jax.certification._output_metrics import (
    OUTPUTS,
    OutputMetric,
    require_output_metric,
)
from sfkd_jax.certification._output_tubes import FORMS
from sfkd_jax.certification._tube import (
    latent_tube,
    path_tube,
    physical_tube,
    ultimate_tube,
)
from sfkd_jax.types import Model, Params

REPEATED = 1e-9
"""Relative tolerance of recomputed values, for another order of summation."""


def verify_document(
    document: Mapping[str, Any], params: Params, *, model: Model, policy_sha256: str
) -> None:
    """Check a document from an untrusted source against a policy, without any search.

    Every proved constant is derived again from its witness; tubes from α, d̄ and L; and
    the counts and intervals of coverages. d̄ and the other measured bounds cannot be
    derived; they are checked to be consistent numbers.

    Args:
        document: from `issue`, with `policy_sha256`.
        params: the weights.
        model: the model that they belong to.
        policy_sha256: hash of the weights and of all settings of model and controller.

    Raises:
        CertificateStale: it is about other weights or settings.
        CertificationRefused: it does not hold; gives the reason.
    """
    if document.get("valid") is not True:
        raise CertificationRefused(str(document.get("reason")))
    if document.get("policy_sha256") != policy_sha256:
        raise CertificateStale("the certificate is about other weights or settings")
    proof = Certificate.from_document(dict(document))
    weights = exported(model, params)
    verify(proof, params, model=model, weights=weights)
    try:
        _require_boxes(document["boxes"], proof)
        _require_statistics(document["d_bar"], document["monitor"])
        _require_tubes(document["tube"], proof, document["d_bar"])
        _require_outputs(document, weights)
        if document["decoder_lipschitz"] != proof.lipschitz.get("decoder"):
            raise Refuted("decoder_lipschitz is not that of lipschitz")
    except Refuted as reason:
        raise CertificationRefused(str(reason)) from None
    except MALFORMED as reason:
        raise CertificationRefused(
            f"the certificate is malformed: {' '.join(str(reason).split())}"
        ) from None


def _require_boxes(boxes: Mapping[str, Any], proof: Certificate) -> None:
    """Check that the boxes of body state, control and e are finite and not reversed."""
    for name in ("state", "control", "env"):
        corners = _numbers(f"boxes.{name}", boxes[name])
        pair = corners.ndim == 2 and len(corners) == 2
        if not pair or not np.all(corners[0] <= corners[1]):
            raise Refuted(f"boxes.{name} is not a lower and an upper corner")
    stated, certified = (
        np.asarray(box, float) for box in (boxes["env"], proof.env_box)
    )
    if not np.array_equal(stated, certified):
        raise Refuted("boxes.env is not the box that was certified")


def _require_statistics(d_bar: Mapping[str, Any], monitor: Mapping[str, Any]) -> None:
    """Check measured bounds, levels, counts, coverages and their intervals."""
    one_step = _numbers("d_bar.one_step", [d_bar["one_step"][kind] for kind in KINDS])
    bounds = _numbers("monitor.bounds", monitor["bounds"])
    complete = bounds.shape == (len(KINDS),)
    if not complete or not np.all(bounds > 0) or not np.all(one_step >= 0):
        raise Refuted("measured bounds must be four numbers above 0")
    _require_equal("d_bar.value", d_bar["value"], d_bar["one_step"]["latent"])
    levels = {"d_bar.level": d_bar["level"], "monitor.level": monitor["level"]}
    trajectories, drives = d_bar["trajectories"], d_bar["drives"]
    for name, level in levels.items():
        if not 0 < level < 1 or not supports(trajectories, level):
            raise Refuted(
                f"{name} = {level!r} is not possible with {trajectories!r} trajectories"
            )
    if not 1 <= drives <= trajectories:
        raise Refuted(
            f"d_bar.drives = {drives!r} does not fit {trajectories!r} trajectories"
        )
    for name, part in {"d_bar": d_bar, **d_bar["by_scenario"]}.items():
        _require_coverage(name, part)


def _require_coverage(name: str, part: Mapping[str, Any]) -> None:
    """Check that a coverage is a count of trajectories, and its interval."""
    count, drives = part["coverage_trajectories"], part["coverage_drives"]
    share = part["coverage"]
    inside = round(share * count)
    if not 0 <= inside <= count or not 1 <= drives <= count:
        raise Refuted(
            f"{name}: a coverage of {share!r} is not possible with {count!r} "
            f"trajectories of {drives!r} drives"
        )
    _require_equal(f"{name}: coverage", share, inside / count)
    ends = coverage_interval(share, drives)
    _require_equal(f"{name}: coverage_ci95", part["coverage_ci95"], ends)


def _require_tubes(
    tube: Mapping[str, Any], proof: Certificate, d_bar: Mapping[str, Any]
) -> None:
    """Check R_k, its limit, and the radii in metres and radians."""
    latent = latent_tube(proof.alpha, d_bar["value"], len(tube["latent"]))
    _require_equal("tube.latent", tube["latent"], latent)
    ultimate = d_bar["value"] / (1 - proof.alpha)
    _require_equal("tube.ultimate", tube["ultimate"], ultimate)
    constants = {
        "alpha": proof.alpha,
        "lipschitz": proof.lipschitz,
        "residual": d_bar["one_step"],
    }
    if "decoder" in proof.lipschitz:
        stated = _numbers("tube.largest_increment_m", tube["largest_increment_m"])
        largest, limit = float(stated), None
        physical = physical_tube(latent, **constants, largest_increment=abs(largest))
    else:
        largest, limit = 0.0, ultimate_tube(ultimate, **constants)
        physical = path_tube(latent, **constants)
    complete = set(tube["physical"]) == set(physical)
    limited = (tube["for_ever"] is None) == (limit is None)
    if largest < 0 or not complete or not limited:
        raise Refuted("tube is not of position, yaw and body state")
    for name, radius in (limit or {}).items():
        _require_equal(f"tube.for_ever.{name}", tube["for_ever"][name], radius)
    for name, radii in physical.items():
        _require_equal(f"tube.physical.{name}", tube["physical"][name], radii)


def _require_outputs(document: Mapping[str, Any], weights: Exported) -> None:
    """Check output metrics from their witnesses, and the arithmetic of the corridor."""
    outputs, corridor = document.get("outputs", {}), document.get("corridor")
    if outputs and set(outputs) != set(OUTPUTS):
        actual = ", ".join(map(str, outputs))
        raise Refuted(f"outputs must be {' and '.join(OUTPUTS)}, got {actual}")
    for name, part in outputs.items():
        with one_thread():
            require_output_metric(name, OutputMetric.from_document(part), weights)
        for form in FORMS:
            if not _numbers(f"outputs.{name}.tube", part["tube"][form]) > 0:
                raise Refuted(f"outputs.{name}.tube.{form} is not a radius")
            share, drives = part["coverage"][form], part["coverage_drives"]
            counted = round(share * drives) / drives
            _require_equal(f"outputs.{name}: coverage", share, counted)
            stated, ends = part["coverage_ci95"][form], coverage_interval(share, drives)
            _require_equal(f"outputs.{name}: coverage_ci95", stated, ends)
    if corridor is not None:
        if not outputs:
            raise Refuted("a corridor needs a metric of every output")
        require_corridor(corridor, outputs["position"])


def _numbers(name: str, values: Any) -> np.ndarray:
    """Return a part of the document as an array of finite numbers."""
    array = np.asarray(values)
    if array.dtype.kind not in "if" or not np.all(np.isfinite(array)):
        raise Refuted(f"{name} must be finite numbers")
    return array


def _require_equal(name: str, stated: Any, derived: Any) -> None:
    """Check a stated value against the derived one."""
    expected = np.asarray(derived, dtype=np.float64)
    actual = _numbers(name, stated)
    if actual.shape != expected.shape or not np.all(
        np.abs(actual - expected) <= REPEATED * np.abs(expected)
    ):
        raise Refuted(f"{name} does not follow from the rest of the document")
