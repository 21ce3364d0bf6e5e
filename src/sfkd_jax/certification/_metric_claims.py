"""Claims in a metric P; each is checked from its witness without a search."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sfkd_jax.certificate import LyapunovClaim, OutputMetric, Proof
from sfkd_jax.certification._claims import readouts, vectors
from sfkd_jax.certification._core import (
    UNIT,
    Matrix,
    check_metric,
    check_vertices,
    frobenius,
    is_positive_definite,
    product,
)
from sfkd_jax.certification._weights import Exported, require, require_all
from sfkd_jax.types import Frame

UNIT_ERROR = 1e-9
"""Largest error of the size of P, which is 1 by convention."""
ROTATES = "P = I is the only metric that the transport keeps: c_1 = c_2 = 1"
"""Reason why a model that rotates its latent has no other metric."""


def keeps_metrics(weights: Exported) -> bool:
    """Return whether distances in a metric other than I survive a switch of e.

    A rotation of the latent between two environments keeps the 2-norm only.
    """
    return weights.declared.transport == "identity"


def outputs_with_metric(weights: Exported, frame: Frame) -> tuple[str, ...]:
    """Return the names of the outputs that have a metric of their own.

    They are all outputs but "body", whose entries have mixed units. With a pose, or a
    transport that keeps the 2-norm alone, there are none.
    """
    # A decoder gives the pose, which is then no linear output of z.
    if frame.has_pose or not keeps_metrics(weights):
        return ()
    return tuple(name for name in frame.outputs if name != "body")


def require_output_metrics(
    claims: Mapping[str, OutputMetric], weights: Exported, frame: Frame
) -> None:
    """Refuse metrics unless they are of all outputs, or of none, and hold.

    Args:
        claims: from an untrusted source, by output.
        weights: that they are about.
        frame: of the model.

    Raises:
        CertificationRefused: an output is missing, or a claim does not follow.
    """
    for name, claim in claims.items():
        require_output_metric(name, claim, weights, frame)
    # None is no false claim: a search may find nothing.
    expected = outputs_with_metric(weights, frame)
    require(
        not claims or {*claims} == {*expected},
        f"outputs must be {', '.join(expected)}, got {[*claims]}",
    )


def require_output_metric(
    name: str, claim: OutputMetric, weights: Exported, frame: Frame
) -> None:
    """Refuse a constant that does not follow from P and the multipliers.

    Args:
        name: of the output.
        claim: from an untrusted source.
        weights: that it is about.
        frame: of the model.

    Raises:
        CertificationRefused: a constant does not follow.
    """
    where = f"outputs.{name}"
    exists = name in outputs_with_metric(weights, frame)
    require(exists, f"{where}: this model has no such metric")
    for constant in ("alpha", "lipschitz"):
        value = getattr(claim, constant)
        is_bound = isinstance(value, float) and 0 < value < math.inf
        require(is_bound, f"{where}.{constant} is not a bound: {value!r}")
    # Sizes are checked first: the core would raise on a product of other matrices.
    metric = np.asarray(claim.metric)
    fits = metric.shape == weights.operators.vertices.shape[1:]
    require(fits, f"{where}.metric is of another size than the weights")
    rows = readouts(weights, frame)[name]
    checks = {
        "alpha": claim.alpha < 1.0 and contracts(claim, weights),
        "lipschitz": reads_within(rows, claim.lipschitz, metric),
        # Whatever is measured in |·|_P depends on the scale of P.
        "the unit of P": abs(size_of(metric) - 1.0) <= UNIT_ERROR,
    }
    require_all(checks, f"{where}.")


def size_of(metric: Matrix) -> float:
    """Return the size of P, which is 1 by convention, since the scale of P is free.

    With entries of about 1 the rounding errors of the core are small.
    """
    return float(np.trace(metric) / len(metric) + np.max(np.abs(metric))) / 2.0


def contracts(claim: OutputMetric | LyapunovClaim, weights: Exported) -> bool:
    """Check |F(z) − F(z')|_P ≤ α |z − z'|_P at every vertex, by the trusted core."""
    vertices = list(weights.operators.vertices)
    joint = [vectors(of_vertex) for of_vertex in claim.joint]
    metric = np.asarray(claim.metric)
    return check_vertices(weights.residual, joint, claim.alpha, vertices, metric)


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


def require_lyapunov(proof: Proof, weights: Exported) -> None:
    """Check the common Lyapunov function of a proof, or that a reason stands alone.

    Args:
        proof: from an untrusted source.
        weights: that it is about.

    Raises:
        CertificationRefused: a constant does not follow.
    """
    claim = proof.lyapunov
    if claim is None:
        # Without a solver any reason will do; of a rotation there is one.
        known = keeps_metrics(weights) or proof.lyapunov_refused in (None, ROTATES)
        require(known, "lyapunov_refused is not the reason")
        return
    # No document hides a false claim behind a reason.
    require(proof.lyapunov_refused is None, "lyapunov is claimed and refused")
    metric = np.asarray(claim.metric)
    vertices = list(weights.operators.vertices)
    constants = (claim.rho, claim.condition, claim.alpha, claim.c_1, claim.c_2)
    are_bounds = all(0 < constant < math.inf for constant in constants)
    fits = keeps_metrics(weights) and metric.shape == vertices[0].shape
    require(are_bounds and fits, "lyapunov is not a claim about these operators")
    checks = {
        "rho or condition": claim.rho < 1.0
        and check_metric(metric, vertices, claim.rho, claim.condition),
        "alpha": claim.alpha < 1.0 and contracts(claim, weights),
        "the unit of P": abs(np.linalg.eigvalsh(metric)[0] - 1.0) <= UNIT_ERROR,
        # To go from |z|_P to |z| or back costs at most a factor √κ.
        "c_1 or c_2": claim.c_1 == claim.c_2 == math.sqrt(claim.condition),
    }
    require_all(checks, "lyapunov: ")
