"""Where the search for a metric of an output may start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from sfkd_jax.certification._core import Matrix, Vector
from sfkd_jax.certification._weights import Exported

TINY = 1e-12
"""Smallest multiplier of a start, whose logarithm the search moves."""
ProvedMetric: TypeAlias = tuple[Matrix, Sequence[Sequence[Any]]]
"""A metric, and the multipliers of every vertex that prove contraction in it."""


def starts(weights: Exported, proved: Sequence[ProvedMetric]) -> list[Vector]:
    """Return where the search for a metric may start, see `propose_metric`.

    The variables are the lower triangle of L, then log λ of every vertex.
    """
    vertices = weights.operators.vertices
    rank = vertices.shape[-1]
    lower = np.tril_indices(rank)
    candidates = []
    usual = [weights.residual_multipliers] * len(vertices)
    others = [(metric, usual) for metric, _ in proved]
    for metric, joint in ((np.eye(rank), usual), *others):
        # Scaled to the trace of I, so that all starts have entries of the same size.
        factor = np.linalg.cholesky(metric * (rank / np.trace(metric)))
        candidates.append(np.concatenate([factor[lower], *map(_logs, joint)]))
    for metric, joint in proved:
        # Multipliers scale with P.
        share = rank / np.trace(metric)
        factor = np.linalg.cholesky(share * metric)
        logs = [np.log(share) + _logs(of_vertex) for of_vertex in joint]
        candidates.append(np.concatenate([factor[lower], *logs]))
    return candidates


def _logs(multipliers: Sequence[Any]) -> Vector:
    """Return logarithms of multipliers, over which the search keeps them positive."""
    return np.log(np.maximum(np.concatenate([*multipliers, []]), TINY))
