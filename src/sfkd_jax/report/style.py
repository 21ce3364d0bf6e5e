"""The one style of every figure: colours, names, lines, and what many figures draw."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ACCENT = "#0b57b0"
SECOND = "#e8a33d"
THIRD = "#009e73"
MUTED = "#6b7280"
DARK = "#30363d"
SOFT = "#57606a"
AXIS = "#9aa1ab"
CAR = "#5b9bd5"
"""Body of a car."""
MARKING = "#aab1ba"
"""Lines on a road."""
ROADSIDE = "#e6e9e2"
"""Ground beside a road."""
BAND: dict[str, Any] = dict(fc=ACCENT, alpha=0.16, linewidth=0, zorder=0.5)
"""Look of the area of a certified corridor."""
EDGE: dict[str, Any] = dict(color=ACCENT, linewidth=1.0, zorder=2)
"""Look of the edge of a certified corridor."""
SWITCH: dict[str, Any] = dict(color=MUTED, ls=(0, (4, 3)), linewidth=0.9, zorder=1)
"""Look of a line at a switch of the environment, or at a level."""
WIDTH = 6.9
"""Width of every figure [in]: text of 10 pt stays legible at the width of a phone."""
STYLE = Path(__file__).parent / "templates" / "figures.mplstyle"
"""Settings of matplotlib beyond its defaults."""


class Look(NamedTuple):
    """How the line of a system is drawn.

    Attributes:
        label: in legends.
        colour: of the line.
        dashes: lengths (on, off, …) [line widths]; () for a solid line.
        width: of the line [pt].
    """

    label: str
    colour: str
    dashes: tuple[float, ...] = ()
    width: float = 1.3


_PART = (4, 1.5)
"""Dashes of a model without one of its parts."""
_RIVAL = (5, 1, 1, 1)
"""Dashes of a model of others."""
# The colours are safe for colour-blind readers (after Okabe and Ito, and Tol), and
# dashes tell apart what colours alone do not.
SYSTEMS = {
    "sfkd": Look("SFKD", ACCENT, width=2.0),
    "sfkd_no_fiber": Look("SFKD − fiber", "#5b9bd5", _PART),
    "sfkd_no_transport": Look("SFKD − transport", "#7fb2a8", _PART),
    "sfkd_no_residual": Look("SFKD − residual", "#8b7fc7", _PART),
    "sfkd_no_contraction": Look("SFKD − contraction", "#4b3f8f", (1.2, 1.2)),
    "sfkd_soft": Look("SFKD, soft hinge", "#2f7f9e", (1.2, 1.2)),
    "koopman_mpc": Look("Koopman MPC", "#882255", _RIVAL),
    "neural_ode": Look("Neural ODE", THIRD, _RIVAL),
    "icode": Look("ICODE", "#56b4e9", _RIVAL),
    "icode_extrinsic": Look("ICODE, f(s, u) + G(s, u) e", "#2b83ba", (3, 1)),
    "control_synth": Look("ControlSynth", "#cc79a7", _RIVAL),
    "icode_mppi": Look("ICODE-MPPI", "#d55e00", _RIVAL),
    "icode_mppi_extrinsic": Look(
        "ICODE-MPPI, f(s, u) + G(s, u) e", "#a63603", (1, 1, 3, 1)
    ),
    "icode_mppi_reads_env": Look("ICODE-MPPI, reads e", "#b8860b", (3, 1)),
    "icode_mppi_one_step": Look("ICODE-MPPI, one step", "#8c510a", (1, 1)),
    "law": Look("Law alone", "#a0522d", (1.5, 1)),
    "law_nominal": Look("Law alone, of the nominal bicycle", "#cd853f", (1.5, 1)),
    "law_plant": Look("Law alone, of the true plant", "#6b4226", (1.5, 1)),
    "law_stanley": Look("Stanley's law", "#e9967a", (1.5, 1)),
    "law_pure_pursuit": Look("Pure pursuit", "#bc8f8f", (1.5, 1)),
    "nominal": Look("Nominal", SECOND, width=1.4),
    "oracle": Look("Oracle", "#3c3c3c", (3, 1.2), 1.4),
}
"""Name in the artefacts -> its look, in the order of tables and legends."""


def family(system: str) -> str:
    """Return the name of a system without its coordinates."""
    return system.replace("_path", "")


def rank(system: str) -> tuple[int, str]:
    """Return the sort key of every table; unknown systems come last."""
    order = [*SYSTEMS]
    name = family(system)
    position = order.index(name) if name in order else len(order)
    return position, system


def label(system: str) -> str:
    """Return the label of a system; an unknown one is labelled with its name."""
    return SYSTEMS.get(family(system), Look(system, MUTED)).label


def scenario_label(name: str) -> str:
    """Return the label of a scenario: s3 is S3, other names are unchanged."""
    return name.upper() if re.fullmatch(r"s\d+", name) else name


def literal(text: str) -> str:
    """Escape text that matplotlib would read as a formula."""
    return text.replace("$", r"\$")


def line(system: str, name: str | None = None) -> dict[str, Any]:
    """Return the keyword arguments of the line of a system.

    Args:
        system: name of the system.
        name: label in place of that of the system.
    """
    look = SYSTEMS.get(family(system), Look(system, MUTED, (1, 1), 1.2))
    return {
        "label": literal(name or look.label),
        "color": look.colour,
        "linestyle": (0, look.dashes) if look.dashes else "-",
        "linewidth": look.width,
        # The oracle above SFKD: its dashes let the line below be seen.
        "zorder": {"oracle": 5, "sfkd": 4}.get(family(system), 3),
    }


def canvas(height: float) -> Figure:
    """Return an empty figure, WIDTH x `height` [in], that no global state refers to."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def legend(figure: Figure, axes: Any, title: str | None = None) -> None:
    """Put one legend above the whole figure, which grows by the rows of the legend."""
    handles, labels = axes.get_legend_handles_labels()
    # Long names take the room of a column.
    columns = 3 if any(len(label) > 20 for label in labels) else 4
    columns = min(columns, max(1, len(labels)))
    where = "outside upper left"
    figure.legend(
        handles, labels, loc=where, ncols=columns, title=title, alignment="left"
    )
    figure.set_figheight(figure.get_figheight() + 0.2 * ((len(labels) - 1) // columns))


def draw_corridor(axes: Any, half_width: float) -> None:
    """Shade a certified corridor along the whole of a time axis, and name it."""
    axes.axhspan(-half_width, half_width, **BAND)
    for side in (-half_width, half_width):
        axes.axhline(side, **EDGE)
    # Behind the curves, whose peaks it would hide.
    look = {"va": "top", "ha": "right", "color": ACCENT, "zorder": 1.5}
    words = f"certified corridor ± {half_width:.3f} m"
    across = axes.get_yaxis_transform()
    axes.text(0.99, -1.04 * half_width, words, fontsize=8.5, transform=across, **look)


def save(path: Path, draw: Callable[..., Figure], *inputs: Any) -> Path:
    """Draw in the common style and write a PNG that depends on the inputs alone."""
    with matplotlib.rc_context():
        # Not what the user has set: the same inputs give the same bytes.
        matplotlib.rc_file(STYLE)
        draw(*inputs).savefig(path, format="png", metadata={"Software": None})
    return path
