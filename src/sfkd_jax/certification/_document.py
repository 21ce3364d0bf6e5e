"""The document beside the weights, checked again: proofs from their witnesses, arithmetic by repeating it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sfkd_jax.certification._calibration import KINDS, interval, supports
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
from sfkd_jax.certification._tube import for_ever, latent_tube, path_tube, physical_tube
from sfkd_jax.types import Model, Params

REPEATED = 1e-9
"""Relative; what is computed again from the same numbers may differ by the order of
summation and no more.
"""


def verify_document(
    document: Mapping[str, Any], params: Params, *, model: Model, policy_sha256: str
) -> None:
    """Check a document of unknown origin against a policy, without any search.

    Re-derived: every proved constant from its witness, tubes from α, d̄ and L, the
    limit, counts and intervals of the coverage. d̄ and the other measured bounds cannot
    be: they are checked to be numbers that fit together.

    Args:
        document: as `issue` makes it, with `policy_sha256`.
        params: weights.
        model: that they belong to.
        policy_sha256: of the weights and of every setting that model and controller
            compute with.

    Raises:
        CertificateStale: it is about other weights or settings.
        CertificationRefused: it does not hold; why.
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
    """Boxes of body state, control and environment: finite, not reversed."""
    for name in ("state", "control", "env"):
        corners = _numbers(f"boxes.{name}", boxes[name])
        if (
            corners.ndim != 2
            or len(corners) != 2
            or not np.all(corners[0] <= corners[1])
        ):
            raise Refuted(f"boxes.{name} is no lower and upper corner")
    if not np.array_equal(
        np.asarray(boxes["env"], float), np.asarray(proof.env_box, float)
    ):
        raise Refuted("boxes.env is not the box that was certified")


def _require_statistics(d_bar: Mapping[str, Any], monitor: Mapping[str, Any]) -> None:
    """Levels, counts, shares and intervals that go together; bounds that are positive."""
    one_step = _numbers("d_bar.one_step", [d_bar["one_step"][kind] for kind in KINDS])
    bounds = _numbers("monitor.bounds", monitor["bounds"])
    if (
        bounds.shape != (len(KINDS),)
        or not np.all(bounds > 0)
        or not np.all(one_step >= 0)
    ):
        raise Refuted("measured bounds must be four numbers above 0")
    _require_equal("d_bar.value", d_bar["value"], d_bar["one_step"]["latent"])
    for name, level in (
        ("d_bar.level", d_bar["level"]),
        ("monitor.level", monitor["level"]),
    ):
        if not 0 < level < 1 or not supports(d_bar["trajectories"], level):
            raise Refuted(
                f"{name} = {level!r} cannot be had from {d_bar['trajectories']!r} trajectories"
            )
    if not 1 <= d_bar["drives"] <= d_bar["trajectories"]:
        raise Refuted(
            f"d_bar.drives = {d_bar['drives']!r} does not fit {d_bar['trajectories']!r} trajectories"
        )
    for name, part in {"d_bar": d_bar, **d_bar["by_scenario"]}.items():
        count, drives = part["coverage_trajectories"], part["coverage_drives"]
        inside = round(part["coverage"] * count)
        if not 0 <= inside <= count or not 1 <= drives <= count:
            raise Refuted(
                f"{name}: a coverage of {part['coverage']!r} of {count!r} trajectories is none"
            )
        _require_equal(f"{name}: coverage", part["coverage"], inside / count)
        _require_equal(
            f"{name}: coverage_ci95",
            part["coverage_ci95"],
            interval(part["coverage"], drives),
        )


def _require_tubes(
    tube: Mapping[str, Any], proof: Certificate, d_bar: Mapping[str, Any]
) -> None:
    """R_k, what it means in metres and radians, and its limit."""
    latent = latent_tube(proof.alpha, d_bar["value"], len(tube["latent"]))
    _require_equal("tube.latent", tube["latent"], latent)
    ultimate = d_bar["value"] / (1 - proof.alpha)
    _require_equal("tube.ultimate", tube["ultimate"], ultimate)
    known = {
        "alpha": proof.alpha,
        "lipschitz": proof.lipschitz,
        "residual": d_bar["one_step"],
    }
    if "decoder" in proof.lipschitz:
        largest = float(
            _numbers("tube.largest_increment_m", tube["largest_increment_m"])
        )
        physical, always = (
            physical_tube(latent, **known, largest_increment=abs(largest)),
            None,
        )
    else:
        largest, physical, always = (
            0.0,
            path_tube(latent, **known),
            for_ever(ultimate, **known),
        )
    if (
        largest < 0
        or set(tube["physical"]) != set(physical)
        or (tube["for_ever"] is None) != (always is None)
    ):
        raise Refuted("tube is not of position, yaw and body state")
    for name, radius in (always or {}).items():
        _require_equal(f"tube.for_ever.{name}", tube["for_ever"][name], radius)
    for name, radii in physical.items():
        _require_equal(f"tube.physical.{name}", tube["physical"][name], radii)


def _require_outputs(document: Mapping[str, Any], weights: Exported) -> None:
    """Constants in other metrics from their witnesses; tubes and corridor as far as arithmetic goes."""
    outputs, corridor = document.get("outputs", {}), document.get("corridor")
    if outputs and set(outputs) != set(OUTPUTS):
        raise Refuted(
            f"outputs must be {' and '.join(OUTPUTS)}, got {', '.join(map(str, outputs))}"
        )
    for name, part in outputs.items():
        with one_thread():
            require_output_metric(name, OutputMetric.from_document(part), weights)
        for form in FORMS:
            if not _numbers(f"outputs.{name}.tube", part["tube"][form]) > 0:
                raise Refuted(f"outputs.{name}.tube.{form} is no radius")
            share, drives = part["coverage"][form], part["coverage_drives"]
            _require_equal(
                f"outputs.{name}: coverage", share, round(share * drives) / drives
            )
            _require_equal(
                f"outputs.{name}: coverage_ci95",
                part["coverage_ci95"][form],
                interval(share, drives),
            )
    if corridor is not None:
        if not outputs:
            raise Refuted("a corridor needs a metric of every output")
        require_corridor(corridor, outputs["position"])


def _numbers(name: str, values: Any) -> np.ndarray:
    """A part of the document as an array of finite numbers."""
    array = np.asarray(values)
    if array.dtype.kind not in "if" or not np.all(np.isfinite(array)):
        raise Refuted(f"{name} holds what is no number")
    return array


def _require_equal(name: str, stated: Any, derived: Any) -> None:
    """Refuse what is not what it follows from."""
    expected = np.asarray(derived, dtype=np.float64)
    found = _numbers(name, stated)
    if found.shape != expected.shape or not np.all(
        np.abs(found - expected) <= REPEATED * np.abs(expected)
    ):
        raise Refuted(f"{name} does not follow from what it is computed from")
