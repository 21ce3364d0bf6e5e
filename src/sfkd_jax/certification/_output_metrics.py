"""Contraction of a step in the metric of one output, and the gain of that output.

The 2-norm weighs all directions of the latent alike, but an output depends on some of
them only. With P = L L' chosen for the read-out row c, the tube |c z| ≤ |c|_{P⁻¹} R of
the same weights is several times tighter (closed-loop tube of Singh et al. 2017, for
one output at a time). `_metric_search` proposes P and the multipliers; here they are
checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sfkd_jax.certification._claims import Refuted, readouts
from sfkd_jax.certification._core import (
    UNIT,
    Matrix,
    Vector,
    check_vertices,
    frobenius,
    is_positive_definite,
    product,
)
from sfkd_jax.certification._exported import Exported
from sfkd_jax.types import Polytope

OUTPUTS = ("position", "yaw")
"""Outputs with a metric of their own: e_y [m] and e_ψ [rad]."""


class OutputMetric(NamedTuple):
    """Constants proved in the metric of one output.

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
        joint = [[part.tolist() for part in vertex] for vertex in self.joint]
        return {
            "alpha": self.alpha,
            "lipschitz": self.lipschitz,
            "witness": {"metric": self.metric.tolist(), "joint": joint},
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> OutputMetric:
        """Read a claim from JSON values.

        Raises:
            KeyError: a key is missing.
            TypeError: a value is of another type.
            ValueError: a value is not a number, or an array is ragged.
        """
        witness = document["witness"]
        joint = [
            [np.asarray(part, dtype=np.float64) for part in vertex]
            for vertex in witness["joint"]
        ]
        metric = np.asarray(witness["metric"], dtype=np.float64)
        return cls(document["alpha"], document["lipschitz"], metric, joint)


def may_have_metrics(weights: Exported) -> bool:
    """Return whether metrics other than I can be proved for a model.

    They need a polytope of operators, no transport, and no decoder of the pose.
    """
    polytope = isinstance(weights.operators, Polytope)
    return polytope and weights.declared.transport == "identity" and not weights.decoder


def require_output_metric(name: str, claim: OutputMetric, weights: Exported) -> None:
    """Check both constants from P and the multipliers, without a search.

    Raises:
        Refuted: names the constant that does not follow.
    """
    if name not in OUTPUTS or not may_have_metrics(weights):
        raise Refuted(f"outputs.{name}: this model has no metric of an output")
    for constant in ("alpha", "lipschitz"):
        value = getattr(claim, constant)
        if not (isinstance(value, float) and 0 < value < math.inf):
            raise Refuted(f"outputs.{name}.{constant} is not a bound: {value!r}")
    vertices = weights.operators.vertices
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
    matrix = scaled - 0.5 * (squared + squared.T)
    error = rounding + 4 * UNIT * (frobenius(scaled) + frobenius(squared))
    return is_positive_definite(matrix, error)
