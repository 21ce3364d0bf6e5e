"""The claims of a certificate; each is checked from its witness without a search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sfkd_jax.certificate import Box, Claims, Multipliers
from sfkd_jax.certification._core import Matrix, Vector, check_vertices, check_witness
from sfkd_jax.certification._weights import Exported, require, require_all
from sfkd_jax.types import BODY, Frame

COMPILATION_SLACK = 1.0 + 1e-6
"""Factor on constants. Explicit weights are computed with slightly different rounding
on other processors and by other versions of jax.
"""
FLOAT32 = 1e-5
"""Relative excess over a bound that float32 rounding of an attacked model explains."""
CONSTANTS = ("alpha", "alpha_separate", "alpha_joint", "rho", "beta")
"""Constants of a step in the 2-norm, see `Claims`."""


def with_room(weights: Exported, room: float = 1.0001) -> Exported:
    """Return larger networks, so that every inequality of a witness has room.

    The default is a hundred times the 1e-6 by which the weights differ that other
    compilers serve, as the tests measure.
    """
    residual = tuple(room * layer for layer in weights.residual)
    decoder = tuple(room * layer for layer in weights.decoder)
    return weights._replace(residual=residual, decoder=decoder)


def require_claims(claims: Claims, weights: Exported, frame: Frame) -> None:
    """Refuse the first claim in the 2-norm that does not follow from its witness.

    Args:
        claims: from an untrusted source.
        weights: that they are about.
        frame: of the model.

    Raises:
        CertificationRefused: a claim does not follow.
    """
    _require_bounds(claims)
    linear = readouts(weights, frame)
    networks = decoders(weights)
    # Exactly these outputs: a missing one would be unbounded, another one meaningless.
    expected = [*linear, *networks]
    actual = [*claims.lipschitz]
    require(
        set(actual) == {*expected},
        f"lipschitz must be of {', '.join(expected)}, got {actual}",
    )
    witnesses = claims.witnesses
    require(
        set(witnesses.decoders) == {*networks},
        f"witnesses must be of the decoders {', '.join(networks) or 'none'}",
    )
    vertices = list(weights.operators.vertices)
    residual_multipliers = vectors(witnesses.residual)
    joint_multipliers = [vectors(of_vertex) for of_vertex in witnesses.joint]
    # An operator alone has no hidden layers, and needs no multipliers.
    no_multipliers = [()] * len(vertices)
    checks = {
        "beta": _bounded(weights.residual, residual_multipliers, claims.beta),
        "rho": check_vertices((), no_multipliers, claims.rho, vertices),
        "scope": claims.scope == hull_scope(weights),
        "alpha_joint": check_vertices(
            weights.residual, joint_multipliers, claims.alpha_joint, vertices
        ),
        # These two must be equal and not only large enough: they are arithmetic on the
        # numbers that were proved.
        "alpha_separate": claims.alpha_separate == claims.rho + claims.beta,
        "alpha": claims.alpha == min(claims.alpha_separate, claims.alpha_joint),
    }
    for name, rows in linear.items():
        bound = claims.lipschitz[name]
        # A read-out of zeros has the constant 0, which no strict inequality proves.
        holds = not np.any(rows) or check_witness((), (), bound, rows)
        # An output may have the name of a constant, and must not replace its check.
        checks[f"lipschitz.{name}"] = holds
    for name, network in networks.items():
        multipliers = vectors(witnesses.decoders[name])
        holds = _bounded(network, multipliers, claims.lipschitz[name])
        checks[f"lipschitz.{name}"] = holds
    require_all(checks)


def _require_bounds(claims: Claims) -> None:
    """Refuse a constant that is no number between 0 and infinity."""
    constants = {name: getattr(claims, name) for name in CONSTANTS}
    for name, value in claims.lipschitz.items():
        constants[f"lipschitz.{name}"] = value
    for name, value in constants.items():
        is_bound = isinstance(value, int | float) and 0 <= value < math.inf
        require(is_bound, f"{name} is not a bound: {value!r}")


def require_box(name: str, box: Any) -> Box:
    """Return a box as two rows of numbers.

    Equal corners are allowed, since a condition may be constant. An infinite box is
    not: it would promise what no attack has looked at.

    Args:
        name: of the box, for messages.
        box: lower and upper corner.

    Raises:
        CertificationRefused: a corner is not finite, or the box is reversed.
    """
    corners = np.asarray(box)
    is_pair = corners.dtype.kind in "if" and corners.ndim == 2 and len(corners) == 2
    is_finite = is_pair and np.all(np.isfinite(corners))
    require(
        is_finite and np.all(corners[0] <= corners[1]),
        f"{name} must be a lower and an upper corner, got {box!r}",
    )
    low, high = rows(corners)
    return low, high


def _bounded(
    weights: Sequence[Matrix], multipliers: Sequence[Vector], bound: float
) -> bool:
    """Return whether multipliers prove a Lipschitz bound of a network.

    Without a network, and with a last layer of zeros, the map is constant whatever its
    hidden layers are. It then needs no witness.
    """
    if not weights or not np.any(weights[-1]):
        return True
    return check_witness(weights, multipliers, bound)


def hull_scope(weights: Exported) -> str:
    """Return for which e, u and z the claims about a polytope of operators hold."""
    count = len(weights.operators.vertices)
    return f"all e: A(e) lies in the hull of {count} vertices; all u, all z"


def readouts(weights: Exported, frame: Frame) -> dict[str, Matrix]:
    """Return the rows of the linear read-out by the names of the outputs.

    If a decoder gives the pose, the read-out gives the body state alone. Without a pose
    it gives every output of the frame.
    """
    if frame.has_pose:
        return {"body": weights.readout}
    # The entries of an output count those of the pose, which are always 0.
    pose = np.zeros((BODY.start, weights.readout.shape[1]))
    state = np.concatenate([pose, weights.readout])
    return {name: state[frame.entries(name)] for name in frame.outputs}


def decoders(weights: Exported) -> dict[str, list[Matrix]]:
    """Return the networks of the decoder by the names of their outputs.

    These are the position [m], the yaw [rad], and both together. Each is a network of
    its own, with the same hidden layers and some rows of the last layer.
    """
    if not weights.decoder:
        return {}
    *hidden, last = weights.decoder
    return {
        "position": [*hidden, last[:2]],
        "yaw": [*hidden, last[2:]],
        "decoder": [*hidden, last],
    }


def attack_limits(claims: Claims, weights: Exported) -> dict[str, float]:
    """Return the proved bound that each attack must not exceed, by its name."""
    limits = {"residual_slopes": claims.beta, "transport": 1.0, **claims.lipschitz}
    for name in decoders(weights):
        limits[f"{name}_slopes"] = claims.lipschitz[name]
    limits["step"] = claims.alpha
    limits["step_slopes"] = claims.alpha
    return limits


def vectors(multipliers: Multipliers) -> list[Vector]:
    """Return the multipliers of a network as arrays."""
    return [np.asarray(part, dtype=np.float64) for part in multipliers]


def rows(arrays: Any) -> Any:
    """Return arrays in nested sequences as nested tuples of numbers."""
    if isinstance(arrays, np.ndarray):
        arrays = arrays.tolist()
    if isinstance(arrays, int | float):
        return float(arrays)
    return tuple(rows(part) for part in arrays)
