"""Figures of what was driven: deviation, all episodes, steering; each from a Scene to a matplotlib Figure."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfkd_jax.reporting._conditions import conditions, mark
from sfkd_jax.reporting._scene import Scene, hardest_step, switches
from sfkd_jax.reporting._style import (
    MUTED,
    PLATE,
    canvas,
    legend,
    line,
    literal,
    ordered,
    principal,
)


def deviation(scene: Scene, seconds: float = 15.0) -> Figure:
    """Signed lateral deviation through the first switches of the first episode, above friction and wind."""
    figure = canvas(5.2)
    top, friction, wind = figure.subplots(3, 1, sharex=True, height_ratios=[5, 1, 1])
    length = max(values.shape[1] for values in scene.lateral.values())
    end = min(seconds, length * scene.dt)
    last = round(end / scene.dt)
    top.axhline(0.0, color="#9aa1ab", linewidth=0.8)
    for system in ordered(scene.lateral):
        values = scene.lateral[system][0, :last]
        top.plot(scene.dt * np.arange(1, len(values) + 1), values, **line(system))
    top.set(
        ylabel="lateral deviation [m]",
        xlim=(0.0, end),
        title=f"{literal(scene.label)}, first episode: deviation from the path",
    )
    low, high = top.get_ylim()
    top.set_ylim(low, high + 0.2 * (high - low))
    changes = [step for step in switches(scene.envs) if step < last]
    for axes in (top, friction, wind):
        mark(axes, changes, scene.dt)
    if scene.envs is None:
        friction.set_visible(False)
        wind.set_visible(False)
        top.set_xlabel("time [s]")
        top.tick_params(labelbottom=True)
    else:
        _label_conditions(top, scene.envs[:last], changes, scene.dt)
        conditions(friction, wind, scene.envs[:last], scene.dt)
    wind.set(xlabel="time [s]")
    figure.align_ylabels()
    legend(figure, top)
    return figure


def _label_conditions(
    axes: Any, envs: np.ndarray, changes: list[int], dt: float
) -> None:
    """Name (μ, w) above each stretch between two switches, as long as the names fit."""
    edges = [0, *changes, len(envs)]
    if len(edges) > 8:
        return
    for start, stop in pairwise(edges):
        stretch = envs[start:stop]
        steady = np.ptp(stretch[:, 1]) < 1e-3
        wind = f"w {stretch[0, 1]:+.2g} m/s".replace("-", "−") if steady else "gusts"
        text = f"μ {stretch[0, 0]:.2g}\n{wind if not steady or abs(stretch[0, 1]) > 1e-3 else 'no wind'}"
        axes.text(
            (start + stop) / 2 * dt, 0.985, text, transform=axes.get_xaxis_transform(),
            ha="center", va="top", fontsize=8.5, color="#57606a", linespacing=1.25, bbox=PLATE,
        )  # fmt: skip


def spread(scene: Scene) -> Figure:
    """|deviation| over the whole duration: median of every system, 5-95 % band of the principal ones."""
    figure = canvas(3.5)
    axes = figure.subplots()
    systems = ordered(scene.lateral)
    banded = principal(systems)
    for system in systems:
        values = np.where(
            np.isfinite(scene.lateral[system]), np.abs(scene.lateral[system]), np.inf
        )
        time = scene.dt * np.arange(1, values.shape[1] + 1)
        low, middle, high = np.quantile(
            values, [0.05, 0.5, 0.95], axis=0, method="nearest"
        )
        style = line(system)
        axes.plot(time, middle, **style | {"linewidth": 0.75 * style["linewidth"]})
        if system in banded:
            axes.fill_between(
                time,
                low,
                np.minimum(high, 1e6),
                color=style["color"],
                alpha=0.2,
                linewidth=0,
            )
    for step in switches(scene.envs):
        axes.axvline(
            step * scene.dt,
            color=MUTED,
            linestyle=(0, (4, 3)),
            linewidth=0.5,
            alpha=0.5,
            zorder=1,
        )
    count = max(values.shape[0] for values in scene.lateral.values())
    title = f"{literal(scene.label)}: " + (
        "the one episode"
        if count == 1
        else f"median and 5–95 % band of {count} episodes"
    )
    axes.set(
        xlabel="time [s]",
        ylabel="|lateral deviation| [m]",
        title=title,
        xlim=(0, time[-1]),
    )
    axes.set_ylim(bottom=0.0)
    axes.grid(visible=False, axis="x")
    legend(figure, axes)
    return figure


def steering(scene: Scene, seconds: float = 10.0) -> Figure:
    """Steering commands around the hardest moment of the first episode, of at most four systems."""
    figure = canvas(3.3)
    axes = figure.subplots()
    steps = max(len(values) for values in scene.controls.values())
    span = min(round(seconds / scene.dt), steps)
    start = int(np.clip(hardest_step(scene) - span // 2, 0, steps - span))
    start -= start % max(1, round(1.0 / scene.dt))
    systems = (
        ordered(scene.controls)
        if len(scene.controls) <= 4
        else principal(scene.controls)
    )
    for system in systems:
        values = scene.controls[system][start : start + span, 0]
        axes.plot(
            scene.dt * (start + np.arange(len(values))),
            values,
            drawstyle="steps-post",
            **line(system),
        )
    for step in switches(scene.envs):
        if start < step < start + span:
            axes.axvline(
                step * scene.dt,
                color=MUTED,
                linestyle=(0, (4, 3)),
                linewidth=0.9,
                zorder=1,
            )
    limits = (start * scene.dt, (start + span) * scene.dt)
    axes.set(xlabel="time [s]", ylabel="steering command [rad]", xlim=limits)
    axes.set_title(
        f"{literal(scene.label)}, first episode: steering around the hardest moment"
    )
    axes.grid(visible=False, axis="x")
    legend(figure, axes)
    return figure
