"""The certificate document of a policy: issued, and verified from its witnesses."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

import jax
import numpy as np

from sfkd_jax.certification._calibration import (
    KINDS,
    conformal_bounds,
    coverage,
    coverage_interval,
    disturbances,
    supports,
    tube_units,
)
from sfkd_jax.certification._certificate import (
    MALFORMED,
    Certificate,
    CertificateStale,
    certify,
    verify,
)
from sfkd_jax.certification._claims import (
    OUTPUTS,
    LyapunovClaim,
    OutputMetric,
    Refuted,
    require_lyapunov,
    require_output_metric,
)
from sfkd_jax.certification._corridor import (
    numbers,
    require_corridor,
    require_coverage,
    require_equal,
)
from sfkd_jax.certification._lyapunov import prove_lyapunov
from sfkd_jax.certification._tubes import (
    FORMS,
    latent_tube,
    output_tubes,
    path_tube,
    physical_tube,
    ultimate_tube,
)
from sfkd_jax.certification._weights import (
    CertificationRefused,
    Exported,
    exported,
    one_thread,
)
from sfkd_jax.ranges import Fraction, Interval, NonNegativeInt
from sfkd_jax.rollout import fold
from sfkd_jax.types import Model, Params, Trajectory


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
    margin: Annotated[float, Interval("[0, 1)")] = 1e-4,
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
        margin: as in `certify`.
        attack_starts: as in `certify`.

    Raises:
        CertificationRefused: the model cannot be certified; gives the reason.
    """
    began = time.perf_counter()
    # First the proof: where it refuses, nothing need be measured.
    certificate = certify(
        model, params, boxes["env"], margin=margin, attack_starts=attack_starts
    )
    weights = exported(model, params)
    function, lyapunov = _lyapunov(weights)
    # Folded for measurements alone: the proof is about the stored weights.
    folded = jax.jit(partial(fold, model))(params)
    parts = {"validation": validation, "calibration": calibration}
    try:
        measured = _measure(model, folded, **parts, held_out=held_out, level=level)
        if runs is not None:
            measured = _counted_by_run(measured, runs)
        outputs = output_tubes(
            model,
            folded,
            weights,
            **parts,
            test=held_out["test"],
            level=level,
            lyapunov=function,
        )
    except ValueError as reason:
        raise CertificationRefused(str(reason)) from None
    return (
        {"valid": True}
        | certificate.document()
        | {
            "lyapunov": lyapunov,
            "decoder_lipschitz": certificate.lipschitz.get("decoder"),
            "d_bar": measured,
            "tube": _tubes(model, certificate, measured, calibration, horizon),
            "outputs": outputs,
            "boxes": dict(boxes),
            "seconds_proof": certificate.seconds,
            "seconds": time.perf_counter() - began,
        }
    )


def _lyapunov(weights: Exported) -> tuple[LyapunovClaim | None, dict[str, Any]]:
    """A common Lyapunov function and its part of the document, or the reason for none.

    Nothing else depends on it, so that a missing solver does not stop the rest.
    """
    try:
        with one_thread():
            function = prove_lyapunov(weights)
    except Refuted as reason:
        return None, {"reason": str(reason)}
    return function, function.document()


def _measure(
    model: Model,
    params: Params,
    validation: Trajectory,
    calibration: Trajectory,
    held_out: Mapping[str, Trajectory],
    level: float,
) -> dict[str, Any]:
    """One-step bounds at `level` for whole trajectories, and their coverage."""
    reference = disturbances(model, params, validation)
    scores = disturbances(model, params, calibration)
    # Units from validation, or the scores of calibration would not be exchangeable.
    bounds = conformal_bounds(tube_units(reference, level=level), scores, level=level)
    shares = {
        name: coverage(bounds, disturbances(model, params, part))
        for name, part in held_out.items()
    }
    one_step = dict(zip(KINDS, bounds.tolist(), strict=True))
    return {
        "value": one_step["latent"],
        "level": level,
        "trajectories": len(scores),
        "runs": len(scores),
        # True for one segment a run; `_counted_by_run` says less where it is not.
        "holds_for": "new runs like these",
        **shares.pop("test"),
        "by_scenario": shares,
        "one_step": one_step,
        "validation": float(np.quantile(reference[:, 0], level)),
    }


def _counted_by_run(
    measured: dict[str, Any], runs: Mapping[str, int]
) -> dict[str, Any]:
    """The same bounds of trajectories that were cut from fewer, independent runs."""
    independent = runs.get("calibration", measured["runs"])
    tested = runs.get("test", measured["coverage_runs"])
    # Too few runs: the bound is then about these runs, and the text says so.
    if not supports(independent, measured["level"]):
        measured["holds_for"] = f"further segments of the same {independent} runs"
    interval = coverage_interval(measured["coverage"], tested)
    return measured | {
        "runs": independent,
        "coverage_runs": tested,
        "coverage_ci95": interval,
    }


def _tubes(
    model: Model,
    certificate: Certificate,
    measured: Mapping[str, Any],
    calibration: Trajectory,
    horizon: int,
) -> dict[str, Any]:
    """Tubes up to the horizon and their limit, from α, L and the one-step bounds."""
    latent = latent_tube(certificate.alpha, measured["value"], horizon)
    # R_k → d̄ / (1 − α), the fixed point of R ↦ α R + d̄.
    ultimate = measured["value"] / (1 - certificate.alpha)
    constants = {
        "alpha": certificate.alpha,
        "lipschitz": certificate.lipschitz,
        "residual": measured["one_step"],
    }
    largest, limit = None, None
    # Without increments nothing accumulates, so that only here there is a limit.
    if model.along_path:
        physical = path_tube(latent, **constants)
        limit = ultimate_tube(ultimate, **constants)
    else:
        # The longest step seen: an error of yaw moves
        # the car by at most that times the angle.
        positions = np.asarray(calibration.states, dtype=np.float64)[..., :2]
        largest = float(np.max(np.linalg.norm(np.diff(positions, axis=-2), axis=-1)))
        physical = physical_tube(latent, **constants, largest_increment=largest)
    return {
        "latent": latent.tolist(),
        "physical": physical,
        "ultimate": ultimate,
        "asymptotic": limit,
        "largest_increment_m": largest,
    }


def output_metrics_from(outputs: Mapping[str, Any]) -> dict[str, OutputMetric]:
    """Read the proved metric of every output from a document."""
    return {name: OutputMetric.from_document(part) for name, part in outputs.items()}


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
    # `is not True`: a text "false" or a number must not pass for a valid certificate.
    if document.get("valid") is not True:
        raise CertificationRefused(str(document.get("reason")))
    # Also the settings: the same weights under another controller are another policy.
    if document.get("policy_sha256") != policy_sha256:
        raise CertificateStale("the certificate is about other weights or settings")
    proof = Certificate.from_document(document)
    weights = exported(model, params)
    verify(proof, params, model=model, weights=weights)
    try:
        # After the proof: everything below is arithmetic on constants that hold.
        _require_boxes(document["boxes"], proof)
        _require_statistics(document["d_bar"])
        _require_tubes(document["tube"], proof, document["d_bar"])
        with one_thread():
            require_lyapunov(document["lyapunov"], weights)
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
        corners = numbers(f"boxes.{name}", boxes[name])
        pair = corners.ndim == 2 and len(corners) == 2
        # Equal corners are allowed: a condition may be constant.
        if not pair or not np.all(corners[0] <= corners[1]):
            raise Refuted(f"boxes.{name} is not a lower and an upper corner")
    stated, certified = (
        np.asarray(box, float) for box in (boxes["env"], proof.env_box)
    )
    if not np.array_equal(stated, certified):
        raise Refuted("boxes.env is not the box that was certified")


def _require_statistics(d_bar: Mapping[str, Any]) -> None:
    """Check measured bounds, level, counts, coverages and their intervals."""
    one_step = numbers("d_bar.one_step", [d_bar["one_step"][kind] for kind in KINDS])
    if not np.all(one_step >= 0):
        raise Refuted("d_bar.one_step must be four numbers, none below 0")
    # `value` repeats the latent bound; with two, it would be open which a tube uses.
    require_equal("d_bar.value", d_bar["value"], d_bar["one_step"]["latent"])
    trajectories, runs, level = d_bar["trajectories"], d_bar["runs"], d_bar["level"]
    if not 0 < level < 1 or not supports(trajectories, level):
        raise Refuted(
            f"d_bar.level = {level!r} is not possible "
            f"with {trajectories!r} trajectories"
        )
    if not 1 <= runs <= trajectories:
        raise Refuted(
            f"d_bar.runs = {runs!r} does not fit {trajectories!r} trajectories"
        )
    for name, part in {"d_bar": d_bar, **d_bar["by_scenario"]}.items():
        require_coverage(name, part)


def _require_tubes(
    tube: Mapping[str, Any], proof: Certificate, d_bar: Mapping[str, Any]
) -> None:
    """Check R_k, its limit, and the radii in metres and radians."""
    latent = latent_tube(proof.alpha, d_bar["value"], len(tube["latent"]))
    require_equal("tube.latent", tube["latent"], latent)
    ultimate = d_bar["value"] / (1 - proof.alpha)
    require_equal("tube.ultimate", tube["ultimate"], ultimate)
    constants = {
        "alpha": proof.alpha,
        "lipschitz": proof.lipschitz,
        "residual": d_bar["one_step"],
    }
    # With a decoder of increments the pose drifts: no limit, and the step length counts
    if "decoder" in proof.lipschitz:
        stated = numbers("tube.largest_increment_m", tube["largest_increment_m"])
        largest, limit = float(stated), None
        physical = physical_tube(latent, **constants, largest_increment=abs(largest))
    else:
        largest, limit = 0.0, ultimate_tube(ultimate, **constants)
        physical = path_tube(latent, **constants)
    # All outputs: a radius that is left out here would be checked nowhere.
    complete = set(tube["physical"]) == set(physical)
    limited = (tube["asymptotic"] is None) == (limit is None)
    if largest < 0 or not complete or not limited:
        raise Refuted("tube is not of position, yaw and body state")
    for name, radius in (limit or {}).items():
        require_equal(f"tube.asymptotic.{name}", tube["asymptotic"][name], radius)
    for name, radii in physical.items():
        require_equal(f"tube.physical.{name}", tube["physical"][name], radii)


def _require_outputs(document: Mapping[str, Any], weights: Exported) -> None:
    """Check output metrics from their witnesses, and the arithmetic of the corridor."""
    outputs, corridor = document.get("outputs", {}), document.get("corridor")
    # All or none: a corridor needs both metrics.
    if outputs and set(outputs) != set(OUTPUTS):
        actual = ", ".join(map(str, outputs))
        raise Refuted(f"outputs must be {' and '.join(OUTPUTS)}, got {actual}")
    for name, part in outputs.items():
        require_output_metric(name, OutputMetric.from_document(part), weights)
        runs = part["coverage_runs"]
        for form in FORMS:
            if not numbers(f"outputs.{name}.tube", part["tube"][form]) > 0:
                raise Refuted(f"outputs.{name}.tube.{form} is not a radius")
            counted = {
                "coverage": part["coverage"][form],
                "coverage_ci95": part["coverage_ci95"][form],
                "coverage_trajectories": runs,
                "coverage_runs": runs,
            }
            require_coverage(f"outputs.{name}", counted)
    if corridor is not None:
        if not outputs:
            raise Refuted("a corridor needs a metric of every output")
        require_corridor(corridor)
