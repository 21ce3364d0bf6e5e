"""A certificate as the document that lies beside the weights: what is proved, and apart from it what is measured."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sfkd_jax.certification._attack import attack_slopes
from sfkd_jax.certification._calibration import (
    KINDS,
    Disturbance,
    conformal_bounds,
    coverage,
    disturbances,
    even_units,
    interval,
    supports,
    tube_units,
)
from sfkd_jax.certification._certificate import certify
from sfkd_jax.certification._exported import CertificationRefused, exported, one_thread
from sfkd_jax.certification._output_tubes import output_tubes
from sfkd_jax.certification._proofs import joint_bound, residual_bound
from sfkd_jax.certification._tube import for_ever, latent_tube, path_tube, physical_tube
from sfkd_jax.types import Model, Params, Polytope, Trajectory


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
    level: float = 0.95,
    margin: float = 1e-4,
    attack_starts: int = 6,
    monitor_level: float = 0.99,
) -> dict[str, Any]:
    """A certificate with its tubes, as a document.

    Args:
        model, params: what is certified, with the weights as exported.
        validation: fixes the units of the scores.
        calibration: sets d̄. Both by trajectory.
        held_out: batches of trajectories by name, to count coverage on; "test" is
            exchangeable with `calibration`.
        boxes: the domain of s, u and e that the measurements come from; outside it
            nothing is claimed.
        drives: how many independent drives the trajectories of "calibration" and "test"
            were cut from; where it is not said, every trajectory is one. Guarantees are
            about new drives only if there are enough of them.
        sensor_noise: standard deviation per state, for the bounds of the run-time
            monitor; entries beyond the state are not used.
        mode, margin, attack_starts: of `certify`.
        horizon: of the tubes.
        level: 1 − δ of the conformal bound.
        monitor_level: the share of calibration trajectories without a false alarm.

    Raises:
        CertificationRefused: with the reason.
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
    driving = jax.jit(model.fold)(params)
    try:
        found = _measure(
            model, driving, validation, calibration, held_out, level, drives or {}
        )
        outputs = _outputs(
            model, params, driving, (validation, calibration, held_out["test"]), level
        )
        alarms = _alarms(
            model, driving, (validation, calibration), sensor_noise, monitor_level
        )
    except ValueError as reason:
        raise CertificationRefused(str(reason)) from None
    one_step = found["one_step"]
    latent = latent_tube(certificate.alpha, one_step["latent"], horizon)
    positions = np.asarray(calibration.states, dtype=np.float64)[..., :2]
    largest = float(np.max(np.linalg.norm(np.diff(positions, axis=-2), axis=-1)))
    known = {
        "alpha": certificate.alpha,
        "lipschitz": certificate.lipschitz,
        "residual": one_step,
    }
    ultimate = one_step["latent"] / (1 - certificate.alpha)
    along_path = model.along_path
    tube = (
        path_tube(latent, **known)
        if along_path
        else physical_tube(latent, **known, largest_increment=largest)
    )
    measured = {
        "decoder_lipschitz": certificate.lipschitz.get("decoder"),
        "d_bar": {"value": one_step["latent"], **found},
        "tube": {
            "latent": latent.tolist(),
            "physical": tube,
            "ultimate": ultimate,
            "for_ever": for_ever(ultimate, **known) if along_path else None,
            "largest_increment_m": None if along_path else largest,
        },
        "outputs": outputs,
        "boxes": dict(boxes),
        "monitor": alarms,
        "seconds_proof": certificate.seconds,
        "seconds": time.perf_counter() - began,
    }
    return {"valid": True} | certificate.document() | measured


def progress(model: Model, params: Params) -> dict[str, float]:
    """α, joint and separate, and α over the largest factor found by flipping slopes; {} where nothing is provable.

    For the log of a training run: quick, and no certificate.
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
    found = {
        "alpha": min(joint, separate),
        "alpha_separate": separate,
        "tightness": min(joint, separate) / slopes,
    }
    return {name: value for name, value in found.items() if np.isfinite(value)}


def _measure(
    model: Model,
    params: Params,
    validation: Trajectory,
    calibration: Trajectory,
    held_out: Mapping[str, Trajectory],
    level: float,
    drives: Mapping[str, int],
) -> dict[str, Any]:
    """One-step bounds at `level` for whole trajectories, and how often they hold where nobody looked before."""
    reference, scores = (
        disturbances(model, params, part) for part in (validation, calibration)
    )
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
    driving: Params,
    splits: tuple[Trajectory, ...],
    level: float,
) -> dict[str, Any]:
    """Tubes in metrics of their own; only along a path is the pose an output."""
    if not model.along_path:
        return {}
    validation, calibration, test = splits
    known = {"validation": validation, "calibration": calibration, "test": test}
    return output_tubes(model, driving, exported(model, params), level=level, **known)


def _coverage(bounds: Any, found: Disturbance, drives: int | None) -> dict[str, Any]:
    """Share of trajectories inside all bounds, with the interval that so many independent drives give it."""
    count = len(found.scores)
    share, independent = coverage(bounds, found), drives or count
    sizes = {"coverage_trajectories": count, "coverage_drives": independent}
    return {"coverage": share, "coverage_ci95": interval(share, independent), **sizes}


def _alarms(
    model: Model,
    params: Params,
    splits: tuple[Trajectory, Trajectory],
    sensor_noise: tuple[float, ...],
    level: float,
) -> dict[str, Any]:
    """One-step bounds as a monitor needs them: both states of a pair are seen through the sensors."""
    size = splits[0].states.shape[-1]
    spread = (
        jnp.zeros(size)
        .at[: min(size, len(sensor_noise))]
        .set(jnp.asarray(sensor_noise[:size]))
    )
    noisy = [
        part._replace(
            states=part.states + spread * jax.random.normal(key, part.states.shape)
        )
        for key, part in zip(jax.random.split(jax.random.key(0)), splits, strict=True)
    ]
    reference, scores = (disturbances(model, params, part) for part in noisy)
    bounds = conformal_bounds(even_units(reference), scores, level=level)
    return {
        "bounds": bounds.tolist(),
        "level": level,
        "sensor_noise": list(sensor_noise),
    }
