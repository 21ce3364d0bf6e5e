"""Figures of the model: learning curves and open-loop error; from JSON to matplotlib Figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sfkd_jax.reporting._numbers import is_number
from sfkd_jax.reporting._style import ACCENT, SECOND, THIRD, canvas


def learning(lines: list[dict[str, Any]]) -> Figure:
    """Training and validation loss (log scale), and α where the run logged it, by optimisation step."""
    rows = {key: _column(lines, key) for key in ("loss", "validation_loss", "alpha")}
    certified = rows["alpha"].shape[1] > 1
    figure = canvas(4.3 if certified else 3.3)
    panels = figure.subplots(
        1 + certified,
        1,
        sharex=True,
        squeeze=False,
        height_ratios=[3, 1][: 1 + certified],
    )[:, 0]
    panels[0].plot(*rows["loss"], color="#9dbbe3", linewidth=1.1, label="training")
    panels[0].plot(
        *rows["validation_loss"],
        color=ACCENT,
        marker="o",
        markersize=3.5,
        label="validation",
    )
    panels[0].set(yscale="log", ylabel="loss [-]", title="Learning curves")
    panels[0].legend(loc="upper right", ncols=2)
    if certified:
        panels[1].plot(*rows["alpha"], color=THIRD)
        panels[1].set(ylabel="α [-]")
        panels[1].yaxis.set_major_locator(MaxNLocator(nbins=3))
    panels[-1].set(xlabel="optimisation step")
    figure.align_ylabels()
    return figure


def _column(lines: list[dict[str, Any]], key: str) -> np.ndarray:
    """The steps and finite values of one logged quantity, (2, count)."""
    pairs = [
        (row["step"], row[key])
        for row in lines
        if isinstance(row.get(key), int | float) and "step" in row
    ]
    values = np.array(pairs, dtype=float).reshape(-1, 2).T
    return values[:, np.isfinite(values).all(axis=0)]


def open_loop(errors: dict[str, Any]) -> Figure:
    """Prediction error without feedback, by how far ahead the model looks."""
    figure = canvas(3.4)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.45, 1])
    panels = [
        figure.add_subplot(grid[:, 0]),
        figure.add_subplot(grid[0, 1]),
        figure.add_subplot(grid[1, 1]),
    ]
    known = is_number(errors.get("dt"))
    ahead = np.asarray(errors["steps"], dtype=float) * (errors["dt"] if known else 1.0)
    parts = (
        ("position_rmse_m", "position", ACCENT),
        ("longitudinal_rmse_m", "along", SECOND),
    )
    for key, name, colour in (*parts, ("lateral_rmse_m", "across", THIRD)):
        panels[0].plot(
            ahead, numbers(errors.get(key), len(ahead)), color=colour, label=name
        )
    unit = "seconds ahead" if known else "steps ahead"
    panels[0].legend(loc="upper left")
    panels[1].plot(ahead, numbers(errors.get("yaw_rmse_rad"), len(ahead)), color=ACCENT)
    panels[2].plot(
        ahead, numbers(errors.get("speed_rmse_m_per_s"), len(ahead)), color=ACCENT
    )
    for axes, name in zip(
        panels, ("position RMSE [m]", "yaw [rad]", "speed [m/s]"), strict=True
    ):
        axes.set(ylabel=name, xlim=(0, ahead[-1]))
        axes.set_ylim(bottom=0.0)
    panels[0].set(xlabel=unit, title="Prediction error without feedback")
    panels[1].tick_params(labelbottom=False)
    panels[2].set(xlabel=unit)
    figure.align_ylabels(panels[1:])
    return figure


def numbers(values: Any, count: int) -> np.ndarray:
    """A list from JSON as floats, null as NaN, of the length asked for."""
    row = [float("nan") if value is None else float(value) for value in values or []]
    return np.array((row + [float("nan")] * count)[:count], dtype=float)
