"""The claims of a certificate, each checked from its witness without a search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sfkd_jax.certification._core import (
    Matrix,
    Vector,
    check_metric,
    check_witness,
    norm_upper,
)
from sfkd_jax.certification._environments import Box, BoxBound, bound_over_box
from sfkd_jax.certification._exported import Exported
from sfkd_jax.certification._proposals import smallest_bound
from sfkd_jax.types import Hypernetwork

COMPILATION_SLACK = 1.0 + 1e-6
"""Slack for rounding: another compilation of the same model may serve explicit weights
that differ relatively by about 1.5e-7 (measured).
"""


class Refuted(Exception):
    """A claim is not proved; the message names it."""


class Claims(NamedTuple):
    """The proved part of a certificate; attributes as in `Certificate`."""

    scope: str
    alpha: float
    alpha_separate: float
    alpha_joint: float | None
    rho: float
    beta: float
    kappa: float
    lipschitz: dict[str, float]
    witnesses: dict[str, Any]


def require_claims(claims: Claims, weights: Exported, box: Box) -> None:
    """Check every claim from its witness.

    Raises:
        Refuted: names the first claim that does not follow.
    """
    for name, value in _constants(claims):
        if not (isinstance(value, int | float) and 0 <= value < math.inf):
            raise Refuted(f"{name} is not a bound: {value!r}")
    linear, networks = readouts(weights), decoders(weights)
    if set(claims.lipschitz) != {*linear, *networks}:
        expected = ", ".join((*linear, *networks))
        actual = ", ".join(map(str, claims.lipschitz))
        raise Refuted(f"lipschitz must be of {expected}, got {actual}")
    _require_box(weights, box)
    witnesses = {name: _arrays(value) for name, value in claims.witnesses.items()}
    checks = {"beta": _bounded(weights.residual, witnesses["residual"], claims.beta)}
    checks |= _operator_checks(claims, weights, box, witnesses)
    separate = claims.rho + claims.beta * claims.kappa**0.5
    checks["alpha_separate"] = claims.alpha_separate == separate
    joint = [] if claims.alpha_joint is None else [claims.alpha_joint]
    checks["alpha"] = claims.alpha == min([claims.alpha_separate, *joint])
    for name, rows in linear.items():
        bound = claims.lipschitz[name]
        checks[name] = not np.any(rows) or check_witness((), (), bound, rows)
    for name, network in networks.items():
        checks[name] = _bounded(network, witnesses[name], claims.lipschitz[name])
    for name, holds in checks.items():
        if not holds:
            raise Refuted(f"{name} does not follow from its witness")


def _operator_checks(
    claims: Claims, weights: Exported, box: Box, witnesses: dict[str, Any]
) -> dict[str, bool | np.bool_]:
    """Check ρ, its scope, κ and the joint α, which depend on the kind of A(e)."""
    metric, operators = witnesses["metric"], weights.operators
    bound = claims.alpha_joint
    if isinstance(operators, Hypernetwork):
        norm, scope = operator_norms(weights, box)
        rho = norm <= claims.rho
        joint = bound is None or (
            joint_bound_over_box(weights, box, witnesses["joint"][0]).upper <= bound
        )
    elif metric is None:
        scope, vertices = hull_scope(weights), operators.vertices
        rho = all(check_witness((), (), claims.rho, vertex) for vertex in vertices)
        joint = bound is None or all(
            check_witness(weights.residual, part, bound, vertex)
            for part, vertex in zip(witnesses["joint"], vertices, strict=True)
        )
    else:
        scope, vertices = hull_scope(weights), list(operators.vertices)
        rho = check_metric(np.asarray(metric), vertices, claims.rho, claims.kappa)
        joint = bound is None and weights.declared.transport == "identity"
    kappa = claims.kappa == 1.0 if metric is None else claims.kappa >= 1.0
    scope_holds = claims.scope == scope
    return {"rho": rho, "scope": scope_holds, "kappa": kappa, "alpha_joint": joint}


def _constants(claims: Claims) -> list[tuple[str, Any]]:
    """All claimed constants by name."""
    names = ("alpha", "alpha_separate", "rho", "beta", "kappa")
    joint = [] if claims.alpha_joint is None else [("alpha_joint", claims.alpha_joint)]
    return [
        *((name, getattr(claims, name)) for name in names),
        *joint,
        *claims.lipschitz.items(),
    ]


def _require_box(weights: Exported, box: Box) -> None:
    """Check that the box is finite, not reversed, and of the operators' input size.

    Raises:
        Refuted: it is not.
    """
    corners = np.asarray(box, dtype=np.float64)
    valid = (
        corners.ndim == 2
        and len(corners) == 2
        and np.all(np.isfinite(corners))
        and np.all(corners[0] <= corners[1])
    )
    if not valid:
        raise Refuted(f"env_box must be a lower and an upper corner, got {box!r}")
    if isinstance(weights.operators, Hypernetwork):
        entries, inputs = corners.shape[1], weights.operators.weights[0].shape[1]
        if entries != inputs:
            raise Refuted(f"env_box has {entries} entries, the operators take {inputs}")


def _bounded(
    weights: Sequence[Matrix], multipliers: Sequence[Vector], bound: float
) -> bool:
    """Return whether a network respects a bound; an absent one is constant."""
    return (
        not weights
        or not np.any(weights[-1])
        or check_witness(weights, multipliers, bound)
    )


def operator_norms(weights: Exported, box: Box) -> tuple[float, str]:
    """Return ρ in the 2-norm for all environments, and the scope as text."""
    if isinstance(weights.operators, Hypernetwork):
        norm = bound_over_box(weights.operators, box, norm_upper)
        scope = f"all e in the box, branch and bound over {norm.cells} cells"
        return COMPILATION_SLACK * norm.upper, f"{scope}; all u, all z"
    norms = [norm_upper(vertex) for vertex in weights.operators.vertices]
    return COMPILATION_SLACK * max(norms), hull_scope(weights)


def joint_bound_over_box(
    weights: Exported, box: Box, multipliers: Sequence[Vector]
) -> BoxBound:
    """Bound the joint α over the box; as a function of A it is 1-Lipschitz."""
    assert isinstance(weights.operators, Hypernetwork)
    if not weights.residual:
        return bound_over_box(weights.operators, box, norm_upper)
    return bound_over_box(
        weights.operators,
        box,
        lambda operator: smallest_bound(weights.residual, multipliers, operator),
    )


def hull_scope(weights: Exported) -> str:
    """Return the scope of a polytope of operators as text."""
    count = len(weights.operators[0])
    return f"all e: A(e) lies in the hull of {count} vertices; all u, all z"


def readouts(weights: Exported) -> dict[str, Matrix]:
    """Return the rows of the linear read-out by name of the output.

    With a decoder for the pose: the body state. Without one (along a path): e_y [m],
    e_ψ [rad], and the rest of the body state.
    """
    if weights.decoder:
        return {"body": weights.readout}
    return {
        "position": weights.readout[:1],
        "yaw": weights.readout[1:2],
        "body": weights.readout[2:],
    }


def decoders(weights: Exported) -> dict[str, list[Matrix]]:
    """Return the decoder's networks: position [m], yaw [rad], and both together."""
    if not weights.decoder:
        return {}
    *hidden, last = weights.decoder
    return {
        "position": [*hidden, last[:2]],
        "yaw": [*hidden, last[2:]],
        "decoder": [*hidden, last],
    }


def _arrays(witness: Any) -> Any:
    """Convert a witness from JSON: nested lists of vectors, rows of P, or None."""
    nested = (
        witness
        and isinstance(witness[0], list)
        and (not witness[0] or isinstance(witness[0][0], list))
    )
    if nested:
        return [_arrays(part) for part in witness]
    if witness is None:
        return None
    return [np.asarray(part, dtype=np.float64) for part in witness]
