"""Figure of violations under side forces: how often claims fail, and their width."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter

from sfkd_jax.evaluation.formats import dig, is_number, short
from sfkd_jax.evaluation.metrics import BY_NAME, Row
from sfkd_jax.reporting import style

_CONFORMAL: dict[str, Any] = {"marker": "o", "markersize": 4}
_CERTIFIED: dict[str, Any] = {
    "linestyle": (0, (2, 1.5)),
    "marker": "s",
    "markersize": 5,
    "markerfacecolor": "white",
}
_THEOREM: dict[str, Any] = {
    "linestyle": (0, (1, 1.5)),
    "marker": "x",
    "markersize": 6,
    "linewidth": 1.2,
}
_KINDS = {
    "conformal tube": _CONFORMAL,
    "certified tube": _CERTIFIED,
    "theorem, V0": _THEOREM,
}


def disturbed(group: list[Row]) -> list[Row]:
    """The rows of a group that were also evaluated under side forces."""
    runs = [(row, row.get("disturbed")) for row in group]
    return [row for row, of_row in runs if isinstance(of_row, list) and of_row]


def violations(rows: list[Row]) -> Figure:
    """Shares of violations by side force, and the mean radius of every row's tubes.

    Args:
        rows: of one group, each with `disturbed`.
    """
    figure = style.canvas(max(5.2, 2.0 + 0.3 * len(rows)))
    grid = figure.add_gridspec(2, 2, width_ratios=[1.55, 1])
    tubes, common = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    for row in rows:
        _draw_shares(tubes, common, row)
    levels = [dig(row, "violation", "v1_level") for row in rows[:1]]
    for level in filter(is_number, levels):
        tubes.axhline(1.0 - level, **style.SWITCH)
    tubes.set_title("V1: segments that leave their tube")
    common.set_title("V2: beyond the common threshold")
    for axes in (tubes, common):
        axes.set_ylim(-0.04, 1.04)
        axes.yaxis.set_major_formatter(PercentFormatter(xmax=1.0))
    tubes.tick_params(labelbottom=False)
    common.set(xlabel="largest unmeasured side force [N]")
    _draw_radii(figure.add_subplot(grid[:, 1]), rows)
    style.legend(figure, tubes)
    if any(map(_is_certified, rows)):
        grey: dict[str, Any] = {"color": style.MUTED}
        marks = [Line2D([], [], label=n, **s | grey) for n, s in _KINDS.items()]
        figure.legend(handles=marks, loc="outside lower left", ncols=3)
    return figure


def _draw_shares(tubes: Any, common: Any, row: Row) -> None:
    """The shares of one row; only conformal tubes are in the legend."""
    look = style.line(str(row.get("system")))
    tubes.plot(*_by_force(row, "v1_conformal"), **look | _CONFORMAL)
    common.plot(*_by_force(row, "v2"), **look | _CONFORMAL)
    if _is_certified(row):
        for key, kind, name in (
            ("v1", _CERTIFIED, "certified tube"),
            ("v0", _THEOREM, "theorem (V0)"),
        ):
            hidden = {"label": f"_{look['label']}, {name}"}
            tubes.plot(*_by_force(row, key), **look | kind | hidden)


def _by_force(row: Row, key: str) -> tuple[np.ndarray, np.ndarray]:
    """Forces [N] and the share at each of them, NaN for null."""
    runs = [run for run in row["disturbed"] if isinstance(run, dict)]
    forces, shares = (
        np.array(
            [x if is_number(x) else np.nan for x in map(dig, runs, [k] * len(runs))]
        )
        for k in ("force_n", key)
    )
    return forces, shares


def _is_certified(row: Row) -> bool:
    return dig(row, "violation", "v1_tube") == "certified"


def _draw_radii(axes: Any, rows: list[Row]) -> None:
    """Mean position radius of the tubes of each row, from the first row at the top."""
    words = {"textcoords": "offset points", "ha": "center", "fontsize": 8.5}
    for height, row in enumerate(reversed(rows)):
        mark = {
            "color": style.line(str(row.get("system")))["color"],
            "linestyle": "none",
        }
        for tube, look in (("v1_conformal", _CONFORMAL), ("v1", _CERTIFIED)):
            radius = BY_NAME[f"violation.{tube}_radius_m"].value(row)
            if is_number(radius) and radius > 0:
                axes.plot(radius, height, **look | mark | {"markersize": 6})
                axes.annotate(
                    short(radius, 2),
                    (radius, height),
                    (0, 6),
                    color=style.SOFT,
                    **words,
                )
    names = [style.literal(style.label(str(row.get("system")))) for row in rows]
    axes.set_yticks(range(len(rows) - 1, -1, -1), names)
    axes.set(xscale="log", ylim=(-0.6, len(rows) - 0.4), title="Width of the tubes")
    axes.set(xlabel="mean position radius [m]")
    axes.margins(x=0.18)
    axes.grid(visible=False, axis="y")
