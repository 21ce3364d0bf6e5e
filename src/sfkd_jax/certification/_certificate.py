"""The first certificate: α recomputed from the exported weights, tubes from measured disturbances, or a refusal."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from sfkd_jax.certification._calibration import KINDS, conformal_bounds, coverage, disturbances
from sfkd_jax.certification._core import norm_upper
from sfkd_jax.certification._lipschitz import lipschitz_upper
from sfkd_jax.certification._tube import latent_tube, physical_tube
from sfkd_jax.types import Model, Params, Trajectory

SERVED = 1.0 + 1e-6
"""The controller's own compilation may round the same weights differently, by 1.5e-7 at most where it was measured."""


class CertificationRefused(Exception):
    """No certificate; the message is the reason."""


def contraction(model: Model, params: Params) -> dict[str, float]:
    """ρ, β, α = ρ + β and the decoder's constants, proved for all e, u, z from the float32 weights taken as exact.

    ρ holds for every e because A(e) is a convex combination of the vertices; β because u and e are biases.

    Raises:
        CertificationRefused: no explicit weights, weights not finite, a residual without a witness, α ≥ 1.
    """
    if model.explicit is None:
        raise CertificationRefused("this model exposes no explicit weights to certify")
    weights = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), jax.jit(model.explicit)(params))
    if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(weights)):
        raise CertificationRefused("the weights are not finite")
    rho = SERVED * max(norm_upper(vertex) for vertex in weights.vertices)
    beta = SERVED * lipschitz_upper(weights.residual, weights.residual_multipliers) if weights.residual else 0.0
    if not np.isfinite(beta):
        raise CertificationRefused("the residual carries no multipliers that prove a Lipschitz bound")
    alpha = rho + beta
    if alpha >= 1.0:
        raise CertificationRefused(f"alpha = {alpha:.6f} is not below 1 (rho {rho:.6f}, beta {beta:.6f})")
    parts = {"position": weights.decoder[-1][:2], "yaw": weights.decoder[-1][2:], "decoder": weights.decoder[-1]}
    bounds = {}
    for name, rows in parts.items():
        unit = float(np.linalg.norm(rows, 2))
        if unit == 0.0:
            bounds[name] = 0.0
            continue
        scaled = (*weights.decoder[:-1], rows / unit)
        shrunk = [part / np.max(part) for part in weights.decoder_multipliers]
        bounds[name] = unit * _widened(scaled, shrunk)
    return {"rho": rho, "beta": beta, "alpha": alpha, "body": norm_upper(weights.readout)} | bounds


def _widened(weights: tuple[np.ndarray, ...], multipliers: list[np.ndarray]) -> float:
    """A Lipschitz bound over a wide range of overall multiplier scales."""
    scales = np.geomspace(1e-3, 1e6, 28)
    return min(lipschitz_upper(weights, [scale * part for part in multipliers]) for scale in scales)


def measure(
    model: Model, params: Params, splits: tuple[Trajectory, Trajectory, Trajectory], *, level: float
) -> dict[str, Any]:
    """One-step bounds at `level` for whole trajectories, and how often they hold on trajectories nobody used.

    Args:
        model, params: what predicts. splits: validation fixes units, calibration sets the bounds, the last tests them.
        level: 1 − δ.

    Raises:
        CertificationRefused: too few trajectories, or residuals that are not finite.
    """
    validation, calibration, held_out = (disturbances(model, params, part) for part in splits)
    try:
        bounds, _ = conformal_bounds(validation, calibration, level=level)
    except ValueError as reason:
        raise CertificationRefused(str(reason)) from None
    share, interval = coverage(bounds, held_out)
    return {
        "level": level,
        "trajectories": len(calibration.scores),
        "coverage": share,
        "coverage_ci95": list(interval),
        "one_step": dict(zip(KINDS, bounds.tolist(), strict=True)),
    }


def certify(
    model: Model,
    params: Params,
    *,
    validation: Trajectory,
    calibration: Trajectory,
    held_out: Trajectory,
    boxes: Mapping[str, Any],
    horizon: int = 20,
    level: float = 0.95,
    separate_margin: float = 1e-4,
) -> dict[str, Any]:
    """A certificate as a document: what is proved (α, constants) and, apart from it, what is measured (d̄, coverage).

    Args:
        model, params: what is certified, with the weights as exported.
        validation: fixes the units of the scores. calibration: sets d̄. held_out: measures coverage. All by trajectory.
        boxes: the domain of s, u and e that the measurements come from; outside it nothing is claimed.
        horizon: of the tubes. level: 1 − δ of the conformal bound.
        separate_margin: how far below 1 α must lie.

    Raises:
        CertificationRefused: with the reason.
    """
    began = time.perf_counter()
    proved = contraction(model, params)
    alpha = proved["alpha"]
    if alpha > 1.0 - separate_margin:
        raise CertificationRefused(f"alpha = {alpha:.6f} leaves less than the margin {separate_margin} below 1")
    found = measure(model, params, (validation, calibration, held_out), level=level)
    one_step = found["one_step"]
    latent = latent_tube(alpha, one_step["latent"], horizon)
    positions = np.asarray(calibration.states)[..., :2]
    tube = physical_tube(
        latent,
        lipschitz={kind: proved[kind] for kind in ("position", "yaw", "body")},
        residual=one_step,
        largest_increment=float(np.max(np.linalg.norm(np.diff(positions, axis=-2), axis=-1))),
    )
    return {
        "valid": True,
        "mode": "separate",
        "scope": "all e in the environment box, all u, all z",
        "alpha": alpha,
        "alpha_separate": alpha,
        "rho": proved["rho"],
        "beta": proved["beta"],
        "kappa": 1.0,
        "decoder_lipschitz": proved["decoder"],
        "transport_lipschitz": 1.0,
        "d_bar": {"value": one_step["latent"], **found},
        "tube": {
            "latent": latent.tolist(),
            "physical": tube,
            "ultimate": one_step["latent"] / (1.0 - alpha),
        },
        "boxes": dict(boxes),
        "attack": None,
        "tightness": None,
        "seconds": time.perf_counter() - began,
    }
