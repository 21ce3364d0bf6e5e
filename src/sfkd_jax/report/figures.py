"""The figures of all pages; units stand on the axes, titles say what is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from sfkd_jax.driving.simulation.metrics import LANE_HALF_WIDTH, Row
from sfkd_jax.evaluation.formats import dig, is_number
from sfkd_jax.report import style
from sfkd_jax.report.episodes import Episodes
from sfkd_jax.report.tables import name_of

_ALWAYS = ("sfkd", "oracle")
"""Systems whose errors are always inside the frame."""
_FEW = (*_ALWAYS, "nominal", "koopman_mpc", "neural_ode", "icode_mppi")
"""Systems that are drawn if there are more of them."""


def first_episode(
    group: list[Episodes], corridor: float | None = None, seconds: float = 15.0
) -> Figure:
    """Draw lateral errors on one road over time, and friction and wind below them.

    Args:
        group: of episodes on one road.
        corridor: half width of the certified corridor [m], or None.
        seconds: how much of the episode is drawn [s].
    """
    first = group[0]
    envs = first.envs
    # Many lines in one panel hide each other.
    if len(group) > len(_FEW):
        group = [episodes for episodes in group if episodes.system in _FEW] or group
    # As long as the shortest run: all lines end at the same time.
    lengths = [episodes.lateral.shape[1] for episodes in group]
    last = min(round(seconds / first.dt), *lengths)
    heights = [2.4]
    if envs is not None:
        heights += [0.7, 0.7]
    figure = style.canvas(0.8 + sum(heights))
    panels = figure.subplots(len(heights), height_ratios=heights, squeeze=False)
    axes = [*panels[:, 0]]
    axes[0].set_title("Lateral error in the first episode")
    _draw_errors(axes[0], group, last, corridor)
    if envs is not None:
        _draw_conditions(axes[1:], first.env_names, envs[:last], first.dt)
    for panel in axes:
        panel.set(xlim=(0.0, last * first.dt))
        panel.grid(visible=False, axis="x")
        panel.tick_params(labelbottom=panel is axes[-1])
        for step in first.switches:
            panel.axvline(step * first.dt, **style.SWITCH)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    return figure


def _draw_conditions(
    panels: list[Any], names: list[str], envs: Float[np.ndarray, "time 2"], dt: float
) -> None:
    """Draw friction and wind, or what e is, over time, each on its own axes."""
    time = dt * np.arange(len(envs) + 1)
    for axes, values, name in zip(panels, envs.T, names, strict=False):
        axes.set_ylabel(name.replace(" [", "\n["))
        fill = {"baseline": 0.0, "fill": True, "color": "#b9c6d6", "linewidth": 0.0}
        axes.stairs(values, time, **fill)
        axes.stairs(values, time, baseline=None, color="#4a5a6d", linewidth=1.1)
    friction, wind = panels
    top = max(1.0, 1.05 * float(np.max(envs[:, 0])))
    friction.set(ylim=(0.0, top), yticks=[0.0, 0.5, 1.0])
    peak = max(1.0, float(np.max(np.abs(envs[:, 1]))))
    wind.set(ylim=(-1.15 * peak, 1.15 * peak))
    wind.yaxis.set_major_locator(MaxNLocator(nbins=2, symmetric=True))


def _draw_errors(
    axes: Any, members: list[Episodes], last: int, corridor: float | None
) -> None:
    """Draw the lateral errors of the first steps over time."""
    axes.axhline(0.0, color=style.AXIS, linewidth=0.8)
    peaks = []
    # The frame shows these levels whatever the others are.
    always = [1e-3, corridor or 0.0]
    for episodes in members:
        values = episodes.lateral[0, :last]
        time = episodes.dt * np.arange(1, len(values) + 1)
        axes.plot(time, values, **style.line(episodes.system, episodes.name))
        peak = float(np.nanmax(np.abs(values), initial=0.0))
        peaks.append(peak)
        if episodes.system in _ALWAYS:
            always.append(peak)
    if corridor:
        style.draw_corridor(axes, corridor)
    # Of the others a bad one may leave the frame, lest it flatten the rest.
    most = 3 * corridor if corridor else LANE_HALF_WIDTH
    # A quantile of the peaks, so that one bad run does not set the scale.
    most = min(float(np.quantile(peaks, 0.85, method="higher")), most)
    # Room for the corridor's name below its edge.
    reach = 1.3 * max(most, *always)
    axes.set(ylim=(-reach, reach), ylabel="lateral error [m]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.8)


def open_loop(errors: dict[str, Any], radii: list[Any]) -> Figure:
    """Draw the position RMSE of prediction without feedback by time ahead.

    Args:
        errors: content of open_loop.json.
        radii: of the certified position tube [m] by step; [] if there is none.
    """
    figure = style.canvas(3.2)
    axes = figure.subplots()
    period_is_known = is_number(errors.get("dt"))
    period = errors["dt"] if period_is_known else 1.0
    ahead = period * np.asarray(errors["steps"], float)
    key = "position_rmse_m"
    curves = {"model": errors.get(key), "certified tube": radii}
    for name, record in (errors.get("baselines") or {}).items():
        curves[name.replace("_", " ")] = dig(record, key)
    colours = (style.ACCENT, style.DARK, "#d55e00", style.THIRD)
    dashes = ("-", ":", "--", "-.")
    looks = zip(curves.items(), colours, dashes, strict=False)
    for (name, values), color, dash in looks:
        if values:
            # As floats, null is NaN: a gap in the curve.
            numbers = np.asarray(values, float)
            axes.plot(ahead, numbers, label=name, color=color, linestyle=dash)
    axes.set(ylabel="error of position [m]", xlim=(0, ahead[-1]))
    axes.set_xlabel("time ahead [s]" if period_is_known else "steps ahead")
    _plain_log(axes.yaxis, axes.set_yscale)
    style.legend(figure, axes)
    return figure


def learning(lines: list[dict[str, Any]]) -> Figure:
    """Draw the loss by optimisation step, on training and on validation windows."""
    figure = style.canvas(2.8)
    axes = figure.subplots()
    for name, color in (("loss", style.SECOND), ("validation_loss", style.ACCENT)):
        known = [line for line in lines if is_number(line.get(name)) and "step" in line]
        pairs = np.array([(line["step"], line[name]) for line in known]).reshape(-1, 2)
        axes.plot(*pairs.T, label=name.replace("_", " "), color=color, marker=".")
    axes.set(yscale="log", xlabel="optimisation step", ylabel="loss [-]")
    axes.legend(ncols=2)
    return figure


def side_forces(rows: list[Row]) -> Figure:
    """Draw the RMSE of every system under unmeasured side forces.

    Larger dots are larger forces.
    """
    figure = style.canvas(1.3 + 0.24 * len(rows))
    axes = figure.subplots()
    size_of: dict[float, float] = {}
    for height, row in enumerate(rows):
        runs = [
            run for run in row["disturbed"] if is_number(dig(run, "rmse_m", "mean"))
        ]
        errors = [1e3 * run["rmse_m"]["mean"] for run in runs]
        color = style.line(str(row.get("system")))["color"]
        axes.plot(errors, [height] * len(runs), color=color, linewidth=1.6, alpha=0.5)
        for run, error in zip(runs, errors, strict=True):
            force = run["force_n"]
            size_of[force] = 10.0 + 0.07 * force
            axes.scatter(error, height, size_of[force], color=color, zorder=3)
    for force, size in sorted(size_of.items()):
        axes.scatter([], [], size, color=style.MUTED, label=f"{force:g} N")
    axes.set_xlabel("lateral RMSE [mm]")
    _plain_log(axes.xaxis, axes.set_xscale)
    names = [style.literal(name_of(row)) for row in rows]
    axes.set_yticks(range(len(names)), names)
    # The first row is above the others.
    axes.set_ylim(len(names) - 0.4, -0.6)
    style.legend(figure, axes, title="largest side force that nobody measures")
    return figure


def _plain_log(axis: Any, set_scale: Any) -> None:
    """Make an axis logarithmic, with plain numbers at few ticks."""
    set_scale("log")
    low, high = axis.get_view_interval()
    ticks_per_decade = (1, 2, 5) if high < 50 * low else (1,)
    axis.set_major_locator(LogLocator(subs=ticks_per_decade))
    axis.set_major_formatter(FuncFormatter(_plain_number))
    axis.set_minor_formatter(NullFormatter())


def _plain_number(value: float, position: int | None) -> str:
    """Return the label of a tick, without an exponent."""
    return f"{value:g}"
