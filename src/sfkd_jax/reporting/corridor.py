"""The section on the certified corridor of the closed loop."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sfkd_jax.evaluation.formats import dig, is_number, number, share
from sfkd_jax.reporting import style
from sfkd_jax.reporting.blocks import Block, Heading, Table, Text, picture
from sfkd_jax.reporting.run import Run, holds
from sfkd_jax.reporting.scene import Scene, switches
from sfkd_jax.reporting.texts import list_rows, text

_INNER, _OUTER = "#cfe0f5", "#e9f1fb"


def corridor(run: Run) -> list[Block]:
    """The section, if a certificate holds and has a corridor."""
    record, own = run.certificate, dig(run.certificate, "corridor")
    if (
        record is None
        or not holds(run.certificate)
        or not is_number(dig(own, "corridor_m"))
    ):
        return []
    heading = Heading(2, "How far the car strays")
    blocks: list[Block] = [heading, *_words(record), _table(own)]
    names = "nominal", "followed_position"
    halves = [dig(own, "bounds", name) for name in names]
    driven = [scene for scene in run.scenes if run.system in scene.lateral]
    if driven and all(map(is_number, halves)):
        drawn = driven[0], run.system, *map(float, halves)
        caption = text("corridor.figure")
        blocks.append(picture(run.figures, "corridor", caption, around_drives, *drawn))
    return blocks


def _words(record: dict[str, Any]) -> list[Text]:
    """What is promised, what of it is proved, what is measured, and an attack."""
    own = record["corridor"]
    words = [
        Text(text("corridor.promised", record), "The corridor."),
        Text(text("corridor.proved", record), "Proved."),
        Text(_measured(record), "Measured, not proved."),
    ]
    if dig(own, "fixed_points", "corridor_m"):
        at_rest = text("corridor.at_rest", own["fixed_points"])
        words.append(Text(at_rest, "Without a copy."))
    attack = own.get("attack")
    if isinstance(attack, dict):
        needed = attack.get("kept_lateral_m"), attack.get("over_corridor")
        kept = text("corridor.kept", attack) if all(map(is_number, needed)) else ""
        words.append(Text(text("corridor.attacked", attack, kept=kept), "Attacked."))
    return words


def _measured(record: dict[str, Any]) -> str:
    own, by_scenario = record["corridor"], dig(record, "corridor", "by_scenario")
    parts = [
        text("corridor.held_out", part, where=style.scenario_label(name))
        for name, part in (by_scenario if isinstance(by_scenario, dict) else {}).items()
        if is_number(dig(part, "coverage"))
    ]
    lengths = (dig(own, "seen", name) for name in ("lateral_m", "distance_m"))
    parts += [text("corridor.seen", record)] if all(map(is_number, lengths)) else []
    return text("corridor.measured", record, details="".join(parts))


def _table(own: dict[str, Any]) -> Table:
    """Every bound, and whether it holds together with the others."""
    rows = list_rows("corridor_table", own, share=share(own.get("level")))
    header = ["Bound", "At most", "Holds on a share of drives of"]
    return Table(header, rows, prose=True)


def around_drives(scene: Scene, system: str, width: float, tube: float) -> Figure:
    """Lateral deviation of every episode of a system in its corridor."""
    figure = style.canvas(3.4)
    axes = figure.subplots()
    band(axes, width, tube)
    for values in scene.lateral[system]:
        axes.plot(scene.elapsed(values), values, color=style.ACCENT, linewidth=0.6)
    values = np.abs(scene.lateral[system])
    farthest = float(np.max(values, where=np.isfinite(values), initial=0.0))
    reach = 1.25 * max(width + tube, farthest)
    axes.set(xlim=(0.0, scene.dt * values.shape[1]), ylim=(-reach, reach))
    axes.set(xlabel="time [s]", ylabel="lateral deviation [m]")
    count = "the one episode" if len(values) == 1 else f"{len(values)} episodes"
    distance = f"at most {number(farthest)} m from the path"
    axes.set_title(f"{style.literal(scene.label)}: {count}, {distance}")
    style.mark(axes, switches(scene.envs) if len(values) == 1 else (), scene.dt)
    return figure


def band(axes: Any, width: float, tube: float, *, named: bool = True) -> None:
    """Draw a corridor along the whole of an axis.

    Args:
        axes: to draw on.
        width: half of what the shield keeps for the nominal copy of the car [m].
        tube: half width of the tube around that copy [m].
        named: whether the widths are written.
    """
    edge = width + tube
    axes.axhspan(-edge, edge, color=_OUTER, linewidth=0, zorder=0.1)
    axes.axhspan(-width, width, color=_INNER, linewidth=0, zorder=0.2)
    for side in (-edge, edge):
        axes.axhline(side, color=style.ACCENT, linewidth=1.2, zorder=2)
    for name, height in {"W + tube": edge, "W": width}.items() if named else ():
        # Below the curves, whose peaks it would hide.
        look = {"va": "bottom", "ha": "right", "color": style.ACCENT, "zorder": 1.5}
        look["transform"] = axes.get_yaxis_transform()
        words = f"{name} = {number(height)} m"
        style.note(axes, 0.995, height + 0.03 * edge, words, **look)
