"""Summary statistics with bootstrap intervals over trainings and episodes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

RESAMPLES = 10_000


def bootstrap_mean(
    values: Float[np.ndarray, "*seed episode"], *, seed: int = 0
) -> tuple[float, list[float]]:
    """Return the mean and its 95 % percentile-bootstrap interval.

    With several training seeds, both trainings and episodes are resampled: all
    trainings drive the same episodes, so pooling them would count one good training as
    often as there are episodes.

    Args:
        values: one per episode, or one per training seed and episode.
        seed: of the resampling.

    Source: Owen, The pigeonhole bootstrap, Annals of Applied Statistics 1(2), 2007.
    """
    table = np.atleast_2d(np.asarray(values, dtype=np.float64))
    rng = np.random.default_rng(seed)
    episodes, trainings = (
        rng.integers(0, size, (RESAMPLES, size)) for size in reversed(table.shape)
    )
    draws = table[trainings[:, :, None], episodes[:, None, :]].reshape(RESAMPLES, -1)
    return float(np.mean(table)), [
        float(edge) for edge in np.quantile(np.mean(draws, axis=1), [0.025, 0.975])
    ]


def summary(values: Float[np.ndarray, "*seed episode"]) -> dict[str, object]:
    """Return mean, std, ci95, median and p95 of one number per episode (and seed)."""
    mean, interval = bootstrap_mean(values)
    return {
        "mean": mean,
        "std": float(np.std(values, ddof=1)) if np.size(values) > 1 else None,
        "ci95": interval,
        "median": float(np.median(values)),
        "p95": float(np.quantile(values, 0.95)),
    }


def paired_difference(
    values: Float[np.ndarray, "*seed episode"],
    reference: Float[np.ndarray, "*seed episode"],
) -> dict[str, object]:
    """Return the mean of values − reference over equal episodes, and its interval."""
    mean, interval = bootstrap_mean(np.asarray(values) - np.asarray(reference))
    return {"mean": mean, "ci95": interval}
