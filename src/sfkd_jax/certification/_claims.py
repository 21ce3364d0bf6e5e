"""Every claim of a certificate with its witness: how it is found, and how it is checked again without a search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sfkd_jax.certification._core import Matrix, Vector, check_metric, check_witness, norm_upper
from sfkd_jax.certification._environments import Box, Cover, cover, operator_at
from sfkd_jax.certification._exported import Exported
from sfkd_jax.certification._proposals import propose_multipliers, proved, rescaled
from sfkd_jax.types import Hypernetwork, Polytope

SERVED = 1.0 + 1e-6
"""The controller's own compilation may round the same weights differently, by 1.5e-7 at most where it was measured."""


class Refuted(Exception):
    """A claim that cannot be proved; the message names it."""


class Claims(NamedTuple):
    """The proved part of a certificate; names as in `Certificate`."""

    scope: str
    alpha: float
    alpha_separate: float
    alpha_joint: float | None
    rho: float
    beta: float
    kappa: float
    lipschitz: dict[str, float]
    witnesses: dict[str, Any]


def prove(weights: Exported, box: Box, *, joint: bool, metric: Matrix | None = None) -> Claims:
    """Search for the smallest constants that the core accepts.

    Args:
        weights: explicit, float64, finite. box: of E. joint: also bound the whole step as one map.
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
        (rho, scope), kappa = _norms(weights, box), 1.0
    else:
        rho, kappa = _metric_constants(weights, np.asarray(metric, dtype=np.float64))
        scope, witnesses["metric"] = _hull(weights), metric
    alpha_separate = rho + beta * kappa**0.5
    alpha_joint = None
    if joint:
        alpha_joint, witnesses["joint"] = _joint(weights, box, residual[1])
    lipschitz = {"body": SERVED * norm_upper(weights.readout)}
    for name, network in _decoders(weights).items():
        bound, witnesses[name] = _best_multipliers(network, weights.decoder_multipliers)
        lipschitz[name] = SERVED * bound
    if not np.all(np.isfinite(list(lipschitz.values()))):
        raise Refuted("no multipliers prove a Lipschitz bound of the decoder")
    alpha = alpha_separate if alpha_joint is None else min(alpha_separate, alpha_joint)
    plain = {name: _listed(value) for name, value in witnesses.items()}
    return Claims(scope, alpha, alpha_separate, alpha_joint, rho, beta, kappa, lipschitz, plain)


def claims_hold(claims: Claims, weights: Exported, box: Box) -> None:
    """Check every claim from its witness.

    Raises:
        Refuted: naming the first that does not follow.
    """
    seen = {name: _arrays(value) for name, value in claims.witnesses.items()}
    metric, operators = seen["metric"], weights.operators
    checks = {"beta": _bounded(weights.residual, seen["residual"], claims.beta)}
    if isinstance(operators, Hypernetwork):
        rho, scope = _norms(weights, box)
        checks["rho"] = rho <= claims.rho
        joint = claims.alpha_joint is None or _joint_cover(weights, box, seen["joint"][0]).upper <= claims.alpha_joint
    elif metric is None:
        scope = _hull(weights)
        checks["rho"] = all(check_witness((), (), claims.rho, vertex) for vertex in operators.vertices)
        joint = claims.alpha_joint is None or all(
            check_witness(weights.residual, part, claims.alpha_joint, vertex)
            for part, vertex in zip(seen["joint"], operators.vertices, strict=True)
        )
    else:
        scope = _hull(weights)
        checks["rho"] = check_metric(np.asarray(metric), list(operators.vertices), claims.rho, claims.kappa)
        joint = claims.alpha_joint is None and weights.declared.transport == "identity"
    checks["scope"] = claims.scope == scope
    checks["kappa"] = claims.kappa == 1.0 if metric is None else claims.kappa >= 1.0
    checks["alpha_joint"] = joint
    checks["alpha_separate"] = claims.alpha_separate == claims.rho + claims.beta * claims.kappa**0.5
    known = [claims.alpha_separate] + ([] if claims.alpha_joint is None else [claims.alpha_joint])
    checks["alpha"] = claims.alpha == min(known)
    checks["body"] = check_witness((), (), claims.lipschitz["body"], weights.readout)
    for name, network in _decoders(weights).items():
        checks[name] = _bounded(network, seen[name], claims.lipschitz[name])
    for name, holds in checks.items():
        if not holds:
            raise Refuted(f"{name} does not follow from its witness")


def residual_bound(weights: Exported) -> float:
    """β alone, with the multipliers that the model carries."""
    return rescaled(weights.residual, weights.residual_multipliers)[0] if weights.residual else 0.0


def joint_bound(weights: Exported, *, iterations: int) -> float:
    """The joint α of a polytope with a short search."""
    return _vertices(weights, weights.residual_multipliers, iterations=iterations)[0]


def _best_multipliers(weights: Sequence[Matrix], start: Sequence[Vector]) -> tuple[float, list[Vector]]:
    """The better of what the model carries and what L-BFGS finds from there."""
    if len(weights) < 2 or not np.any(weights[-1]):
        return (norm_upper(weights[-1]) if weights else 0.0), []
    given = rescaled(weights, start) if start else (float("inf"), [])
    found = rescaled(weights, propose_multipliers(weights, start))
    return min(given, found, key=lambda pair: pair[0])


def _bounded(weights: Sequence[Matrix], multipliers: Sequence[Vector], bound: float) -> bool:
    """Whether a network, if there is one and it emits anything but a constant, respects a bound."""
    return not weights or not np.any(weights[-1]) or check_witness(weights, multipliers, bound)


def _norms(weights: Exported, box: Box) -> tuple[float, str]:
    """ρ in the 2-norm for all environments, and what "all" rests on."""
    if isinstance(weights.operators, Hypernetwork):
        found = cover(weights.operators, box, norm_upper)
        return SERVED * found.upper, f"all e in the box, branch and bound over {found.cells} cells; all u, all z"
    return SERVED * max(norm_upper(vertex) for vertex in weights.operators.vertices), _hull(weights)


def _joint(weights: Exported, box: Box, start: Sequence[Vector]) -> tuple[float, list[Sequence[Vector]]]:
    """α of the step as one map and its multipliers: a set for each vertex, or one set for the whole box."""
    if isinstance(weights.operators, Hypernetwork):
        middle = operator_at(weights.operators, 0.5 * (np.asarray(box[0]) + np.asarray(box[1])))
        multipliers = propose_multipliers(weights.residual, start, middle)
        return SERVED * _joint_cover(weights, box, multipliers).upper, [multipliers]
    return _vertices(weights, start, iterations=150)


def _vertices(weights: Exported, start: Sequence[Vector], *, iterations: int) -> tuple[float, list[Sequence[Vector]]]:
    """The largest joint bound over the vertices, each search beginning where the last one ended."""
    bounds, witnesses = [], []
    for vertex in weights.operators[0]:
        start = propose_multipliers(weights.residual, start, vertex, iterations=iterations)
        bound, start = rescaled(weights.residual, start, vertex)
        bounds.append(bound)
        witnesses.append(start)
    return SERVED * max(bounds), witnesses


def _joint_cover(weights: Exported, box: Box, multipliers: Sequence[Vector]) -> Cover:
    """The joint bound over the box; as a function of A it moves no faster than ||A||_2."""
    assert isinstance(weights.operators, Hypernetwork)
    if not weights.residual:
        return cover(weights.operators, box, norm_upper)
    return cover(weights.operators, box, lambda operator: proved(weights.residual, multipliers, operator))


def _metric_constants(weights: Exported, metric: Matrix) -> tuple[float, float]:
    """ρ_P and κ, recomputed from P and widened until the core agrees."""
    if not isinstance(weights.operators, Polytope) or weights.declared.transport != "identity":
        raise Refuted("a metric needs a polytope of operators and no transport: T is nonexpansive in the 2-norm only")
    if metric.shape != weights.operators.vertices.shape[1:] or not np.all(np.isfinite(metric)):
        raise Refuted("the metric is not a finite matrix of the latent's size")
    values, vectors = np.linalg.eigh(0.5 * (metric + metric.T))
    if not values[0] > 0:
        raise Refuted("the metric is not positive definite")
    root = vectors * np.sqrt(values)
    rates = [np.linalg.norm(np.linalg.solve(root, vertex.T @ root), 2) for vertex in weights.operators.vertices]
    for slack in (1e-9, 1e-7, 1e-5, 1e-3):
        rate, condition = float(max(rates)) * (1 + slack), float(values[-1] / values[0]) * (1 + slack)
        if check_metric(metric, list(weights.operators.vertices), rate, condition):
            return SERVED * rate, condition
    raise Refuted("the metric is not a common Lyapunov matrix of the operators")


def _hull(weights: Exported) -> str:
    """What "all environments" rests on for a polytope."""
    return f"all e: A(e) lies in the hull of {len(weights.operators[0])} vertices; all u, all z"


def _decoders(weights: Exported) -> dict[str, list[Matrix]]:
    """The decoder's networks by name: position [m], yaw [rad], and both together."""
    if not weights.decoder:
        return {}
    *hidden, last = weights.decoder
    return {"position": [*hidden, last[:2]], "yaw": [*hidden, last[2:]], "decoder": [*hidden, last]}


def _listed(witness: Any) -> Any:
    """A witness as nested lists of floats, for JSON."""
    if isinstance(witness, (list, tuple)):
        return [_listed(part) for part in witness]
    return witness if witness is None else np.asarray(witness, dtype=np.float64).tolist()


def _arrays(witness: Any) -> Any:
    """Nested lists of floats as lists of vectors; a metric as a matrix; None as None."""
    if witness and isinstance(witness[0], list) and (not witness[0] or isinstance(witness[0][0], list)):
        return [_arrays(part) for part in witness]
    return witness if witness is None else [np.asarray(part, dtype=np.float64) for part in witness]
