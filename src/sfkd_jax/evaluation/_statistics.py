"""Summaries with intervals: bootstrap over episodes, paired where two systems drove the same ones."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

RESAMPLES = 10_000


def bootstrap_mean(values: Float[np.ndarray, " episode"], *, seed: int = 0) -> tuple[float, list[float]]:
    """Mean and its 95 % percentile-bootstrap interval."""
    values = np.asarray(values, dtype=np.float64)
    draws = np.random.default_rng(seed).integers(0, len(values), (RESAMPLES, len(values)))
    means = np.mean(values[draws], axis=1)
    return float(np.mean(values)), [float(edge) for edge in np.quantile(means, [0.025, 0.975])]


def summary(values: Float[np.ndarray, " episode"]) -> dict[str, object]:
    """mean, std, ci95, median, p95 of one number per episode."""
    mean, interval = bootstrap_mean(values)
    return {
        "mean": mean,
        "std": float(np.std(values, ddof=1)) if len(values) > 1 else None,
        "ci95": interval,
        "median": float(np.median(values)),
        "p95": float(np.quantile(values, 0.95)),
    }


def paired_difference(
    values: Float[np.ndarray, " episode"], reference: Float[np.ndarray, " episode"]
) -> dict[str, object]:
    """Mean of values − reference over the same episodes, with its interval."""
    mean, interval = bootstrap_mean(np.asarray(values) - np.asarray(reference))
    return {"mean": mean, "ci95": interval}
