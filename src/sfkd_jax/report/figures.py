"""The figures of all pages; units stand on the axes, titles say what is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from sfkd_jax.evaluation.formats import dig, is_number
from sfkd_jax.evaluation.metrics import LANE_HALF_WIDTH, Row
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
    """Lateral errors on one road over time [s], and friction and wind below them."""
    first, envs = group[0], group[0].envs
    # Many lines in one panel hide each other.
    if len(group) > len(_FEW):
        group = [one for one in group if one.system in _FEW] or group
    # As long as the shortest run: all lines end at the same time.
    last = min(round(seconds / first.dt), *(one.lateral.shape[1] for one in group))
    heights = [2.4] + [0.7, 0.7] * (envs is not None)
    figure = style.canvas(0.8 + sum(heights))
    axes = [*figure.subplots(len(heights), height_ratios=heights, squeeze=False)[:, 0]]
    axes[0].set_title("Lateral error in the first episode")
    _draw_errors(axes[0], group, last, corridor)
    if envs is not None:
        _draw_conditions(axes[1], axes[2], envs[:last], first.dt)
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
    friction: Any, wind: Any, envs: Float[np.ndarray, "time 2"], dt: float
) -> None:
    """Draw friction and wind over time, each on its own axes."""
    time = dt * np.arange(len(envs) + 1)
    for axes, values in zip((friction, wind), envs.T, strict=True):
        fill = {"baseline": 0.0, "fill": True, "color": "#b9c6d6", "linewidth": 0.0}
        axes.stairs(values, time, **fill)
        axes.stairs(values, time, baseline=None, color="#4a5a6d", linewidth=1.1)
    friction.set(ylim=(0.0, 1.0), yticks=[0.0, 0.5, 1.0], ylabel="friction\n[-]")
    peak = max(1.0, float(np.max(np.abs(envs[:, 1]))))
    wind.set(ylim=(-1.15 * peak, 1.15 * peak), ylabel="side wind\n[m/s]")
    wind.yaxis.set_major_locator(MaxNLocator(nbins=2, symmetric=True))


def _draw_errors(
    axes: Any, members: list[Episodes], last: int, corridor: float | None
) -> None:
    """Lateral error over time."""
    axes.axhline(0.0, color=style.AXIS, linewidth=0.8)
    peaks, always = [], [1e-3, corridor or 0.0]
    for one in members:
        values = one.lateral[0, :last]
        time = one.dt * np.arange(1, len(values) + 1)
        axes.plot(time, values, **style.line(one.system, one.name))
        peaks.append(float(np.nanmax(np.abs(values), initial=0.0)))
        always += peaks[-1:] if one.system in _ALWAYS else []
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
    """Position RMSE of prediction without feedback by time ahead.

    `radii` are those of the certified position tube [m] by step, if there is one.
    """
    figure = style.canvas(3.2)
    axes = figure.subplots()
    known = is_number(errors.get("dt"))
    ahead = np.asarray(errors["steps"], float) * (errors["dt"] if known else 1.0)
    key = "position_rmse_m"
    curves = {"model": errors.get(key), "certified tube": radii}
    for name, record in (errors.get("baselines") or {}).items():
        curves[name.replace("_", " ")] = dig(record, key)
    colours = style.ACCENT, style.DARK, "#d55e00", style.THIRD
    looks = zip(curves.items(), colours, ("-", ":", "--", "-."), strict=False)
    for (name, values), color, dash in looks:
        if values:
            # As floats, null is NaN: a gap in the curve.
            look: Any = {"label": name, "color": color, "linestyle": dash}
            axes.plot(ahead, np.asarray(values, float), **look)
    axes.set(ylabel="error of position [m]", xlim=(0, ahead[-1]))
    axes.set_xlabel("time ahead [s]" if known else "steps ahead")
    _plain_log(axes.yaxis, axes.set_yscale)
    style.legend(figure, axes)
    return figure


def learning(lines: list[dict[str, Any]]) -> Figure:
    """Loss by optimisation step, on training windows and on validation runs."""
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
    """RMSE of every system under unmeasured side forces; larger dots: larger forces."""
    figure = style.canvas(1.3 + 0.24 * len(rows))
    axes, forces = figure.subplots(), {}
    for height, row in enumerate(rows):
        runs = [
            one for one in row["disturbed"] if is_number(dig(one, "rmse_m", "mean"))
        ]
        errors = [1e3 * one["rmse_m"]["mean"] for one in runs]
        color = style.line(str(row.get("system")))["color"]
        axes.plot(errors, [height] * len(runs), color=color, linewidth=1.6, alpha=0.5)
        for one, error in zip(runs, errors, strict=True):
            force = one["force_n"]
            forces[force] = size = 10.0 + 0.07 * force
            axes.scatter(error, height, size, color=color, zorder=3)
    for force, size in sorted(forces.items()):
        axes.scatter([], [], size, color=style.MUTED, label=f"{force:g} N")
    axes.set_xlabel("lateral RMSE [mm]")
    _plain_log(axes.xaxis, axes.set_xscale)
    names = [style.literal(name_of(row)) for row in rows]
    axes.set_yticks(range(len(names)), names)
    # The first above.
    axes.set_ylim(len(names) - 0.4, -0.6)
    style.legend(figure, axes, title="largest side force that nobody measures")
    return figure


def _plain_log(axis: Any, set_scale: Any) -> None:
    """Make an axis logarithmic, with plain numbers at few ticks."""
    set_scale("log")
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 50 * low else (1,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
