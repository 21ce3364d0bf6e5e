"""The section on the certificate: what is proved, what is measured, and its tube."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, MaxNLocator

from sfkd_jax.evaluation.formats import DASH, dig, is_number, is_pair, plain, short
from sfkd_jax.reporting import style
from sfkd_jax.reporting._model import numbers
from sfkd_jax.reporting._summary import command
from sfkd_jax.reporting._track import turn_by
from sfkd_jax.reporting.blocks import Block, Heading, Table, Text, missing, picture
from sfkd_jax.reporting.run import Run, holds
from sfkd_jax.reporting.scene import Scene, hardest_step
from sfkd_jax.reporting.texts import AXES, fill, list_rows, text

_WASH = "#dce8f7"
_REACH = (4.0, 11.0)
"""Least and most of half the height of the view from above [m]."""
_MARGIN = 14.0
"""Before and behind the predicted stretch [m]."""
_UNITS = {"position_m": "position [m]", "yaw_rad": "yaw [rad]", "body": "body state"}


def certified(run: Run) -> list[Block]:
    """The certificate in words, its tube by step and on a drive, and its numbers."""
    heading, record = Heading(2, "What is certified"), run.certificate
    if record is None:
        return [heading, *missing("certificate.json", command("certify", run.settings))]
    pictures = _pictures(run, record) if holds(run.certificate) else []
    return [heading, *_words(record), *pictures, _table(record)]


def _pictures(run: Run, record: dict[str, Any]) -> list[Block]:
    radii = dig(record, "tube", "latent") or []
    position = dig(record, "tube", "physical", "position_m") or []
    if not radii or not all(map(is_number, radii)):
        return []
    caption = text("certificate.radius", steps=len(radii))
    blocks: list[Block] = [picture(run.figures, "tube", caption, tube, record)]
    long = [s for s in run.scenes if len(s.states.get(run.system, ())) > len(position)]
    positive = all(is_number(radius) and radius > 0 for radius in position)
    if long and len(position) > 1 and positive:
        drawn = long[0], run.system, position, dig(run.errors, "position_rmse_m") or []
        name, caption = "tube_on_drive", text("certificate.on_drive")
        blocks.append(picture(run.figures, name, caption, tube_on_drive, *drawn))
    return blocks


def _words(record: dict[str, Any]) -> list[Text]:
    """What is proved, what is measured and what is not claimed."""
    if not holds(record):
        reason = record.get("reason") or "the file gives no reason"
        return [Text(text("certificate.none", reason=reason), "Nothing is proved.")]
    names = "state", "control", "env"
    boxes = [f"{name}: {_box(record, name)}" for name in names if _axes(record, name)]
    known = is_number(dig(record, "d_bar", "coverage"))
    covered = text("certificate.covered", record) if known else ""
    measured = text("certificate.measured", record, covered=covered)
    return [
        Text(_proved(record), "Proved."),
        Text(measured, "Measured, not proved."),
        Text(text("certificate.limits", boxes="; ".join(boxes)), "Not claimed."),
    ]


def _proved(record: dict[str, Any]) -> str:
    known, radii = _axes(record, "env"), dig(record, "tube", "latent")
    limited = is_number(dig(record, "tube", "ultimate"))
    return text(
        "certificate.proved",
        record,
        where=f" with {_box(record, 'env')}" if known else text("certificate.not_read"),
        radii=text("certificate.radii", record, steps=len(radii)) if radii else "",
        limit=text("certificate.limit", record) if limited else "",
    )


def _axes(record: dict[str, Any], box: str) -> list[Any]:
    """Name and unit of every axis of a box; those of logs are in the certificate."""
    named = dig(record, "boxes", "names", box)
    if named is not None:
        return [(str(name), "") for name in named]
    frame = "body" if dig(record, "corridor") is None else "path"
    return AXES[frame][box]


def _box(record: dict[str, Any], name: str) -> str:
    """A box, given by its lower and upper corner, in words."""
    box, axes = dig(record, "boxes", name), _axes(record, name)
    corners = isinstance(box, list) and all(isinstance(one, list) for one in box)
    sides = [[*side] for side in zip(*box, strict=False)] if corners else []
    if not sides or not all(map(is_pair, sides)):
        return plain(box)
    known = zip([*axes, *[("", "")] * len(sides)], sides, strict=False)
    return ", ".join(
        f"{axis} {short(low)} to {short(high)}{unit}".strip()
        for (axis, unit), (low, high) in known
    )


def _table(record: dict[str, Any]) -> Table:
    """Every number of the certificate, with what it is."""
    physical = _last(dig(record, "tube", "physical"))
    rows = list_rows("certificate_table", record, physical=physical)
    return Table(["Quantity", "Value"], rows, prose=True)


def _last(tube: Any) -> str:
    """The last radius of each physical quantity."""
    parts = {"": tube} if isinstance(tube, list) else tube
    last = [
        f"{_UNITS.get(name, name)} {fill('{radii.-1:bound}', radii=radii)}".strip()
        for name, radii in (parts.items() if isinstance(parts, dict) else ())
        if isinstance(radii, list) and radii
    ]
    return "; ".join(last) or DASH


def tube(record: dict[str, Any]) -> Figure:
    """The certified latent radius R_k by prediction step, with its limit in words."""
    figure = style.canvas(3.2)
    axes = figure.subplots()
    last = len(record["tube"]["latent"])
    steps, values = np.arange(1, last + 1), numbers(record["tube"]["latent"], last)
    axes.fill_between(steps, 0.0, values, color=style.ACCENT, alpha=0.12, linewidth=0)
    axes.plot(steps, values, color=style.ACCENT, marker="o", markersize=4)
    words = text("certificate.figure", record, last=last).replace(" | ", "\n")
    look = {"transform": axes.transAxes, "va": "top", "linespacing": 1.6}
    axes.text(0.03, 0.95, words, color=style.DARK, **look)
    axes.set(xlabel="steps ahead k", ylabel="latent radius $R_k$ [-]")
    axes.set_xlim(0.5, last + 0.5)
    axes.set_ylim(bottom=0.0)
    axes.set_title("Tube that the prediction error cannot leave while ‖d‖ ≤ d̄")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def tube_on_drive(
    scene: Scene, system: str, radii: list[float], errors: list[Any]
) -> Figure:
    """The certified tube on a drive from above, and its radius by step.

    Distance is symmetric: a prediction from the state at the dot is within R_k of the
    k-th state after it.

    Args:
        scene: with states of `system` and a path.
        system: that drives.
        radii: position radius of the tube [m], by step.
        errors: position RMSE of predictions on held-out drives [m], by step; null where
            it is not known.
    """
    states, count = scene.states[system], len(radii)
    start = hardest_step(scene) - count // 2
    start = int(np.clip(start, 0, max(0, len(states) - 1 - count)))
    figure = style.canvas(5.6)
    above, below = figure.subplots(2, 1, height_ratios=[1.25, 1])
    _from_above(above, scene, states[:, :2], start, radii)
    above.set_title(f"{scene.title}: the certified tube on the drive")
    _by_step(below, radii, numbers(errors, count))
    return figure


def _by_step(axes: Any, radii: list[float], measured: np.ndarray) -> None:
    """Certified radius and measured error by step, on a logarithmic axis."""
    steps, known = np.arange(1, len(radii) + 1), measured > 0
    axes.fill_between(steps, radii, 1e-9, color=_WASH, linewidth=0)
    axes.plot(steps, radii, color=style.ACCENT, marker="o", markersize=3.5)
    shown = np.where(known, measured, np.nan)
    axes.plot(steps, shown, color=style.SECOND, marker="s", markersize=3.5)
    look = {"textcoords": "offset points", "ha": "right", "va": "bottom", "fontsize": 9}
    certified = radii[-1], "certified", style.ACCENT
    rmse = measured[-1], "measured RMSE, held-out drives", "#9a6516"
    for last, name, colour in (certified, rmse):
        if np.isfinite(last) and last > 0:
            words = f"{name}: {short(float(last))} m"
            axes.annotate(words, (steps[-1], last), (0, 6), color=colour, **look)
    lowest = min([*radii, *measured[known]])
    axes.set(yscale="log", ylim=(0.4 * lowest, 8 * max(radii)))
    axes.set(xlabel="steps ahead k", ylabel="position radius [m]")
    axes.set_xlim(0.5, len(radii) + 0.5)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _from_above(
    axes: Any, scene: Scene, positions: np.ndarray, start: int, radii: list[float]
) -> None:
    """Discs around the states after `start`, turned so that the car drives right."""
    count = len(radii)
    ahead = positions[start : start + 1 + count]
    gone = ahead[-1] - ahead[0]
    turn = turn_by(np.arctan2(gone[1], gone[0]))

    def turned(points: np.ndarray) -> np.ndarray:
        return turn @ (points - ahead[0]).T

    centres = turned(ahead[1:]).T
    reach = float(np.clip(1.2 * max(radii) + 2.0, *_REACH))
    depth = np.subtract(1.0, to_rgb(style.ACCENT))
    for step in range(len(centres), 0, -1):
        centre, radius = centres[step - 1], radii[step - 1]
        named = step % max(1, count // 4) == 0
        shade = (1.0 - 0.8 * (step - 1) / count) * depth
        edge = {"ec": style.ACCENT, "lw": 0.9} if named else {"ec": "white", "lw": 0.4}
        disc = Circle(centre, radius, fc=1.0 - 0.45 * shade, zorder=0.4, **edge)
        axes.add_patch(disc)
        if named:
            _name(axes, centre, radius, reach, f"k = {step}")
    if scene.path is not None:
        axes.plot(*turned(scene.path[:, :2]), color="#c9ced6", linewidth=5, zorder=1.5)
    axes.plot(*turned(positions), color=style.MUTED, linewidth=1.0, zorder=3)
    axes.plot(*turned(ahead), color=style.ACCENT, linewidth=2.0, zorder=4)
    axes.plot(0.0, 0.0, marker="o", markersize=6, color="#1d2329", zorder=5)
    right = float(centres[-1, 0]) + _MARGIN
    axes.set(xlim=(-_MARGIN, right), ylim=(-reach, reach), aspect="equal")
    axes.set(xlabel="along the drive [m]", ylabel="across [m]")
    axes.grid(visible=False)


def _name(
    axes: Any, centre: np.ndarray, radius: float, reach: float, name: str
) -> None:
    """The name of a disc above it, or where its edge leaves the view on the left."""
    (x, y), height = centre, reach - 1.2
    if y + radius > height - 1.0:
        x -= np.sqrt(max(radius**2 - (height - y) ** 2, 0.0))
    else:
        height = max(y + radius + 0.8, y + 1.2)
    if x > -_MARGIN + 2.5:
        look = {"ha": "center", "va": "center", "color": style.ACCENT, "zorder": 6}
        style.note(axes, x, height, name, **look)
