"""Proposers: they look for the smallest bound that the trusted core will accept, and are never believed themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfkd_jax.certification._core import Matrix, check_witness, norm_upper, witness_matrix

SCALES = np.geomspace(0.25, 4.0, 33)
SLACKS = (1e-9, 1e-7, 1e-5, 1e-3)


def lipschitz_upper(weights: Sequence[Matrix], multipliers: Sequence[np.ndarray]) -> float:
    """The smallest Lipschitz bound that the multipliers, scaled as a whole, prove; infinity if they prove none.

    Args:
        weights: W_1 … W_L of a network with slopes in [0, 1]. multipliers: λ_1 … λ_{L-1}, as proposed by the model.
    """
    if len(multipliers) != len(weights) - 1:
        return float("inf")
    if not multipliers:
        return norm_upper(weights[0])
    best = float("inf")
    for scale in SCALES:
        scaled = [scale * np.asarray(part) for part in multipliers]
        guess = _schur_bound(weights, scaled)
        for slack in SLACKS:
            bound = guess * (1 + slack)
            if bound >= best or not np.isfinite(bound):
                break
            if check_witness(weights, scaled, bound):
                best = bound
                break
    return best


def _schur_bound(weights: Sequence[Matrix], multipliers: Sequence[np.ndarray]) -> float:
    """√λ_max(W_1'Λ_1 S⁻¹ Λ_1 W_1), S the lower block of the witness matrix; not rigorous."""
    matrix, _ = witness_matrix(weights, multipliers)
    inputs = weights[0].shape[1]
    lower, coupling = matrix[inputs:, inputs:], matrix[inputs:, :inputs]
    try:
        factor = np.linalg.cholesky(lower)
        half = np.linalg.solve(factor, coupling)
        return float(np.linalg.norm(half, 2))
    except np.linalg.LinAlgError:
        return float("inf")
