"""The certificate document of a policy: proved constants, measured bounds and tubes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax.certification._attack import attack_slopes
from sfkd_jax.certification._calibration import (
    KINDS,
    Disturbance,
    conformal_bounds,
    coverage,
    coverage_interval,
    disturbances,
    monitor_units,
    supports,
    tube_units,
)
from sfkd_jax.certification._certificate import Certificate, certify
from sfkd_jax.certification._exported import CertificationRefused, exported, one_thread
from sfkd_jax.certification._output_tubes import output_tubes
from sfkd_jax.certification._proofs import joint_bound, residual_bound
from sfkd_jax.certification._tube import (
    latent_tube,
    path_tube,
    physical_tube,
    ultimate_tube,
)
from sfkd_jax.ranges import Fraction, Interval, NonNegativeInt
from sfkd_jax.rollout import fold
from sfkd_jax.types import Key, Model, Params, Polytope, Trajectory


def issue(
    model: Model,
    params: Params,
    *,
    validation: Trajectory,
    calibration: Trajectory,
    held_out: Mapping[str, Trajectory],
    boxes: Mapping[str, Any],
    drives: Mapping[str, int] | None = None,
    sensor_noise: tuple[float, ...] = (),
    mode: str = "joint",
    horizon: int = 20,
    level: Fraction = 0.95,
    margin: Annotated[float, Interval("[0, 1)")] = 1e-4,
    attack_starts: NonNegativeInt = 6,
    monitor_level: Fraction = 0.99,
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
        drives: number of independent drives that the trajectories of "calibration" and
            "test" were cut from; by default every trajectory is one. Guarantees are
            about new drives only if there are enough of them.
        sensor_noise: standard deviation per state for the bounds of the run-time
            monitor; further entries are not used.
        mode: as in `certify`.
        horizon: of the tubes [steps].
        level: 1 − δ of the conformal bounds.
        margin: as in `certify`.
        attack_starts: as in `certify`.
        monitor_level: share of calibration trajectories without a false alarm.

    Raises:
        CertificationRefused: the model cannot be certified; gives the reason.
    """
    began = time.perf_counter()
    certificate = certify(
        model,
        params,
        boxes["env"],
        mode=mode,
        margin=margin,
        attack_starts=attack_starts,
    )
    folded = jax.jit(partial(fold, model))(params)
    splits = validation, calibration
    try:
        measured = _measure(model, folded, splits, held_out, level, drives or {})
        outputs = _outputs(model, params, folded, (*splits, held_out["test"]), level)
        monitor = _monitor_bounds(model, folded, splits, sensor_noise, monitor_level)
    except ValueError as reason:
        raise CertificationRefused(str(reason)) from None
    one_step = measured["one_step"]
    rest = {
        "decoder_lipschitz": certificate.lipschitz.get("decoder"),
        "d_bar": {"value": one_step["latent"], **measured},
        "tube": _tubes(model, certificate, one_step, calibration, horizon),
        "outputs": outputs,
        "boxes": dict(boxes),
        "monitor": monitor,
        "seconds_proof": certificate.seconds,
        "seconds": time.perf_counter() - began,
    }
    return {"valid": True} | certificate.document() | rest


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
    except CertificationRefused:
        return {}
    if not isinstance(weights.operators, Polytope):
        return {}
    with one_thread():
        rho = max(
            float(np.linalg.norm(vertex, 2)) for vertex in weights.operators.vertices
        )
        separate = rho + residual_bound(weights)
        joint = joint_bound(weights, iterations=15)
        slopes = max(
            attack_slopes(weights.residual, vertex, starts=4)
            for vertex in weights.operators.vertices
        )
    values = {
        "alpha": min(joint, separate),
        "alpha_separate": separate,
        "tightness": min(joint, separate) / slopes,
    }
    return {name: value for name, value in values.items() if np.isfinite(value)}


def _tubes(
    model: Model,
    certificate: Certificate,
    one_step: Mapping[str, float],
    calibration: Trajectory,
    horizon: int,
) -> dict[str, Any]:
    """Tubes up to the horizon and their limit, from α, L and the one-step bounds."""
    latent = latent_tube(certificate.alpha, one_step["latent"], horizon)
    ultimate = one_step["latent"] / (1 - certificate.alpha)
    constants = {
        "alpha": certificate.alpha,
        "lipschitz": certificate.lipschitz,
        "residual": one_step,
    }
    if model.along_path:
        physical, largest = path_tube(latent, **constants), None
        limit = ultimate_tube(ultimate, **constants)
    else:
        positions = np.asarray(calibration.states, dtype=np.float64)[..., :2]
        largest = float(np.max(np.linalg.norm(np.diff(positions, axis=-2), axis=-1)))
        physical = physical_tube(latent, **constants, largest_increment=largest)
        limit = None
    return {
        "latent": latent.tolist(),
        "physical": physical,
        "ultimate": ultimate,
        "for_ever": limit,
        "largest_increment_m": largest,
    }


def _measure(
    model: Model,
    params: Params,
    splits: tuple[Trajectory, Trajectory],
    held_out: Mapping[str, Trajectory],
    level: float,
    drives: Mapping[str, int],
) -> dict[str, Any]:
    """One-step bounds at `level` for whole trajectories, and their coverage."""
    reference, scores = (disturbances(model, params, part) for part in splits)
    bounds = conformal_bounds(tube_units(reference, level=level), scores, level=level)
    shares = {
        name: _coverage(bounds, disturbances(model, params, part), drives.get(name))
        for name, part in held_out.items()
    }
    independent = drives.get("calibration", len(scores.scores))
    same = f"further segments of the same {independent} drives"
    return {
        "level": level,
        "trajectories": len(scores.scores),
        "drives": independent,
        "holds_for": "new drives like these" if supports(independent, level) else same,
        **shares["test"],
        "by_scenario": {
            name: share for name, share in shares.items() if name != "test"
        },
        "one_step": dict(zip(KINDS, bounds.tolist(), strict=True)),
        "validation": float(np.quantile(reference.scores[:, 0], level)),
    }


def _outputs(
    model: Model,
    params: Params,
    folded: Params,
    splits: tuple[Trajectory, ...],
    level: float,
) -> dict[str, Any]:
    """Tubes of single outputs in their own metrics, for a model along a path."""
    if not model.along_path:
        return {}
    data = dict(zip(("validation", "calibration", "test"), splits, strict=True))
    return output_tubes(model, folded, exported(model, params), level=level, **data)


def _coverage(bounds: Any, measured: Disturbance, drives: int | None) -> dict[str, Any]:
    """Share of trajectories within all bounds, and its interval."""
    count = len(measured.scores)
    share, independent = coverage(bounds, measured), drives or count
    sizes = {"coverage_trajectories": count, "coverage_drives": independent}
    return {
        "coverage": share,
        "coverage_ci95": coverage_interval(share, independent),
        **sizes,
    }


def _monitor_bounds(
    model: Model,
    params: Params,
    splits: tuple[Trajectory, Trajectory],
    sensor_noise: tuple[float, ...],
    level: float,
) -> dict[str, Any]:
    """One-step bounds for the monitor, which sees both states through the sensors."""
    size = splits[0].states.shape[-1]
    noise = jnp.asarray(sensor_noise[:size])
    spread = jnp.zeros(size).at[: min(size, len(sensor_noise))].set(noise)

    def observed(key: Key, part: Trajectory) -> Trajectory:
        draws = jax.random.normal(key, part.states.shape)
        return part._replace(states=part.states + spread * draws)

    keys = jax.random.split(jax.random.key(0))
    noisy = [observed(key, part) for key, part in zip(keys, splits, strict=True)]
    reference, scores = (disturbances(model, params, part) for part in noisy)
    bounds = conformal_bounds(monitor_units(reference), scores, level=level)
    return {
        "bounds": bounds.tolist(),
        "level": level,
        "sensor_noise": list(sensor_noise),
    }
