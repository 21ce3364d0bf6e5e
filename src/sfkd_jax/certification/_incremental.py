"""The rate at which the flow of a model in continuous time contracts, proved by one linear matrix inequality."""

from __future__ import annotations

import math
import time
from typing import Any

import jax
import numpy as np

from sfkd_jax.certification._attack_all import CertificateContradicted
from sfkd_jax.certification._claims import SERVED
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
    fingerprint,
    one_thread,
    require_finite,
    require_slopes,
    served,
)
from sfkd_jax.types import Incremental, Model, Params

HALVINGS = 40


def claims_a_rate(model: Model, params: Params) -> bool:
    """Whether what can be proved about a model is the rate of its continuous flow."""
    return model.explicit is not None and isinstance(
        jax.eval_shape(model.explicit, params), Incremental
    )


def certify_incremental(
    model: Model, params: Params, *, dt: float, seed: int = 0
) -> dict[str, Any]:
    """Prove how fast solutions of the state equation approach each other under the same inputs, and attack it.

        |s(t) − s'(t)|_P ≤ exp(−γ t) |s(0) − s'(0)|_P   for all inputs, s in scaled units

    It is about the continuous flow: not about its discretisation, and no tube is
    derived from it.

    Args:
        model, params: with `explicit` an `Incremental`; the weights as exported.
        dt: sampling period [s].
        seed: of the attack.

    Returns:
        A document: rate_per_s is γ, alpha exp(−γ dt), attack the rate [1/s] that some
        slopes do not exceed, tightness attack over rate, at least 1.

    Raises:
        CertificationRefused: with the reason. CertificateContradicted: the attack is
            slower than the proved rate.
    """
    began = time.perf_counter()
    weights = served(model, params)
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
        "scope": "the continuous flow, not its discretisation; all states and inputs; no tube is derived from it",
        "alpha": math.exp(-rate * dt),
        "rate_per_s": rate,
        "attack": attack,
        "tightness": attack / rate,
        "metric": weights.metric.tolist(),
        "params_sha256": fingerprint(params),
        "seconds_proof": time.perf_counter() - began,
    }


def incremental_rate(weights: Exported) -> float:
    """The largest rate [1/s] that the model's own metric and multipliers prove, found by halving.

    Args:
        weights: an `Incremental` in float64.

    Raises:
        CertificationRefused: not even a rate next to 0 is proved; the reason is named.
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
        low, high = (
            (middle, high) if check_incremental(weights, middle) else (low, middle)
        )
    if not low > 0.0:
        raise CertificationRefused(
            "the matrix inequality of the incremental rate holds at no rate above 0"
        )
    return low


def check_incremental(weights: Exported, rate: float) -> bool:
    """Whether the metric P and the multipliers Λ prove that the flow contracts at `rate` [1/s]; rounding included.

    For all inputs and every σ applied entry by entry with slopes in [0, 1] it suffices
    that P > 0, Λ > 0 and

        [ −A_0'P − P A_0 − 2γP   −PA − W'Λ ]
        [           ·                2Λ    ]  >  0

    (add 2 δσ'Λ(W δs − δσ) ≥ 0 to the derivative of δs'P δs). It is checked between
    powers of 2 that balance Λ, and with room for the controller's own compilation,
    which may round the same weights differently. False when in doubt.

    Args:
        weights: an `Incremental` in float64.
        rate: γ [1/s].
    """
    P, multipliers = _symmetric(weights.metric), weights.multipliers
    finite = all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(weights))
    if not (
        finite
        and 0 < rate < np.inf
        and np.all(multipliers > 0)
        and is_positive_definite(P)
    ):
        return False
    balance = np.exp2(-np.round(0.5 * np.log2(multipliers)))
    drift, drift_error = product(P, weights.linear)
    forced, forced_error = product(P, weights.outer * balance)
    sensed = (multipliers * balance)[:, None] * weights.inner
    top, coupling = drift + drift.T + 2 * rate * P, forced.T + sensed
    matrix = -np.block(
        [[top, coupling.T], [coupling, -np.diag(2 * multipliers * balance**2)]]
    )
    rounded = (
        2 * _size(P, weights.linear)
        + 2 * _size(P, weights.outer * balance)
        + 2 * frobenius(sensed)
    )
    summed = (
        8 * UNIT * (frobenius(matrix) + 2 * rate * frobenius(P) + rounded)
        + matrix.size * TINY
    )
    error = (SERVED - 1.0) * rounded + 2 * drift_error + 2 * forced_error + summed
    return is_positive_definite(matrix, error)


def attack_growth(weights: Exported, *, starts: int = 24, seed: int = 0) -> float:
    """Largest growth rate [1/s] of |δs|_P found over slopes: λ_max of the symmetric part of A_0 + A D W in the metric.

    It is convex in D, so its maximum is at 0 or 1: with the top direction fixed, the
    slopes are chosen by the sign of their effect, in turn, until nothing grows.

    Args:
        weights: an `Incremental` in float64.
        starts: random beginnings, the first all ones.
        seed: of these.
    """
    random, best = np.random.default_rng(seed), -np.inf
    for start in range(starts):
        share = 1.0 if start == 0 else random.uniform()
        slopes, value = (
            (random.uniform(size=len(weights.multipliers)) < share).astype(float),
            -np.inf,
        )
        after, slopes = _growth(weights, slopes)
        while after > value + 1e-12 * abs(after):
            value = after
            after, slopes = _growth(weights, slopes)
        best = max(best, value, after)
    return best


def _growth(weights: Exported, slopes: Vector) -> tuple[float, Vector]:
    """λ_max for these slopes, and the slopes that raise the growth most along its direction."""
    root = np.linalg.cholesky(_symmetric(weights.metric)).T  # P = R'R
    back = np.linalg.inv(root)
    outer, inner = root @ weights.outer, weights.inner @ back
    moving = root @ weights.linear @ back + outer @ (slopes[:, None] * inner)
    values, directions = np.linalg.eigh(0.5 * (moving + moving.T))
    steepest = directions[:, -1]
    return float(values[-1]), ((steepest @ outer) * (inner @ steepest) > 0).astype(
        float
    )


def _symmetric(matrix: Matrix) -> Matrix:
    """What a quadratic form sees of a matrix."""
    return 0.5 * (matrix + matrix.T)


def _size(left: Matrix, right: Matrix) -> float:
    """How large a product is if nothing cancels."""
    return frobenius(np.abs(left) @ np.abs(right))
