"""Friction and wind under a figure, and where they switch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.ticker import MaxNLocator

from sfkd_jax.reporting._style import MUTED


def conditions(
    friction: Any, wind: Any, envs: Float[np.ndarray, "time 2"], dt: float
) -> None:
    """Draw what they are on two axes that share a figure's time."""
    time = dt * np.arange(len(envs) + 1)
    for axes, column, name in (
        (friction, 0, "friction\nμ [-]"),
        (wind, 1, "wind\n[m/s]"),
    ):
        axes.stairs(
            envs[:, column],
            time,
            baseline=0.0,
            fill=True,
            color="#b9c6d6",
            linewidth=0.0,
        )
        axes.stairs(
            envs[:, column], time, baseline=None, color="#4a5a6d", linewidth=1.1
        )
        axes.set_ylabel(name)
    friction.set(ylim=(0.0, 1.0), yticks=[0.0, 0.5, 1.0])
    peak = max(1.0, float(np.max(np.abs(envs[:, 1]))))
    wind.set(ylim=(-1.15 * peak, 1.15 * peak))
    wind.yaxis.set_major_locator(MaxNLocator(nbins=2, symmetric=True))


def mark(axes: Any, changes: Iterable[int], dt: float) -> None:
    """Dashed lines at steps where something switches, and no other vertical ones."""
    axes.grid(visible=False, axis="x")
    for step in changes:
        axes.axvline(
            step * dt, color=MUTED, linestyle=(0, (4, 3)), linewidth=0.9, zorder=1
        )
