"""Claims in a metric P; each is checked from its witness without a search.

`OutputMetric` is about one output, `LyapunovClaim` about the whole latent state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from sfkd_jax.certification._claims import listed, readouts, vectors
from sfkd_jax.certification._core import (
    UNIT,
    Matrix,
    Vector,
    check_metric,
    check_vertices,
    frobenius,
    is_positive_definite,
    product,
)
from sfkd_jax.certification._weights import Exported, require, require_all

OUTPUTS = ("position", "yaw")
"""Outputs with metrics of their own: e_y [m] and e_ψ [rad]."""
UNIT_ERROR = 1e-9
"""Largest error of the size of P, which is 1 by convention."""
LOOSE = 0.01
"""Share by which a constant of a metric may exceed the least one that P proves."""


class OutputMetric(NamedTuple):
    """Constants proved in the metric of one output.

    The 2-norm weighs all directions of the latent alike, but an output depends on some
    of them only. With a P chosen for its row c of the read-out, the tube
    |c z| ≤ |c|_{P⁻¹} R of the same weights is several times tighter. This is the
    closed-loop tube of Singh et al. 2017, for one output at a time.

    Attributes:
        alpha: α, with |F(z) − F(z')|_P ≤ α |z − z'|_P for all z, z', w and e.
        lipschitz: L, with |C z| ≤ L |z|_P for the output C z [m or rad].
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
            "witness": _witness_document(self),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> OutputMetric:
        """Read a claim from JSON values; raises `MALFORMED` errors if it is none."""
        metric, joint = _read_witness(document["witness"])
        return cls(document["alpha"], document["lipschitz"], metric, joint)


def _witness_document(claim: OutputMetric | LyapunovClaim) -> dict[str, Any]:
    """Return P and the multipliers of every vertex as JSON values."""
    return listed({"metric": claim.metric, "joint": claim.joint})


def _read_witness(witness: Mapping[str, Any]) -> tuple[Matrix, list[list[Vector]]]:
    """Read P and the multipliers of every vertex from JSON values."""
    joint = [vectors(of_vertex) for of_vertex in witness["joint"]]
    return np.asarray(witness["metric"], dtype=np.float64), joint


ROTATES = "P = I is the only metric that the transport keeps: c_1 = c_2 = 1"
"""Reason why a model that rotates its latent has no other metric."""


def keeps_metrics(weights: Exported) -> bool:
    """Return whether distances in a metric other than I survive a switch of e.

    A rotation of the latent between two environments keeps the 2-norm only.
    """
    return weights.declared.transport == "identity"


def require_output_metric(name: str, claim: OutputMetric, weights: Exported) -> None:
    """Refuse a constant that does not follow from P and the multipliers.

    Args:
        name: of the output.
        claim: from an untrusted source.
        weights: that it is about.

    Raises:
        CertificationRefused: a constant does not follow.
    """
    where = f"outputs.{name}"
    # With a decoder the pose is no linear output of z, and no metric is about it.
    exists = name in OUTPUTS and keeps_metrics(weights) and not weights.decoder
    require(exists, f"{where}: this model has no such metric")
    for constant in ("alpha", "lipschitz"):
        value = getattr(claim, constant)
        is_bound = isinstance(value, float) and 0 < value < math.inf
        require(is_bound, f"{where}.{constant} is not a bound: {value!r}")
    # Sizes are checked first: the core would raise on a product of other matrices.
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
        # Whatever is measured in |·|_P depends on the scale of P.
        "the unit of P": abs(size_of(claim.metric) - 1.0) <= UNIT_ERROR,
    }
    require_all(checks, f"{where}.")


def _is_least(proved: Callable[[float], bool], bound: float) -> bool:
    """Return whether a bound is proved, and none that is smaller by `LOOSE`.

    Measured radii were computed with the constants of the document. A document with
    looser constants would contradict its own radii.
    """
    return proved(bound) and not proved((1.0 - LOOSE) * bound)


def size_of(metric: Matrix) -> float:
    """Return the size of P, which is 1 by convention, since the scale of P is free.

    With entries of about 1 the rounding errors of the core are small.
    """
    return float(np.trace(metric) / len(metric) + np.max(np.abs(metric))) / 2.0


def contracts(claim: OutputMetric | LyapunovClaim, weights: Exported) -> bool:
    """Check |F(z) − F(z')|_P ≤ α |z − z'|_P at every vertex, by the trusted core."""
    vertices = list(weights.operators.vertices)
    return check_vertices(
        weights.residual, claim.joint, claim.alpha, vertices, claim.metric
    )


# Overflow is no error here: the core refuses NaN and infinity.
@np.errstate(over="ignore", invalid="ignore")
def reads_within(rows: Matrix, bound: float, metric: Matrix) -> bool:
    """Check that |C z| < b |z|_P for every z ≠ 0, that is b² P − C'C > 0."""
    squared, rounding = product(rows.T, rows)
    scaled = np.square(bound) * metric
    # Exactly symmetric, as the Cholesky factorisation presupposes.
    matrix = scaled - 0.5 * (squared + squared.T)
    # The rounding of the product, and that of scaling and of the difference.
    error = rounding + 4 * UNIT * (frobenius(scaled) + frobenius(squared))
    return is_positive_definite(matrix, error)


class LyapunovClaim(NamedTuple):
    """A common quadratic Lyapunov function of all operators, as in the paper's theorem.

        A(e)' P A(e) ≤ ρ² P for all e,   λ_max(P) ≤ κ λ_min(P)

    With α < 1 and |d_k| ≤ d̄ in the 2-norm, the theorem follows as

        |e_k| ≤ c_1 α^k |e_0| + c_2 d̄ / (1 − α),   c_1 = c_2 = √κ.

    The paper prints c_2 = 1/√λ_min(P), which depends on the scale of P, although that
    scale is free.

    Attributes:
        rho: ρ.
        condition: κ.
        alpha: α of the whole step with its residual, |F(z) − F(z')|_P ≤ α |z − z'|_P.
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
        # To go from |z|_P to |z| or back costs at most a factor √κ.
        root = math.sqrt(self.condition)
        return {
            "rho": self.rho,
            "condition": self.condition,
            "alpha": self.alpha,
            "c_1": root,
            "c_2": root,
            "witness": _witness_document(self),
        }


def require_lyapunov(part: Mapping[str, Any], weights: Exported) -> None:
    """Check the entry "lyapunov" of a document: constants from P, or a reason.

    Args:
        part: from an untrusted source.
        weights: that it is about.

    Raises:
        CertificationRefused: a constant does not follow.
    """
    # A reason must stand alone, so that no document hides a false claim beside one.
    if isinstance(part.get("reason"), str) and len(part) == 1:
        return
    rho = part["rho"]
    condition = part["condition"]
    alpha = part["alpha"]
    metric, joint = _read_witness(part["witness"])
    claim = LyapunovClaim(rho, condition, alpha, metric, joint)
    vertices = list(weights.operators.vertices)
    are_floats = all(isinstance(value, float) for value in (rho, condition, alpha))
    fits = keeps_metrics(weights) and metric.shape == vertices[0].shape
    require(are_floats and fits, "lyapunov is not a claim about these operators")
    checks = {
        "rho or condition": rho < 1.0
        and check_metric(metric, vertices, rho, condition),
        "alpha": alpha < 1.0 and contracts(claim, weights),
        "the unit of P": abs(np.linalg.eigvalsh(metric)[0] - 1.0) <= UNIT_ERROR,
        # Compared as a whole, so that no further key can state an unproved constant.
        "c_1 or c_2": dict(part) == {**claim.document(), "witness": part["witness"]},
    }
    require_all(checks, "lyapunov: ")
