"""The section on closed-loop episodes: scores, figures, planner and violations."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfkd_jax.evaluation.formats import dig, is_number
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.reporting import style
from sfkd_jax.reporting._summary import command
from sfkd_jax.reporting._track import EXAGGERATION, track
from sfkd_jax.reporting.blocks import Block, Heading, Text, missing, picture
from sfkd_jax.reporting.rows import group_title
from sfkd_jax.reporting.run import Run
from sfkd_jax.reporting.scene import Scene, hardest_step, switches
from sfkd_jax.reporting.tables import metric_table
from sfkd_jax.reporting.texts import text


def driving(run: Run) -> list[Block]:
    """The table of the summary, the figures, then every other table."""
    blocks: list[Block] = [Heading(2, "How it drives")]
    vehicle, head = run.settings.get("vehicle"), run.headline
    if not head and dig(vehicle, "name") == "own" and not dig(vehicle, "step"):
        return [*blocks, Text(text("driving.not_driven"))]
    again = command("evaluate", run.settings)
    if head:
        blocks += [*_scores(head), Text(text("driving.scores"), kind="note")]
    else:
        blocks += missing("results.json", again)
    blocks += [] if run.scenes else missing("episodes.safetensors", again)
    for scene in run.scenes:
        blocks += _figures(scene, run.figures, full=scene is run.scenes[0])
    for group in run.groups:
        blocks += _scores(group) if group is not head else []
    tables = _tables("Planner and cost", run.groups, "planner", "cost")
    words = [Text(_planner_words(run.settings), kind="note")] if tables else []
    blocks += [*tables, *words, *_violations(run.groups)]
    return [*blocks, *_tables("More measures", run.groups, "spread")]


def _scores(group: list[Row]) -> list[Block]:
    table = metric_table(group, "tracking", observed=True)
    return [Heading(3, group_title(group)), table]


def _figures(scene: Scene, folder: Path, *, full: bool) -> list[Block]:
    """Deviation; with `full` also all episodes, the road and the steering."""
    shown: dict[str, Callable[..., Figure]] = {"deviation": deviation}
    if full:
        shown["episodes"] = spread
        shown |= {"track": track} if scene.path is not None and scene.states else {}
        shown |= {"steering": steering} if scene.controls else {}
    blocks: list[Block] = []
    for name, draw in shown.items():
        caption = text(f"driving.{name}", scene=scene.label, factor=EXAGGERATION)
        blocks.append(picture(folder, f"{name}_{scene.stem}", caption, draw, scene))
    return blocks


def _tables(heading: str, groups: list[list[Row]], *tables: str) -> list[Block]:
    """Further metrics of every group that has any of them."""
    blocks: list[Block] = []
    for group in groups:
        table = metric_table(group, *tables)
        if table.header[1:]:
            blocks += [Text(group_title(group), kind="sub"), table]
    return [Heading(3, heading), *blocks] if blocks else []


def _planner_words(settings: dict[str, Any]) -> str:
    """What the effective samples and the solve times are."""
    planner = dig(settings, "controller", "planner") or "mppi"
    options, dt = dig(settings, "controller", planner), dig(settings, "vehicle", "dt")
    known = all(is_number(dig(options, key)) for key in ("num_samples", "horizon"))
    due = text("driving.due", period_ms=1e3 * dt) if is_number(dt) else ""
    drawn = text("driving.drawn", options) if known else ""
    return text("driving.planner", drawn=drawn, due=due)


def _violations(groups: list[list[Row]]) -> list[Block]:
    """How often predictions violate what is claimed, and what V0, V1 and V2 count."""
    blocks: list[Block] = []
    records: list[Any] = []
    for group in groups:
        claims = [row.get("violation") for row in group]
        if any(is_number(dig(claim, "segments")) for claim in claims):
            heading = Heading(3, f"Violations: {group_title(group)}")
            blocks += [heading, metric_table(group, "claims")]
            records += claims
    settings = {
        key: next(filter(is_number, (dig(record, key) for record in records)), None)
        for key in ("segments", "v1_level", "v2_threshold_m")
    }
    note = Text(text("driving.violations", settings), kind="note")
    return [*blocks, note] if blocks else []


def deviation(scene: Scene, seconds: float = 15.0) -> Figure:
    """Lateral deviation in the first episode, above friction and wind."""
    figure = style.canvas(5.2)
    ratios = {"sharex": True, "height_ratios": [5, 1, 1]}
    panels = top, friction, wind = figure.subplots(3, 1, **ratios)
    length = max(values.shape[1] for values in scene.lateral.values())
    end = min(seconds, length * scene.dt)
    last = round(end / scene.dt)
    top.axhline(0.0, color=style.AXIS, linewidth=0.8)
    for system in style.ordered(scene.lateral):
        values = scene.lateral[system][0, :last]
        top.plot(scene.elapsed(values), values, **style.line(system))
    top.set(ylabel="lateral deviation [m]", xlim=(0.0, end))
    top.set_title(f"{scene.title}: deviation from the path")
    low, high = top.get_ylim()
    top.set_ylim(low, high + 0.2 * (high - low))
    changes = [step for step in switches(scene.envs) if step < last]
    for axes in panels:
        style.mark(axes, changes, scene.dt)
    if scene.envs is None:
        friction.set_visible(False)
        wind.set_visible(False)
        top.set_xlabel("time [s]")
        top.tick_params(labelbottom=True)
    else:
        _label_conditions(top, scene.envs[:last], changes, scene.dt)
        style.conditions(friction, wind, scene.envs[:last], scene.dt)
    wind.set(xlabel="time [s]")
    figure.align_ylabels()
    style.legend(figure, top)
    return figure


def _label_conditions(
    axes: Any, envs: np.ndarray, changes: list[int], dt: float
) -> None:
    """Name friction and wind between two switches, if the names fit."""
    edges = [0, *changes, len(envs)]
    if len(edges) > 8:
        return
    look = {"ha": "center", "va": "top", "linespacing": 1.25}
    for start, stop in pairwise(edges):
        stretch = envs[start:stop]
        gusts = np.ptp(stretch[:, 1]) >= 1e-3
        friction, wind = style.env_text(*stretch[0]).split(", ")
        words = f"{friction}\n{'gusts' if gusts else wind}"
        look["transform"] = axes.get_xaxis_transform()
        style.note(axes, (start + stop) / 2 * dt, 0.985, words, **look)


def spread(scene: Scene) -> Figure:
    """|deviation| over time: median, and 5–95 % band of the principal systems."""
    figure = style.canvas(3.5)
    axes = figure.subplots()
    systems = style.ordered(scene.lateral)
    banded = style.principal(systems)
    for system in systems:
        values = np.abs(scene.lateral[system])
        values = np.where(np.isfinite(values), values, np.inf)
        time = scene.elapsed(values[0])
        levels = [0.05, 0.5, 0.95]
        low, middle, high = np.quantile(values, levels, axis=0, method="nearest")
        look = style.line(system)
        axes.plot(time, middle, **look | {"linewidth": 0.75 * look["linewidth"]})
        if system in banded:
            fill = {"color": look["color"], "alpha": 0.2, "linewidth": 0}
            axes.fill_between(time, low, np.minimum(high, 1e6), **fill)
    style.mark(axes, switches(scene.envs), scene.dt, linewidth=0.5, alpha=0.5)
    count = max(values.shape[0] for values in scene.lateral.values())
    shown = "median and 5–95 % band of {} episodes" if count > 1 else "the one episode"
    axes.set(xlabel="time [s]", ylabel="|lateral deviation| [m]", xlim=(0, time[-1]))
    axes.set_title(f"{style.literal(scene.label)}: {shown.format(count)}")
    axes.set_ylim(bottom=0.0)
    style.legend(figure, axes)
    return figure


def steering(scene: Scene, seconds: float = 10.0) -> Figure:
    """Steering commands around the hardest step, of at most four systems."""
    figure = style.canvas(3.3)
    axes = figure.subplots()
    steps = max(len(values) for values in scene.controls.values())
    span = min(round(seconds / scene.dt), steps)
    start = int(np.clip(hardest_step(scene) - span // 2, 0, steps - span))
    start -= start % max(1, round(1.0 / scene.dt))
    chosen = style.ordered if len(scene.controls) <= 4 else style.principal
    for system in chosen(scene.controls):
        values = scene.controls[system][start : start + span, 0]
        time = scene.dt * (start + np.arange(len(values)))
        axes.plot(time, values, drawstyle="steps-post", **style.line(system))
    inside = [step for step in switches(scene.envs) if start < step < start + span]
    style.mark(axes, inside, scene.dt)
    axes.set(xlabel="time [s]", ylabel="steering command [rad]")
    axes.set_xlim(start * scene.dt, (start + span) * scene.dt)
    axes.set_title(f"{scene.title}: steering around the hardest moment")
    style.legend(figure, axes)
    return figure
