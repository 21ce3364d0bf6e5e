"""The sections on training and prediction, with their figures."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sfkd_jax.evaluation.formats import dig, is_number
from sfkd_jax.reporting import style
from sfkd_jax.reporting._summary import command
from sfkd_jax.reporting.blocks import Block, Heading, Text, missing, picture
from sfkd_jax.reporting.run import Run
from sfkd_jax.reporting.tables import baseline_table, open_loop_table
from sfkd_jax.reporting.texts import text


def predicting(run: Run) -> list[Block]:
    """Prediction errors without feedback, by step ahead."""
    heading, errors = Heading(2, "How it predicts"), run.errors
    if errors is None or not dig(errors, "steps"):
        return [heading, *missing("open_loop.json", command("train", run.settings))]
    caption, note = text("model.open_loop"), text("model.trajectories", errors)
    figure = picture(run.figures, "open_loop", caption, open_loop, errors)
    baselines = baseline_table(errors)
    beside = [Heading(3, text("model.beside")), baselines] if baselines else []
    words = Text(note, kind="note")
    return [heading, figure, open_loop_table(errors), words, *beside]


def training(run: Run) -> list[Block]:
    """Learning curves."""
    heading, caption = Heading(2, "How it was trained"), text("model.learning")
    if not run.log:
        return [heading, *missing("metrics.jsonl", command("train", run.settings))]
    return [heading, picture(run.figures, "learning", caption, learning, run.log)]


def learning(lines: list[dict[str, Any]]) -> Figure:
    """Loss on a logarithmic scale, and α where it was logged, by optimisation step."""
    loss, validation, alpha = (
        _column(lines, key) for key in ("loss", "validation_loss", "alpha")
    )
    ratios = [3, 1] if alpha.shape[1] > 1 else [3]
    figure = style.canvas(4.3 if ratios[1:] else 3.3)
    grid = {"sharex": True, "squeeze": False, "height_ratios": ratios}
    panels = figure.subplots(len(ratios), 1, **grid)[:, 0]
    panels[0].plot(*loss, color="#9dbbe3", linewidth=1.1, label="training")
    look = {"color": style.ACCENT, "marker": "o", "markersize": 3.5}
    panels[0].plot(*validation, label="validation", **look)
    panels[0].set(yscale="log", ylabel="loss [-]", title="Learning curves")
    panels[0].legend(loc="upper right", ncols=2)
    if ratios[1:]:
        panels[1].plot(*alpha, color=style.THIRD)
        panels[1].set(ylabel="α [-]")
        panels[1].yaxis.set_major_locator(MaxNLocator(nbins=3))
    panels[-1].set(xlabel="optimisation step")
    figure.align_ylabels()
    return figure


def _column(lines: list[dict[str, Any]], key: str) -> np.ndarray:
    """The steps and finite values of one logged quantity, (2, count)."""
    known = [row for row in lines if "step" in row]
    pairs = [(r["step"], r[key]) for r in known if isinstance(r.get(key), int | float)]
    values = np.array(pairs, dtype=float).reshape(-1, 2).T
    return values[:, np.isfinite(values).all(axis=0)]


def open_loop(errors: dict[str, Any]) -> Figure:
    """Prediction error without feedback by time ahead: position, yaw and speed."""
    figure = style.canvas(3.4)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.45, 1])
    parts = grid[:, 0], grid[0, 1], grid[1, 1]
    position, yaw, speed = panels = [figure.add_subplot(part) for part in parts]
    known = is_number(errors.get("dt"))
    ahead = np.asarray(errors["steps"], dtype=float) * (errors["dt"] if known else 1.0)
    for axes, key, name, colour in (
        (position, "position_rmse_m", "position", style.ACCENT),
        (position, "longitudinal_rmse_m", "along", style.SECOND),
        (position, "lateral_rmse_m", "across", style.THIRD),
        (yaw, "yaw_rmse_rad", "yaw", style.ACCENT),
        (speed, "speed_rmse_m_per_s", "speed", style.ACCENT),
    ):
        axes.plot(ahead, numbers(errors.get(key), len(ahead)), color=colour, label=name)
    position.legend(loc="upper left")
    names = "position RMSE [m]", "yaw [rad]", "speed [m/s]"
    for axes, name in zip(panels, names, strict=True):
        axes.set(ylabel=name, xlim=(0, ahead[-1]))
        axes.set_ylim(bottom=0.0)
    unit = "seconds ahead" if known else "steps ahead"
    position.set(xlabel=unit, title="Prediction error without feedback")
    yaw.tick_params(labelbottom=False)
    speed.set(xlabel=unit)
    figure.align_ylabels(panels[1:])
    return figure


def numbers(values: Any, count: int) -> Float[np.ndarray, " count"]:
    """A list from JSON as `count` floats, with NaN for null and for what is absent."""
    row = [float("nan") if value is None else float(value) for value in values or []]
    return np.array((row + [float("nan")] * count)[:count], dtype=float)
