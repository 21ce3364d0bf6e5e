"""The claims of a certificate, each checked from its witness without a search."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sfkd_jax.certification._core import (
    UNIT,
    Matrix,
    Vector,
    check_metric,
    check_vertices,
    check_witness,
    frobenius,
    is_positive_definite,
    product,
)
from sfkd_jax.certification._weights import Exported

COMPILATION_SLACK = 1.0 + 1e-6
"""Slack for rounding: another compilation of the same model may serve explicit weights
that differ relatively by about 1.5e-7 (measured).
"""
OUTPUTS = ("position", "yaw")
"""Outputs with a metric of their own: e_y [m] and e_ψ [rad]."""
Box: TypeAlias = Sequence[Any]
"""Lower and upper corner of a box of environments."""


class Refuted(Exception):
    """A claim is not proved; the message names it."""


class Claims(NamedTuple):
    """The proved part of a certificate; attributes as in `Certificate`."""

    scope: str
    alpha: float
    alpha_separate: float
    alpha_joint: float
    rho: float
    beta: float
    lipschitz: dict[str, float]
    witnesses: dict[str, Any]


def require_claims(claims: Claims, weights: Exported, box: Box) -> None:
    """Check every claim in the 2-norm from its witness.

    Raises:
        Refuted: names the first claim that does not follow.
    """
    names = ("alpha", "alpha_separate", "alpha_joint", "rho", "beta")
    constants = {name: getattr(claims, name) for name in names} | claims.lipschitz
    for name, value in constants.items():
        # NaN compares false, so it is refused here as well
        if not (isinstance(value, int | float) and 0 <= value < math.inf):
            raise Refuted(f"{name} is not a bound: {value!r}")
    linear, networks = readouts(weights), decoders(weights)
    # Exactly these outputs: a missing one would be unbounded, another one meaningless.
    if set(claims.lipschitz) != {*linear, *networks}:
        expected = ", ".join((*linear, *networks))
        actual = ", ".join(map(str, claims.lipschitz))
        raise Refuted(f"lipschitz must be of {expected}, got {actual}")
    _require_box(box)
    witnesses = {name: _arrays(value) for name, value in claims.witnesses.items()}
    vertices = list(weights.operators.vertices)
    # Operators alone, without a network: no multipliers at any vertex.
    none = [()] * len(vertices)
    checks = {
        "beta": _bounded(weights.residual, witnesses["residual"], claims.beta),
        "rho": check_vertices((), none, claims.rho, vertices),
        "scope": claims.scope == hull_scope(weights),
        "alpha_joint": check_vertices(
            weights.residual, witnesses["joint"], claims.alpha_joint, vertices
        ),
        # Equal, not at most: these two are arithmetic on the numbers that were proved.
        "alpha_separate": claims.alpha_separate == claims.rho + claims.beta,
        "alpha": claims.alpha == min(claims.alpha_separate, claims.alpha_joint),
    }
    for name, rows in linear.items():
        bound = claims.lipschitz[name]
        # A read-out of zeros has the constant 0, which no strict inequality proves.
        checks[name] = not np.any(rows) or check_witness((), (), bound, rows)
    for name, network in networks.items():
        checks[name] = _bounded(network, witnesses[name], claims.lipschitz[name])
    for name, holds in checks.items():
        if not holds:
            raise Refuted(f"{name} does not follow from its witness")


def _require_box(box: Box) -> None:
    """Refuse a box that is not finite, or reversed."""
    corners = np.asarray(box, dtype=np.float64)
    # Finite: an infinite box would promise what no attack has looked at.
    pair = corners.ndim == 2 and len(corners) == 2 and np.all(np.isfinite(corners))
    if not pair or not np.all(corners[0] <= corners[1]):
        raise Refuted(f"env_box must be a lower and an upper corner, got {box!r}")


def _bounded(
    weights: Sequence[Matrix], multipliers: Sequence[Vector], bound: float
) -> bool:
    """Return whether a network respects a bound; an absent one is constant."""
    return (
        not weights
        # W_L = 0 makes a constant whatever the hidden layers are, and needs no witness.
        or not np.any(weights[-1])
        or check_witness(weights, multipliers, bound)
    )


def hull_scope(weights: Exported) -> str:
    """Return the scope of a polytope of operators as text."""
    count = len(weights.operators.vertices)
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
        # Rows of the last layer: each output is a
        # network of its own with the same layers.
        "position": [*hidden, last[:2]],
        "yaw": [*hidden, last[2:]],
        "decoder": [*hidden, last],
    }


def _arrays(witness: Any) -> Any:
    """Convert multipliers from JSON: vectors, or a list of vectors at each vertex."""
    if witness and all(isinstance(part, list) for part in witness):
        entries = [entry for part in witness for entry in part]
        # Lists in lists in lists: the multipliers of each vertex, one level deeper.
        if all(isinstance(entry, list) for entry in entries):
            return [_arrays(part) for part in witness]
    return [np.asarray(part, dtype=np.float64) for part in witness]


def witness_document(metric: Matrix, joint: list[list[Vector]]) -> dict[str, Any]:
    """Return P and the multipliers of every vertex as JSON values."""
    listed = [[part.tolist() for part in vertex] for vertex in joint]
    return {"metric": metric.tolist(), "joint": listed}


def read_witness(witness: Mapping[str, Any]) -> tuple[Matrix, list[list[Vector]]]:
    """Read P and the multipliers of every vertex from JSON values."""
    joint = [
        [np.asarray(part, dtype=np.float64) for part in vertex]
        for vertex in witness["joint"]
    ]
    return np.asarray(witness["metric"], dtype=np.float64), joint


class OutputMetric(NamedTuple):
    """Constants proved in the metric of one output.

    The 2-norm weighs all directions of the latent alike, but an output depends on some
    of them only. With P chosen for the read-out row c, the tube |c z| ≤ |c|_{P⁻¹} R of
    the same weights is several times tighter (closed-loop tube of Singh et al. 2017,
    for one output at a time).

    Attributes:
        alpha: |F(z) − F(z')|_P ≤ α |z − z'|_P for all z, z', w and e.
        lipschitz: |C z| ≤ L |z|_P for the output C z [m or rad].
        metric: P, (rank, rank).
        joint: multipliers of every vertex that prove α.
    """

    alpha: float
    lipschitz: float
    metric: Matrix
    joint: list[list[Vector]]

    def document(self) -> dict[str, Any]:
        """Return the claim as JSON values."""
        return {
            "alpha": self.alpha,
            "lipschitz": self.lipschitz,
            "witness": witness_document(self.metric, self.joint),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> OutputMetric:
        """Read a claim from JSON values.

        Raises:
            KeyError: a key is missing.
            TypeError: a value is of another type.
            ValueError: a value is not a number, or an array is ragged.
        """
        witness = read_witness(document["witness"])
        return cls(document["alpha"], document["lipschitz"], *witness)


def keeps_metrics(weights: Exported) -> bool:
    """Return whether distances in a metric other than I survive a switch of e.

    A rotation of the latent between two environments keeps the 2-norm only.
    """
    return weights.declared.transport == "identity"


def require_output_metric(name: str, claim: OutputMetric, weights: Exported) -> None:
    """Check both constants from P and the multipliers, without a search.

    Raises:
        Refuted: names the constant that does not follow.
    """
    # With a decoder the pose is no output of z, and no metric is about it.
    if name not in OUTPUTS or not keeps_metrics(weights) or weights.decoder:
        raise Refuted(f"outputs.{name}: this model has no metric of an output")
    for constant in ("alpha", "lipschitz"):
        value = getattr(claim, constant)
        if not (isinstance(value, float) and 0 < value < math.inf):
            raise Refuted(f"outputs.{name}.{constant} is not a bound: {value!r}")
    vertices = weights.operators.vertices
    # Sizes first: the core multiplies matrices and would raise on others.
    if claim.metric.shape != vertices.shape[1:] or len(claim.joint) != len(vertices):
        raise Refuted(f"outputs.{name}.witness is of another size than the weights")
    if not claim.alpha < 1.0 or not check_vertices(
        weights.residual, claim.joint, claim.alpha, list(vertices), claim.metric
    ):
        raise Refuted(f"outputs.{name}.alpha does not follow from its witness")
    if not reads_within(readouts(weights)[name], claim.lipschitz, claim.metric):
        raise Refuted(f"outputs.{name}.lipschitz does not follow from its witness")


@np.errstate(over="ignore", invalid="ignore")  # the core refuses NaN and infinity
def reads_within(rows: Matrix, bound: float, metric: Matrix) -> bool:
    """Check that |C z| < b |z|_P for every z ≠ 0, that is b² P − C'C > 0."""
    squared, rounding = product(rows.T, rows)
    scaled = np.square(bound) * metric
    # Exactly symmetric, which the Cholesky factorisation takes for granted.
    matrix = scaled - 0.5 * (squared + squared.T)
    # Rounding of the product plus that of scaling and of the difference.
    error = rounding + 4 * UNIT * (frobenius(scaled) + frobenius(squared))
    return is_positive_definite(matrix, error)


class LyapunovClaim(NamedTuple):
    """A common quadratic Lyapunov function of all operators, as in the paper's theorem.

        A(e)' P A(e) ≤ ρ² P for all e,   λ_max(P) ≤ κ λ_min(P)

    With α < 1 and |d_k| ≤ d̄ in the 2-norm, the theorem follows as

        |e_k| ≤ c_1 α^k |e_0| + c_2 d̄ / (1 − α),   c_1 = c_2 = √κ.

    The printed c_2 = 1/√λ_min(P) depends on the scale of P, which is free.

    Attributes:
        rho: ρ.
        condition: κ.
        alpha: |F(z) − F(z')|_P ≤ α |z − z'|_P of the whole step with its residual.
        metric: P, (rank, rank).
        joint: multipliers of every vertex that prove α.
    """

    rho: float
    condition: float
    alpha: float
    metric: Matrix
    joint: list[list[Vector]]

    def document(self) -> dict[str, Any]:
        """Return the claim as JSON values."""
        # c_1 = c_2 = √κ: from |z|_P to |z| and back costs the root of the condition.
        constant = math.sqrt(self.condition)
        return {
            "rho": self.rho,
            "condition": self.condition,
            "alpha": self.alpha,
            "c_1": constant,
            "c_2": constant,
            "witness": witness_document(self.metric, self.joint),
        }


def require_lyapunov(part: Mapping[str, Any], weights: Exported) -> None:
    """Check ρ, κ, α, c_1 and c_2 from P; without one, that a reason is given.

    Args:
        part: "lyapunov" of the document.
        weights: explicit weights.

    Raises:
        Refuted: names what does not follow.
    """
    # A reason and nothing else: a document cannot hide a false claim beside one.
    if isinstance(part.get("reason"), str) and len(part) == 1:
        return
    witness = read_witness(part["witness"])
    claim = LyapunovClaim(part["rho"], part["condition"], part["alpha"], *witness)
    vertices = list(weights.operators.vertices)
    constants = all(isinstance(value, float) for value in claim[:3])
    fits = claim.metric.shape == vertices[0].shape
    if not (keeps_metrics(weights) and constants and fits):
        raise Refuted("lyapunov is not a claim about these operators")
    if not check_metric(claim.metric, vertices, claim.rho, claim.condition):
        raise Refuted("lyapunov: rho or condition does not follow from its witness")
    if not check_vertices(
        weights.residual, claim.joint, claim.alpha, vertices, claim.metric
    ):
        raise Refuted("lyapunov: alpha does not follow from its witness")
    # Compared as a whole, so that no further key can state an unproved constant.
    if dict(part) != claim.document() | {"witness": part["witness"]}:
        raise Refuted("lyapunov: c_1 or c_2 is not the root of the condition")
