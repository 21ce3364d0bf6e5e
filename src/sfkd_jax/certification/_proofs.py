"""Search for the smallest constants with a witness that the trusted core accepts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sfkd_jax.certification._claims import (
    COMPILATION_SLACK,
    Claims,
    Refuted,
    decoders,
    hull_scope,
    joint_bound_over_box,
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
        box: lower and upper corner of E.
        joint: also bound the whole step as one map.
        metric: a proposed P, or None for I.

    Raises:
        Refuted: no finite bound was found.
    """
    bound, start = _best_multipliers(weights.residual, weights.residual_multipliers)
    beta = COMPILATION_SLACK * bound
    if not np.isfinite(beta):
        raise Refuted("no multipliers prove a Lipschitz bound of the residual")
    witnesses: dict[str, Any] = {"residual": start, "metric": None, "joint": None}
    if metric is None:
        (rho, scope), kappa = operator_norms(weights, box), 1.0
    else:
        rho, kappa = _metric_constants(weights, np.asarray(metric, dtype=np.float64))
        scope, witnesses["metric"] = hull_scope(weights), metric
    alpha_separate = rho + beta * kappa**0.5
    alpha_joint = None
    if joint:
        alpha_joint, witnesses["joint"] = _joint(weights, box, start)
    lipschitz = {
        name: COMPILATION_SLACK * norm_upper(rows)
        for name, rows in readouts(weights).items()
    }
    for name, network in decoders(weights).items():
        bound, witnesses[name] = _best_multipliers(network, weights.decoder_multipliers)
        lipschitz[name] = COMPILATION_SLACK * bound
    if not np.all(np.isfinite(list(lipschitz.values()))):
        raise Refuted("no multipliers prove a Lipschitz bound of the decoder")
    alpha = alpha_separate if alpha_joint is None else min(alpha_separate, alpha_joint)
    plain = {name: _listed(value) for name, value in witnesses.items()}
    return Claims(
        scope, alpha, alpha_separate, alpha_joint, rho, beta, kappa, lipschitz, plain
    )


def residual_bound(weights: Exported) -> float:
    """Return β with the multipliers of the model, without a search."""
    if not weights.residual:
        return 0.0
    return rescaled(weights.residual, weights.residual_multipliers)[0]


def joint_bound(weights: Exported, *, iterations: int) -> float:
    """Return the joint α of a polytope after a short search."""
    return _vertices(weights, weights.residual_multipliers, iterations=iterations)[0]


def _best_multipliers(
    weights: Sequence[Matrix], start: Sequence[Vector]
) -> tuple[float, list[Vector]]:
    """Return the better bound of the model's multipliers and those from L-BFGS."""
    if len(weights) < 2 or not np.any(weights[-1]):
        return (norm_upper(weights[-1]) if weights else 0.0), []
    given = rescaled(weights, start) if start else (float("inf"), [])
    proposed = rescaled(weights, propose_multipliers(weights, start))
    return min(given, proposed, key=lambda pair: pair[0])


def _joint(
    weights: Exported, box: Box, start: Sequence[Vector]
) -> tuple[float, list[Sequence[Vector]]]:
    """Return the joint α and its multipliers, for each vertex or for the whole box."""
    if isinstance(weights.operators, Hypernetwork):
        low, high = (np.asarray(corner) for corner in box)
        middle = operator_at(weights.operators, 0.5 * (low + high))
        multipliers = propose_multipliers(weights.residual, start, middle)
        bound = joint_bound_over_box(weights, box, multipliers).upper
        return COMPILATION_SLACK * bound, [multipliers]
    return _vertices(weights, start, iterations=150)


def _vertices(
    weights: Exported, start: Sequence[Vector], *, iterations: int
) -> tuple[float, list[Sequence[Vector]]]:
    """Return the largest joint bound of the vertices, searched one after another."""
    bounds, witnesses = [], []
    for vertex in weights.operators[0]:
        start = propose_multipliers(
            weights.residual, start, vertex, iterations=iterations
        )
        bound, start = rescaled(weights.residual, start, vertex)
        bounds.append(bound)
        witnesses.append(start)
    return COMPILATION_SLACK * max(bounds), witnesses


def _metric_constants(weights: Exported, metric: Matrix) -> tuple[float, float]:
    """Return ρ_P and κ, recomputed from P and increased until the core accepts them."""
    polytope = isinstance(weights.operators, Polytope)
    if not polytope or weights.declared.transport != "identity":
        raise Refuted(
            "a metric needs a polytope of operators and no transport: "
            "T is nonexpansive in the 2-norm only"
        )
    vertices = weights.operators.vertices
    if metric.shape != vertices.shape[1:] or not np.all(np.isfinite(metric)):
        raise Refuted("the metric is not a finite matrix of the latent's size")
    values, vectors = np.linalg.eigh(0.5 * (metric + metric.T))
    if not values[0] > 0:
        raise Refuted("the metric is not positive definite")
    root = vectors * np.sqrt(values)
    rates = [
        np.linalg.norm(np.linalg.solve(root, vertex.T @ root), 2) for vertex in vertices
    ]
    for slack in (1e-9, 1e-7, 1e-5, 1e-3):
        rate = float(max(rates)) * (1 + slack)
        condition = float(values[-1] / values[0]) * (1 + slack)
        if check_metric(metric, list(vertices), rate, condition):
            return COMPILATION_SLACK * rate, condition
    raise Refuted("the metric is not a common Lyapunov matrix of the operators")


def _listed(witness: Any) -> Any:
    """Return a witness as nested lists of floats for JSON."""
    if isinstance(witness, (list, tuple)):
        return [_listed(part) for part in witness]
    if witness is None:
        return None
    return np.asarray(witness, dtype=np.float64).tolist()
