"""Measure how far every channel of s, u and e reaches, and how evenly."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

BINS = 10
VISITED = 0.001
"""Share of all samples from which a bin counts as visited."""


def coverage(
    values: Mapping[str, Float[np.ndarray, " sample"]],
) -> dict[str, dict[str, float]]:
    """Return range, middle 99.8 % and the share of visited bins of every channel.

    A bin is a tenth of the range; it is visited if it holds 0.1 % of the samples.

    Returns:
        name -> {"low", "high", "low_998", "high_998", "bins_visited"}; a constant
        channel visits no bin.
    """
    covered = {}
    for name, samples in values.items():
        low, high = float(samples.min()), float(samples.max())
        middle = np.quantile(samples, [0.001, 0.999])
        counts = (
            np.histogram(samples, BINS, (low, high))[0]
            if high > low
            else np.zeros(BINS)
        )
        visited = float(np.mean(counts >= max(1.0, VISITED * len(samples))))
        covered[name] = {
            "low": low,
            "high": high,
            "low_998": float(middle[0]),
            "high_998": float(middle[1]),
        }
        covered[name] |= {"bins_visited": visited}
    return covered


def coverage_lines(
    groups: Mapping[str, Mapping[str, Mapping[str, Any]]],
) -> Iterator[str]:
    """Yield the lines of a table of coverage, one per channel."""
    yield (
        f"{'coverage':28}{'lowest':>11}{'highest':>11}{'middle 99.8 %':>24}"
        f"{'tenths visited':>16}"
    )
    for group, rows in groups.items():
        for name, row in rows.items():
            middle = f"{row['low_998']:.4g} … {row['high_998']:.4g}"
            ends = f"{row['low']:11.4g}{row['high']:11.4g}"
            visited = f"{round(10 * row['bins_visited']):>13}/10"
            yield f"{f'{group}: {name}':28}{ends}{middle:>24}{visited}"
