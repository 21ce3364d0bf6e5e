"""Every claim of a certificate, and how it is checked from its witness without a search."""

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
from sfkd_jax.certification._environments import Box, Cover, cover
from sfkd_jax.certification._exported import Exported
from sfkd_jax.certification._proposals import proved
from sfkd_jax.types import Hypernetwork

SERVED = 1.0 + 1e-6
"""The controller's own compilation may round the same weights differently, by 1.5e-7 at
most where it was measured.
"""


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


def claims_hold(claims: Claims, weights: Exported, box: Box) -> None:
    """Check every claim from its witness.

    Raises:
        Refuted: naming the first that does not follow.
    """
    networks = decoders(weights)
    for name, value in _constants(claims):
        if not (isinstance(value, int | float) and 0 <= value < math.inf):
            raise Refuted(f"{name} is no bound: {value!r}")
    linear = readouts(weights)
    if set(claims.lipschitz) != {*linear, *networks}:
        expected, got = (
            ", ".join(map(str, names))
            for names in ((*linear, *networks), claims.lipschitz)
        )
        raise Refuted(f"lipschitz must be of {expected}, got {got}")
    _require_box(weights, box)
    seen = {name: _arrays(value) for name, value in claims.witnesses.items()}
    metric, operators = seen["metric"], weights.operators
    checks = {"beta": _bounded(weights.residual, seen["residual"], claims.beta)}
    if isinstance(operators, Hypernetwork):
        rho, scope = operator_norms(weights, box)
        checks["rho"] = rho <= claims.rho
        joint = (
            claims.alpha_joint is None
            or joint_cover(weights, box, seen["joint"][0]).upper <= claims.alpha_joint
        )
    elif metric is None:
        scope = hull(weights)
        checks["rho"] = all(
            check_witness((), (), claims.rho, vertex) for vertex in operators.vertices
        )
        joint = claims.alpha_joint is None or all(
            check_witness(weights.residual, part, claims.alpha_joint, vertex)
            for part, vertex in zip(seen["joint"], operators.vertices, strict=True)
        )
    else:
        scope = hull(weights)
        checks["rho"] = check_metric(
            np.asarray(metric), list(operators.vertices), claims.rho, claims.kappa
        )
        joint = claims.alpha_joint is None and weights.declared.transport == "identity"
    checks["scope"] = claims.scope == scope
    checks["kappa"] = claims.kappa == 1.0 if metric is None else claims.kappa >= 1.0
    checks["alpha_joint"] = joint
    checks["alpha_separate"] = (
        claims.alpha_separate == claims.rho + claims.beta * claims.kappa**0.5
    )
    known = [claims.alpha_separate] + (
        [] if claims.alpha_joint is None else [claims.alpha_joint]
    )
    checks["alpha"] = claims.alpha == min(known)
    for name, rows in linear.items():
        checks[name] = not np.any(rows) or check_witness(
            (), (), claims.lipschitz[name], rows
        )
    for name, network in networks.items():
        checks[name] = _bounded(network, seen[name], claims.lipschitz[name])
    for name, holds in checks.items():
        if not holds:
            raise Refuted(f"{name} does not follow from its witness")


def _constants(claims: Claims) -> list[tuple[str, Any]]:
    """Every number that is claimed, by name."""
    names = ("alpha", "alpha_separate", "rho", "beta", "kappa")
    joint = [] if claims.alpha_joint is None else [("alpha_joint", claims.alpha_joint)]
    return [
        *((name, getattr(claims, name)) for name in names),
        *joint,
        *claims.lipschitz.items(),
    ]


def _require_box(weights: Exported, box: Box) -> None:
    """Refuse what is no lower and upper corner, or of other environments than the operators are given for.

    Raises:
        Refuted: naming the box.
    """
    corners = np.asarray(box, dtype=np.float64)
    sound = (
        corners.ndim == 2
        and len(corners) == 2
        and np.all(np.isfinite(corners))
        and np.all(corners[0] <= corners[1])
    )
    if not sound:
        raise Refuted(f"env_box must be a lower and an upper corner, got {box!r}")
    if (
        isinstance(weights.operators, Hypernetwork)
        and corners.shape[1] != weights.operators.weights[0].shape[1]
    ):
        raise Refuted(
            f"env_box has {corners.shape[1]} entries, the operators take {weights.operators.weights[0].shape[1]}"
        )


def _bounded(
    weights: Sequence[Matrix], multipliers: Sequence[Vector], bound: float
) -> bool:
    """Whether a network, if there is one and it emits anything but a constant, respects a bound."""
    return (
        not weights
        or not np.any(weights[-1])
        or check_witness(weights, multipliers, bound)
    )


def operator_norms(weights: Exported, box: Box) -> tuple[float, str]:
    """ρ in the 2-norm for all environments, and what "all" rests on."""
    if isinstance(weights.operators, Hypernetwork):
        found = cover(weights.operators, box, norm_upper)
        return (
            SERVED * found.upper,
            f"all e in the box, branch and bound over {found.cells} cells; all u, all z",
        )
    return SERVED * max(
        norm_upper(vertex) for vertex in weights.operators.vertices
    ), hull(weights)


def joint_cover(weights: Exported, box: Box, multipliers: Sequence[Vector]) -> Cover:
    """The joint bound over the box; as a function of A it moves no faster than ||A||_2."""
    assert isinstance(weights.operators, Hypernetwork)
    if not weights.residual:
        return cover(weights.operators, box, norm_upper)
    return cover(
        weights.operators,
        box,
        lambda operator: proved(weights.residual, multipliers, operator),
    )


def hull(weights: Exported) -> str:
    """What "all environments" rests on for a polytope."""
    return f"all e: A(e) lies in the hull of {len(weights.operators[0])} vertices; all u, all z"


def readouts(weights: Exported) -> dict[str, Matrix]:
    """What is read from z linearly, by name: the body state; along a path e_y [m], e_ψ [rad] and the rest.

    A model whose pose is not emitted by a decoder holds it in the first two rows of its
    read-out.
    """
    if weights.decoder:
        return {"body": weights.readout}
    return {
        "position": weights.readout[:1],
        "yaw": weights.readout[1:2],
        "body": weights.readout[2:],
    }


def decoders(weights: Exported) -> dict[str, list[Matrix]]:
    """The decoder's networks by name: position [m], yaw [rad], and both together."""
    if not weights.decoder:
        return {}
    *hidden, last = weights.decoder
    return {
        "position": [*hidden, last[:2]],
        "yaw": [*hidden, last[2:]],
        "decoder": [*hidden, last],
    }


def _arrays(witness: Any) -> Any:
    """Nested lists of floats as lists of vectors; a metric as a matrix; None as None."""
    if (
        witness
        and isinstance(witness[0], list)
        and (not witness[0] or isinstance(witness[0][0], list))
    ):
        return [_arrays(part) for part in witness]
    return (
        witness
        if witness is None
        else [np.asarray(part, dtype=np.float64) for part in witness]
    )
