"""The search for claims: the smallest constants for which a witness passes the core."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sfkd_jax.certification._claims import (
    SERVED,
    Claims,
    Refuted,
    decoders,
    hull,
    joint_cover,
    operator_norms,
    readouts,
)
from sfkd_jax.certification._core import Matrix, Vector, check_metric, norm_upper
from sfkd_jax.certification._environments import Box, operator_at
from sfkd_jax.certification._exported import Exported
from sfkd_jax.certification._proposals import propose_multipliers, rescaled
from sfkd_jax.types import Hypernetwork, Polytope


def prove(
    weights: Exported, box: Box, *, joint: bool, metric: Matrix | None = None
) -> Claims:
    """Search for the smallest constants that the core accepts.

    Args:
        weights: explicit, float64, finite.
        box: of E.
        joint: also bound the whole step as one map.
        metric: P as proposed, or None for I.

    Raises:
        Refuted: there is no finite bound.
    """
    residual = _best_multipliers(weights.residual, weights.residual_multipliers)
    beta = SERVED * residual[0]
    if not np.isfinite(beta):
        raise Refuted("no multipliers prove a Lipschitz bound of the residual")
    witnesses: dict[str, Any] = {"residual": residual[1], "metric": None, "joint": None}
    if metric is None:
        (rho, scope), kappa = operator_norms(weights, box), 1.0
    else:
        rho, kappa = _metric_constants(weights, np.asarray(metric, dtype=np.float64))
        scope, witnesses["metric"] = hull(weights), metric
    alpha_separate = rho + beta * kappa**0.5
    alpha_joint = None
    if joint:
        alpha_joint, witnesses["joint"] = _joint(weights, box, residual[1])
    lipschitz = {
        name: SERVED * norm_upper(rows) for name, rows in readouts(weights).items()
    }
    for name, network in decoders(weights).items():
        bound, witnesses[name] = _best_multipliers(network, weights.decoder_multipliers)
        lipschitz[name] = SERVED * bound
    if not np.all(np.isfinite(list(lipschitz.values()))):
        raise Refuted("no multipliers prove a Lipschitz bound of the decoder")
    alpha = alpha_separate if alpha_joint is None else min(alpha_separate, alpha_joint)
    plain = {name: _listed(value) for name, value in witnesses.items()}
    return Claims(
        scope, alpha, alpha_separate, alpha_joint, rho, beta, kappa, lipschitz, plain
    )


def residual_bound(weights: Exported) -> float:
    """β alone, with the multipliers that the model carries."""
    return (
        rescaled(weights.residual, weights.residual_multipliers)[0]
        if weights.residual
        else 0.0
    )


def joint_bound(weights: Exported, *, iterations: int) -> float:
    """The joint α of a polytope with a short search."""
    return _vertices(weights, weights.residual_multipliers, iterations=iterations)[0]


def _best_multipliers(
    weights: Sequence[Matrix], start: Sequence[Vector]
) -> tuple[float, list[Vector]]:
    """The better of what the model carries and what L-BFGS finds from there."""
    if len(weights) < 2 or not np.any(weights[-1]):
        return (norm_upper(weights[-1]) if weights else 0.0), []
    given = rescaled(weights, start) if start else (float("inf"), [])
    found = rescaled(weights, propose_multipliers(weights, start))
    return min(given, found, key=lambda pair: pair[0])


def _joint(
    weights: Exported, box: Box, start: Sequence[Vector]
) -> tuple[float, list[Sequence[Vector]]]:
    """α of the step as one map and its multipliers: a set for each vertex, or one set for the whole box."""
    if isinstance(weights.operators, Hypernetwork):
        middle = operator_at(
            weights.operators, 0.5 * (np.asarray(box[0]) + np.asarray(box[1]))
        )
        multipliers = propose_multipliers(weights.residual, start, middle)
        return SERVED * joint_cover(weights, box, multipliers).upper, [multipliers]
    return _vertices(weights, start, iterations=150)


def _vertices(
    weights: Exported, start: Sequence[Vector], *, iterations: int
) -> tuple[float, list[Sequence[Vector]]]:
    """The largest joint bound over the vertices, each search beginning where the last one ended."""
    bounds, witnesses = [], []
    for vertex in weights.operators[0]:
        start = propose_multipliers(
            weights.residual, start, vertex, iterations=iterations
        )
        bound, start = rescaled(weights.residual, start, vertex)
        bounds.append(bound)
        witnesses.append(start)
    return SERVED * max(bounds), witnesses


def _metric_constants(weights: Exported, metric: Matrix) -> tuple[float, float]:
    """ρ_P and κ, recomputed from P and widened until the core agrees."""
    if (
        not isinstance(weights.operators, Polytope)
        or weights.declared.transport != "identity"
    ):
        raise Refuted(
            "a metric needs a polytope of operators and no transport: T is nonexpansive in the 2-norm only"
        )
    if metric.shape != weights.operators.vertices.shape[1:] or not np.all(
        np.isfinite(metric)
    ):
        raise Refuted("the metric is not a finite matrix of the latent's size")
    values, vectors = np.linalg.eigh(0.5 * (metric + metric.T))
    if not values[0] > 0:
        raise Refuted("the metric is not positive definite")
    root = vectors * np.sqrt(values)
    rates = [
        np.linalg.norm(np.linalg.solve(root, vertex.T @ root), 2)
        for vertex in weights.operators.vertices
    ]
    for slack in (1e-9, 1e-7, 1e-5, 1e-3):
        rate, condition = (
            float(max(rates)) * (1 + slack),
            float(values[-1] / values[0]) * (1 + slack),
        )
        if check_metric(metric, list(weights.operators.vertices), rate, condition):
            return SERVED * rate, condition
    raise Refuted("the metric is not a common Lyapunov matrix of the operators")


def _listed(witness: Any) -> Any:
    """A witness as nested lists of floats, for JSON."""
    if isinstance(witness, (list, tuple)):
        return [_listed(part) for part in witness]
    return (
        witness if witness is None else np.asarray(witness, dtype=np.float64).tolist()
    )
