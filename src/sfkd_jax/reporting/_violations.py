"""Figure 2: how often predictions leave what is claimed about them, and how wide the claim is."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter

from sfkd_jax.reporting._numbers import dig, is_number, short
from sfkd_jax.reporting._style import MUTED, canvas, label, legend, line, literal

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
_CONFORMAL: dict[str, Any] = {"marker": "o", "markersize": 4}


def disturbed(block: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of a block that were also driven under side forces."""
    return [
        row
        for row in block
        if isinstance(row.get("disturbed"), list) and row["disturbed"]
    ]


def violations(rows: list[dict[str, Any]]) -> Figure:
    """Shares of violations against the largest injected side force, and the mean radius of every row's tubes.

    Args:
        rows: of one block, each with `disturbed`.
    """
    figure = canvas(max(5.2, 2.0 + 0.3 * len(rows)))
    grid = figure.add_gridspec(2, 2, width_ratios=[1.55, 1])
    tubes, common = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0])
    for row in rows:
        style = line(str(row.get("system")))
        name = style["label"]
        tubes.plot(*_against_force(row, "v1_conformal"), **style, **_CONFORMAL)
        common.plot(*_against_force(row, "v2"), **style, **_CONFORMAL)
        if _is_certified(row):
            certified: dict[str, Any] = (
                style | _CERTIFIED | {"label": f"_{name}, certified tube"}
            )
            theorem: dict[str, Any] = (
                style | _THEOREM | {"label": f"_{name}, theorem (V0)"}
            )
            tubes.plot(*_against_force(row, "v1"), **certified)
            tubes.plot(*_against_force(row, "v0"), **theorem)
    levels = [dig(row, "violation", "v1_level") for row in rows]
    for level in filter(is_number, levels[:1]):
        tubes.axhline(
            1.0 - level, color=MUTED, linestyle=(0, (4, 3)), linewidth=0.9, zorder=1
        )
    titles = {
        "V1: segments that leave their tube": tubes,
        "V2: beyond the common threshold": common,
    }
    for title, axes in titles.items():
        axes.set(ylim=(-0.04, 1.04), title=title)
        axes.yaxis.set_major_formatter(PercentFormatter(xmax=1.0))
    tubes.tick_params(labelbottom=False)
    common.set(xlabel="largest unmeasured side force [N]")
    _radii(figure.add_subplot(grid[:, 1]), rows)
    legend(figure, tubes)
    if any(map(_is_certified, rows)):
        kinds = {
            "conformal tube": _CONFORMAL,
            "certified tube": _CERTIFIED,
            "theorem, V0": _THEOREM,
        }
        figure.legend(
            handles=[_mark(name, style) for name, style in kinds.items()],
            loc="outside lower left",
            ncols=3,
        )
    return figure


def _mark(name: str, style: dict[str, Any]) -> Line2D:
    """What stands for a kind of claim, in the colour of no system."""
    grey: dict[str, Any] = style | {"color": MUTED, "label": name}
    return Line2D([], [], **grey)


def _against_force(row: dict[str, Any], key: str) -> tuple[np.ndarray, np.ndarray]:
    """Forces [N] and a share at each of them, NaN for null."""
    pairs = [
        (run.get("force_n"), run.get(key))
        for run in row["disturbed"]
        if isinstance(run, dict)
    ]
    values = np.array(
        [[x if is_number(x) else np.nan for x in pair] for pair in pairs], dtype=float
    ).reshape(-1, 2)
    return values[:, 0], values[:, 1]


def _is_certified(row: dict[str, Any]) -> bool:
    return dig(row, "violation", "v1_tube") == "certified"


def _radii(axes: Any, rows: list[dict[str, Any]]) -> None:
    """Mean position radius of each row's tubes, from the first row at the top."""
    places = range(len(rows) - 1, -1, -1)
    for place, row in zip(places, rows, strict=True):
        colour = line(str(row.get("system")))["color"]
        shown = {"v1_conformal_radius_m": _CONFORMAL} | (
            {"v1_radius_m": _CERTIFIED} if _is_certified(row) else {}
        )
        for key, style in shown.items():
            radius = dig(row, "violation", key)
            if not is_number(radius) or radius <= 0:
                continue
            dot: dict[str, Any] = style | {
                "color": colour,
                "linestyle": "none",
                "markersize": 6,
            }
            axes.plot(radius, place, **dot)
            words = {
                "textcoords": "offset points",
                "ha": "center",
                "fontsize": 8.5,
                "color": "#57606a",
            }
            axes.annotate(short(radius, 2), (radius, place), (0, 6), **words)
    axes.set_yticks(
        list(places), [literal(label(str(row.get("system")))) for row in rows]
    )
    axes.set(
        xscale="log",
        ylim=(-0.6, len(rows) - 0.4),
        xlabel="mean position radius [m]",
        title="Width of the tubes",
    )
    axes.margins(x=0.18)
    axes.grid(visible=False, axis="y")
