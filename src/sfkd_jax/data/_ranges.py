"""Check the excitation of controls, and the ranges of controls and environments."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from sfkd_jax.data._checks import Finding, more
from sfkd_jax.data._logs import Columns, Log

Bounds: TypeAlias = tuple[tuple[float, ...] | None, tuple[float, ...] | None]
"""Lowest and highest of every channel, or None where there is no bound."""
ROUNDED = 1e-5
"""How far outside its range a channel may be: float32 rounds."""


def check_ranges(
    logs: list[Log], columns: Columns, *, limits: Bounds, box: Bounds
) -> Iterator[Finding]:
    """Refuse constant controls and environments outside E; warn of the rest.

    Warnings are of poor excitation and of controls outside their limits.

    Args:
        logs: all drives.
        columns: their names.
        limits: of the controls.
        box: E.
    """
    where = span(logs)
    for k, name in enumerate(columns.control):
        values = np.concatenate([log.controls[:, k] for log in logs])
        kinds = len(np.unique(values))
        if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
            yield Finding(
                f"{where}: {name} is always {values[0]:.4g}; "
                "without excitation nothing can be learned of it"
            )
        elif kinds < 5:
            yield Finding(
                f"{where}: {name} takes only {kinds} values; vary it more",
                refused=False,
            )
    if limits[0] and limits[1]:
        yield from _outside(
            logs,
            columns.control,
            "controls",
            (limits[0], limits[1]),
            "vehicle.control",
            refused=False,
        )
    low, high = box
    if low is None and high is None:
        return
    size = logs[0].envs.shape[1]
    if (
        low is None
        or high is None
        or {len(low), len(high)} != {size}
        or np.any(np.greater(low, high))
    ):
        yield Finding(
            f"environment.low and environment.high must be {size} numbers each, "
            "the low ones not above the high"
        )
        return
    names = (
        columns.environment
        if len(columns.environment) == size
        else ("environment",) * size
    )
    yield from _outside(logs, names, "envs", (low, high), "dataset.env", refused=True)


def span(logs: list[Log]) -> str:
    """Return the position of several drives, for messages."""
    return logs[0].whole + (
        f" and {len(logs) - 1} drives more" if len(logs) > 1 else ""
    )


def _outside(
    logs: list[Log],
    names: tuple[str, ...],
    field: str,
    bounds: tuple[tuple[float, ...], tuple[float, ...]],
    setting: str,
    *,
    refused: bool,
) -> Iterator[Finding]:
    """Report the first row of every channel that is outside its range."""
    for k, (name, low, high) in enumerate(zip(names, *bounds, strict=True)):
        for log in logs:
            values: Float[np.ndarray, " time"] = getattr(log, field)[:, k]
            slack = ROUNDED * max(1.0, abs(low), abs(high))
            outside = (values < low - slack) | (values > high + slack)
            if outside.any():
                first = int(outside.argmax())
                yield Finding(
                    f"{log.at(first)}: {name} is {values[first]:.4g}, outside "
                    f"{low:g} to {high:g} of {setting}_low and {setting}_high"
                    f"{more(outside)}",
                    refused,
                )
                break
