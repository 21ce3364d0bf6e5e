"""Contraction rate of a continuous-time model, proved by a linear matrix inequality."""

from __future__ import annotations

import math
import time
from typing import Any

import jax
import numpy as np

from sfkd_jax.certification._attack_all import CertificateContradicted
from sfkd_jax.certification._claims import COMPILATION_SLACK
from sfkd_jax.certification._core import (
    TINY,
    UNIT,
    Matrix,
    Vector,
    frobenius,
    is_positive_definite,
    product,
)
from sfkd_jax.certification._exported import (
    CertificationRefused,
    Exported,
    explicit_weights,
    fingerprint,
    one_thread,
    require_finite,
    require_slopes,
)
from sfkd_jax.types import Incremental, Model, Params

HALVINGS = 40
"""Bisection steps of the search for the rate."""


def is_incremental(model: Model, params: Params) -> bool:
    """Return whether only the rate of the continuous flow can be certified."""
    return model.structure.explicit is not None and isinstance(
        jax.eval_shape(model.structure.explicit, params), Incremental
    )


def certify_incremental(
    model: Model, params: Params, *, dt: float, seed: int = 0
) -> dict[str, Any]:
    """Prove and attack the contraction rate γ of the continuous flow.

        |s(t) − s'(t)|_P ≤ exp(−γ t) |s(0) − s'(0)|_P   for all inputs

    with s in scaled units. This says nothing about the discretisation of the flow, and
    no tube follows from it.

    Args:
        model: a model whose `explicit` is an `Incremental`.
        params: its weights as exported.
        dt: sampling period [s].
        seed: of the attack.

    Returns:
        A document: rate_per_s is γ, alpha is exp(−γ dt), attack is the smallest rate
        [1/s] that the attack reached, and tightness is attack / rate, at least 1.

    Raises:
        CertificationRefused: no rate above 0 is proved; gives the reason.
        CertificateContradicted: the attack reached a rate below the proved one.
    """
    began = time.perf_counter()
    weights = explicit_weights(model, params)
    with one_thread():
        rate = incremental_rate(weights)
        attack = -attack_growth(weights, seed=seed)
    if not attack >= rate:
        raise CertificateContradicted(
            f"INTERNAL ERROR: slopes with rate {attack:.6g}/s, proved {rate:.6g}/s"
        )
    return {
        "valid": True,
        "reason": None,
        "mode": "incremental",
        "scope": "the continuous flow, not its discretisation; all states and inputs; "
        "no tube is derived from it",
        "alpha": math.exp(-rate * dt),
        "rate_per_s": rate,
        "attack": attack,
        "tightness": attack / rate,
        "metric": weights.metric.tolist(),
        "params_sha256": fingerprint(params),
        "seconds_proof": time.perf_counter() - began,
    }


def incremental_rate(weights: Exported) -> float:
    """Return the largest rate [1/s] that the model's metric and multipliers prove.

    Args:
        weights: an `Incremental` in float64.

    Raises:
        CertificationRefused: no rate above 0 is proved; gives the reason.
    """
    require_finite(weights)
    require_slopes(weights)
    if weights.declared.transport != "identity":
        raise CertificationRefused(
            f"the transport {weights.declared.transport!r} may stretch the metric"
        )
    if not is_positive_definite(_symmetric(weights.metric)):
        raise CertificationRefused("the metric is not positive definite")
    if not np.all(weights.multipliers > 0):
        raise CertificationRefused("the multipliers are not positive")
    low, high = 0.0, max(-_growth(weights, np.zeros(len(weights.multipliers)))[0], 0.0)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        proved = check_incremental(weights, middle)
        low, high = (middle, high) if proved else (low, middle)
    if not low > 0.0:
        raise CertificationRefused(
            "the matrix inequality of the incremental rate holds at no rate above 0"
        )
    return low


def check_incremental(weights: Exported, rate: float) -> bool:
    """Check that the metric P and multipliers Λ prove the contraction rate γ.

    For all inputs and every σ that acts entry by entry with slopes in [0, 1] it
    suffices that P > 0, Λ > 0 and

        [ −A_0'P − P A_0 − 2γP   −PA − W'Λ ]
        [           ·                2Λ    ]  >  0

    (add 2 δσ'Λ(W δs − δσ) ≥ 0 to the derivative of δs'P δs). The matrix is balanced by
    powers of 2. Its error bound includes rounding, and the differences between weights
    from different compilations of the model. Returns False if in doubt.

    Args:
        weights: an `Incremental` in float64.
        rate: γ [1/s].
    """
    P, multipliers = _symmetric(weights.metric), weights.multipliers
    finite = all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(weights))
    if not (finite and 0 < rate < np.inf and np.all(multipliers > 0)):
        return False
    if not is_positive_definite(P):
        return False
    balance = np.exp2(-np.round(0.5 * np.log2(multipliers)))
    drift, drift_error = product(P, weights.linear)
    forced, forced_error = product(P, weights.outer * balance)
    sensed = (multipliers * balance)[:, None] * weights.inner
    top, coupling = drift + drift.T + 2 * rate * P, forced.T + sensed
    hidden = -np.diag(2 * multipliers * balance**2)
    matrix = -np.block([[top, coupling.T], [coupling, hidden]])
    rounded = 2 * _size(P, weights.linear) + 2 * _size(P, weights.outer * balance)
    rounded = rounded + 2 * frobenius(sensed)
    summands = frobenius(matrix) + 2 * rate * frobenius(P) + rounded
    summed = 8 * UNIT * summands + matrix.size * TINY
    compiled = (COMPILATION_SLACK - 1.0) * rounded
    error = compiled + 2 * drift_error + 2 * forced_error + summed
    return is_positive_definite(matrix, error)


def attack_growth(weights: Exported, *, starts: int = 24, seed: int = 0) -> float:
    """Maximise the growth rate [1/s] of |δs|_P over slopes D.

    The rate is λ_max of the symmetric part of A_0 + A D W in coordinates of the metric.
    It is convex in D, so the maximum is at slopes 0 or 1. With the top direction fixed,
    the slopes are set by the sign of their effect, until the rate stops growing.

    Args:
        weights: an `Incremental` in float64.
        starts: number of starting points; the first has all slopes 1.
        seed: of the random starting points.
    """
    random, best = np.random.default_rng(seed), -np.inf
    for start in range(starts):
        share = 1.0 if start == 0 else random.uniform()
        draws = random.uniform(size=len(weights.multipliers))
        slopes, value = (draws < share).astype(float), -np.inf
        after, slopes = _growth(weights, slopes)
        while after > value + 1e-12 * abs(after):
            value = after
            after, slopes = _growth(weights, slopes)
        best = max(best, value, after)
    return best


def _growth(weights: Exported, slopes: Vector) -> tuple[float, Vector]:
    """λ_max at some slopes, and the slopes that maximise growth along its direction."""
    root = np.linalg.cholesky(_symmetric(weights.metric)).T  # P = R'R
    back = np.linalg.inv(root)
    outer, inner = root @ weights.outer, weights.inner @ back
    moving = root @ weights.linear @ back + outer @ (slopes[:, None] * inner)
    values, directions = np.linalg.eigh(0.5 * (moving + moving.T))
    steepest = directions[:, -1]
    effects = (steepest @ outer) * (inner @ steepest)
    return float(values[-1]), (effects > 0).astype(float)


def _symmetric(matrix: Matrix) -> Matrix:
    """Symmetric part of a matrix."""
    return 0.5 * (matrix + matrix.T)


def _size(left: Matrix, right: Matrix) -> float:
    """Frobenius norm of |X| |Y|."""
    return frobenius(np.abs(left) @ np.abs(right))
