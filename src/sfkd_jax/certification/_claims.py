"""The claims of a certificate, each checked from its witness without a search."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import jax
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
from sfkd_jax.certification._weights import Exported, require, require_all

COMPILATION_SLACK = 1.0 + 1e-6
"""Slack for rounding: other processors and versions of jax serve other weights."""
OUTPUTS = ("position", "yaw")
"""Outputs with a metric of their own: e_y [m] and e_ψ [rad]."""
FLOAT32 = 1e-5
"""Relative excess over a bound that float32 rounding of an attacked model explains."""
UNIT_ERROR = 1e-9
"""Relative error of the size of P, which is fixed."""
LOOSE = 0.01
"""Share by which a constant of a metric may exceed the least one that P proves."""
CONSTANTS = ("alpha", "alpha_separate", "alpha_joint", "rho", "beta")
Box: TypeAlias = Sequence[Any]
"""Lower and upper corner of a box of environments."""


@dataclass(frozen=True, kw_only=True)
class Claims:
    """Constants proved in the 2-norm, with their witnesses."""

    scope: str  # the environments, and how all of them are covered
    # Contraction factor of a step, |F(z) − F(z')| ≤ α |z − z'| for all z, z', u and all
    # e of the scope: the smaller of the next two.
    alpha: float
    alpha_separate: float  # ρ + β
    alpha_joint: float  # of z ↦ A(e) z + r(z; u, e) as one map
    rho: float  # sup_e ||A(e)||
    beta: float  # Lipschitz constant of r in z
    # Lipschitz constants of the decoder's outputs "position" [m], "yaw" [rad], both
    # ("decoder") and of "body".
    lipschitz: dict[str, float]
    witnesses: dict[str, Any]  # multipliers of all proofs; a check needs no search


def with_room(weights: Exported, room: float = 1.0001) -> Exported:
    """Return larger networks, so that every inequality of a witness has room."""
    # A hundred times the 1e-6 by which other compilers round weights, see the tests.
    residual = tuple(room * layer for layer in weights.residual)
    decoder = tuple(room * layer for layer in weights.decoder)
    return weights._replace(residual=residual, decoder=decoder)


def require_claims(claims: Claims, weights: Exported, box: Box) -> None:
    """Refuse the first claim in the 2-norm that does not follow from its witness."""
    constants = {name: getattr(claims, name) for name in CONSTANTS} | claims.lipschitz
    for name, value in constants.items():
        bound = isinstance(value, int | float) and 0 <= value < math.inf
        require(bound, f"{name} is not a bound: {value!r}")
    linear = readouts(weights)
    networks = decoders(weights)
    # Exactly these outputs: a missing one would be unbounded, another one meaningless.
    expected = [*linear, *networks]
    actual = [*claims.lipschitz]
    require(
        set(actual) == {*expected},
        f"lipschitz must be of {', '.join(expected)}, got {actual}",
    )
    require_box("env_box", box)
    witness = claims.witnesses
    vertices = list(weights.operators.vertices)
    residual = vectors(witness["residual"])
    joint = [vectors(each) for each in witness["joint"]]
    # Operators alone, without a network: no multipliers at any vertex.
    none = [()] * len(vertices)
    checks = {
        "beta": _bounded(weights.residual, residual, claims.beta),
        "rho": check_vertices((), none, claims.rho, vertices),
        "scope": claims.scope == hull_scope(weights),
        "alpha_joint": check_vertices(
            weights.residual, joint, claims.alpha_joint, vertices
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
        checks[name] = _bounded(network, vectors(witness[name]), claims.lipschitz[name])
    require_all(checks)


def require_box(name: str, box: Box) -> np.ndarray:
    """Return the corners of a box; refuse one that is not finite, or reversed."""
    corners = np.asarray(box)
    pair = corners.dtype.kind in "if" and corners.ndim == 2 and len(corners) == 2
    # Finite: an infinite box would promise what no attack has looked at. Equal corners
    # are allowed, since a condition may be constant.
    finite = pair and np.all(np.isfinite(corners))
    require(
        finite and np.all(corners[0] <= corners[1]),
        f"{name} must be a lower and an upper corner, got {box!r}",
    )
    return corners


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
    rows = weights.readout
    if weights.decoder:
        return {"body": rows}
    return {"position": rows[:1], "yaw": rows[1:2], "body": rows[2:]}


def decoders(weights: Exported) -> dict[str, list[Matrix]]:
    """Return the decoder's networks: position [m], yaw [rad], and both together."""
    if not weights.decoder:
        return {}
    *hidden, last = weights.decoder
    # Rows of the last layer: each output is a network of its own with the same layers.
    parts = {"position": last[:2], "yaw": last[2:], "decoder": last}
    return {name: [*hidden, rows] for name, rows in parts.items()}


def attack_limits(claims: Claims, weights: Exported) -> dict[str, float]:
    """Return the proved bound behind each attack, by name of the attack."""
    limits = {"residual_slopes": claims.beta, "transport": 1.0, **claims.lipschitz}
    limits |= {f"{name}_slopes": claims.lipschitz[name] for name in decoders(weights)}
    return limits | {"step": claims.alpha, "step_slopes": claims.alpha}


def vectors(witness: Any) -> list[Vector]:
    """Read the multipliers of one network from JSON values."""
    return [np.asarray(part, dtype=np.float64) for part in witness]


def listed(witness: Any) -> Any:
    """Return arrays in nested lists as JSON values."""
    return jax.tree.map(lambda part: np.asarray(part, np.float64).tolist(), witness)


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
        constants = {"alpha": self.alpha, "lipschitz": self.lipschitz}
        return constants | _written(self)

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> OutputMetric:
        """Read a claim from JSON values; `MALFORMED` errors if it is none."""
        witness = _read(document["witness"])
        return cls(document["alpha"], document["lipschitz"], *witness)


def _written(claim: OutputMetric | LyapunovClaim) -> dict[str, Any]:
    """Return the witness of a metric as JSON values."""
    return {"witness": listed({"metric": claim.metric, "joint": claim.joint})}


def _read(witness: Mapping[str, Any]) -> tuple[Matrix, list[list[Vector]]]:
    """Read P and the multipliers of every vertex from JSON values."""
    joint = [vectors(each) for each in witness["joint"]]
    return np.asarray(witness["metric"], dtype=np.float64), joint


ROTATES = "P = I is the only metric that the transport keeps: c_1 = c_2 = 1"


def keeps_metrics(weights: Exported) -> bool:
    """Return whether distances in a metric other than I survive a switch of e.

    A rotation of the latent between two environments keeps the 2-norm only.
    """
    return weights.declared.transport == "identity"


def require_output_metric(name: str, claim: OutputMetric, weights: Exported) -> None:
    """Refuse a constant that does not follow from P and the multipliers."""
    where = f"outputs.{name}"
    # With a decoder the pose is no output of z, and no metric is about it.
    exists = name in OUTPUTS and keeps_metrics(weights) and not weights.decoder
    require(exists, f"{where}: this model has no such metric")
    for constant, value in zip(claim._fields[:2], claim[:2], strict=True):
        bound = isinstance(value, float) and 0 < value < math.inf
        require(bound, f"{where}.{constant} is not a bound: {value!r}")
    # Sizes first: the core multiplies matrices and would raise on others.
    fits = claim.metric.shape == weights.operators.vertices.shape[1:]
    require(fits, f"{where}.witness is of another size than the weights")
    rows = readouts(weights)[name]

    def reads(bound: float) -> bool:
        return reads_within(rows, bound, claim.metric)

    def contracts_at(alpha: float) -> bool:
        return contracts(claim._replace(alpha=alpha), weights)

    checks = {
        "alpha": claim.alpha < 1.0 and _is_least(contracts_at, claim.alpha),
        "lipschitz": _is_least(reads, claim.lipschitz),
        # Everything measured in |·|_P would change with the scale of P.
        "the unit of P": abs(size_of(claim.metric) - 1.0) <= UNIT_ERROR,
    }
    require_all(checks, f"{where}.")


def _is_least(proved: Callable[[float], bool], bound: float) -> bool:
    """Whether a bound is proved, and nothing smaller by more than `LOOSE` is.

    The measured radii rest on the constants: looser ones would contradict them.
    """
    return proved(bound) and not proved((1.0 - LOOSE) * bound)


def size_of(metric: Matrix) -> float:
    """Return the size of P that is 1 by convention; the scale of P is free.

    Entries of about 1 keep the rounding errors of the core small.
    """
    return float(np.trace(metric) / len(metric) + np.max(np.abs(metric))) / 2.0


def contracts(claim: OutputMetric | LyapunovClaim, weights: Exported) -> bool:
    """Check |F(z) − F(z')|_P ≤ α |z − z'|_P at every vertex, by the trusted core."""
    vertices = list(weights.operators.vertices)
    return check_vertices(
        weights.residual, claim.joint, claim.alpha, vertices, claim.metric
    )


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
    """

    rho: float  # ρ
    condition: float  # κ
    alpha: float  # |F(z) − F(z')|_P ≤ α |z − z'|_P of the whole step with its residual
    metric: Matrix  # P, (rank, rank)
    joint: list[list[Vector]]  # multipliers of every vertex that prove α

    def document(self) -> dict[str, Any]:
        """Return the claim as JSON values."""
        # c_1 = c_2 = √κ: from |z|_P to |z| and back costs the root of the condition.
        constants = dict(zip(self._fields[:3], self[:3], strict=True))
        root = math.sqrt(self.condition)
        return constants | {"c_1": root, "c_2": root} | _written(self)


def require_lyapunov(part: Mapping[str, Any], weights: Exported) -> None:
    """Check "lyapunov" of the document: constants from P, or a reason."""
    # A reason and nothing else: a document cannot hide a false claim beside one.
    if isinstance(part.get("reason"), str) and len(part) == 1:
        return
    rho, condition, alpha = (part[name] for name in LyapunovClaim._fields[:3])
    claim = LyapunovClaim(rho, condition, alpha, *_read(part["witness"]))
    vertices = list(weights.operators.vertices)
    constants = all(isinstance(value, float) for value in claim[:3])
    fits = keeps_metrics(weights) and claim.metric.shape == vertices[0].shape
    require(constants and fits, "lyapunov is not a claim about these operators")
    checks = {
        "rho or condition": rho < 1.0
        and check_metric(claim.metric, vertices, rho, condition),
        "alpha": alpha < 1.0 and contracts(claim, weights),
        "the unit of P": abs(np.linalg.eigvalsh(claim.metric)[0] - 1.0) <= UNIT_ERROR,
        # Compared as a whole, so that no further key can state an unproved constant.
        "c_1 or c_2": dict(part) == claim.document() | {"witness": part["witness"]},
    }
    require_all(checks, "lyapunov: ")
