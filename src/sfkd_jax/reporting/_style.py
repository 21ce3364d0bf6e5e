"""One look for every figure and for the page: colours, names, line styles, sizes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

SYSTEMS: dict[str, tuple[str, str, Any, float]] = {
    # name in the artefacts: (label, colour, dash pattern, line width); the order is the
    # order in every table
    "sfkd": ("SFKD", "#0b57b0", "-", 2.0),
    "sfkd_no_fiber": ("SFKD − fiber", "#5b9bd5", (0, (4, 1.5)), 1.2),
    "sfkd_no_transport": ("SFKD − transport", "#7fb2a8", (0, (4, 1.5)), 1.2),
    "sfkd_no_residual": ("SFKD − residual", "#8b7fc7", (0, (4, 1.5)), 1.2),
    "sfkd_no_contraction": ("SFKD − contraction", "#4b3f8f", (0, (1.2, 1.2)), 1.2),
    "sfkd_soft": ("SFKD, soft hinge", "#2f7f9e", (0, (1.2, 1.2)), 1.2),
    "sfkd_segment": ("SFKD, segment frame", "#9ab8d3", (0, (1.2, 1.2)), 1.2),
    "koopman_mpc": ("Koopman MPC", "#882255", (0, (5, 1, 1, 1)), 1.3),
    "neural_ode": ("Neural ODE", "#009e73", (0, (5, 1, 1, 1)), 1.3),
    "icode": ("ICODE", "#56b4e9", (0, (5, 1, 1, 1)), 1.3),
    "control_synth": ("ControlSynth", "#cc79a7", (0, (5, 1, 1, 1)), 1.3),
    "icode_mppi": ("ICODE-MPPI", "#d55e00", (0, (5, 1, 1, 1)), 1.3),
    "icode_mppi_one_step": ("ICODE-MPPI, one step", "#8c510a", (0, (1, 1)), 1.3),
    "icode_mppi_reads_env": ("ICODE-MPPI, reads e", "#b8860b", (0, (3, 1)), 1.3),
    "r2dn": ("R2DN", "#999933", (0, (5, 1, 1, 1)), 1.3),
    "nominal": ("Nominal", "#e8a33d", "-", 1.4),
    "oracle": ("Oracle", "#3c3c3c", (0, (3, 1.2)), 1.4),
    "law": ("Law alone", "#a0522d", (0, (1.5, 1)), 1.3),
}
"""One colour and one dash per system, everywhere (after Okabe and Ito, and Tol:
colour-blind safe).
"""

ACCENT, SECOND, THIRD, MUTED, GRID = (
    "#0b57b0",
    "#e8a33d",
    "#009e73",
    "#6b7280",
    "#e3e6ea",
)
LEAVES = "#c2410c"
"""Of a car that leaves its lane."""
PLATE = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
"""Behind words that lie on lines."""
WIDTH = 6.9
"""Of every figure [in]: 10 pt type stays legible at the width of a phone."""

_RC: dict[Any, Any] = {
    "axes.axisbelow": True,
    "axes.edgecolor": "#9aa1ab",
    "axes.grid": True,
    "axes.labelcolor": "#30363d",
    "axes.labelsize": 10,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlepad": 7,
    "figure.constrained_layout.h_pad": 0.09,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.facecolor": "white",
    "font.family": ["DejaVu Sans"],
    "font.size": 10,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.fontsize": 9.5,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "lines.linewidth": 1.5,
    "lines.solid_capstyle": "round",
    "savefig.dpi": 150,
    "xtick.color": "#9aa1ab",
    "xtick.labelcolor": "#30363d",
    "xtick.labelsize": 9.5,
    "ytick.color": "#9aa1ab",
    "ytick.labelcolor": "#30363d",
    "ytick.labelsize": 9.5,
}

CSS = """
:root{color-scheme:light;--ink:#1d2329;--soft:#57606a;--line:#d8dde3;--accent:#0b57b0;--wash:#f5f7fa}
*{box-sizing:border-box}
body{margin:0;background:#fff;color:var(--ink);
font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:900px;margin:0 auto;padding:2.2rem 1.25rem 4rem}
h1{font-size:1.75rem;line-height:1.2;margin:0 0 .3rem;letter-spacing:-.01em}
h2{font-size:1.25rem;margin:2.8rem 0 .6rem;padding-top:1.1rem;border-top:1px solid var(--line)}
h3{font-size:1rem;margin:1.8rem 0 .4rem}
p{margin:.6rem 0;overflow-wrap:anywhere}
.lead{font-size:1.06rem}
.sub,figcaption,.note{color:var(--soft);font-size:.9rem}
.tiles{display:grid;
grid-template-columns:repeat(auto-fit,minmax(9.2rem,1fr));gap:.6rem;margin:1.3rem 0;padding:0}
.tiles div{background:var(--wash);border-radius:6px;padding:.7rem .85rem}
.tiles dt{color:var(--soft);font-size:.82rem;line-height:1.3}
.tiles dd{margin:.1rem 0 0;font-size:1.35rem;font-weight:600;font-variant-numeric:tabular-nums}
.scroll{overflow-x:auto;margin:.7rem 0}
table{border-collapse:collapse;width:100%;font-size:.9rem;font-variant-numeric:tabular-nums}
th,td{padding:.38rem .6rem;text-align:right;border-bottom:1px solid var(--line);vertical-align:top}
thead th{color:var(--soft);font-weight:600;font-size:.82rem;line-height:1.3;vertical-align:bottom}
thead th{white-space:pre-line}
.data td,.data tbody th{white-space:nowrap}
th:first-child{text-align:left}
.prose th,.prose td{text-align:left}
.prose td{overflow-wrap:anywhere}
tbody th{font-weight:400;background:#fff}
tbody tr.strong th,tbody tr.strong td{font-weight:650;background:#eef4fc}
figure{margin:1.4rem 0}
figure img{display:block;width:100%;max-width:760px;height:auto}
figcaption{margin-top:.4rem}
pre{background:var(--wash);border-radius:6px;padding:.75rem .9rem;margin:.7rem 0;
white-space:pre-wrap;overflow-wrap:anywhere;
font:.88rem/1.5 ui-monospace,SFMono-Regular,Menlo,Consolas,monospace}
.missing{border-left:3px solid #e8a33d;background:#fdf7ec;padding:.7rem .9rem;margin:.8rem 0}
@media(max-width:640px){main{padding:1.4rem 1rem 3rem}h1{font-size:1.45rem}
.data tbody th,.data thead th:first-child{position:sticky;left:0;background:#fff;
box-shadow:1px 0 0 var(--line)}
.data tbody tr.strong th{background:#eef4fc}th,td{padding:.36rem .45rem}}
@media print{@page{margin:16mm}body{font-size:10.5pt}main{max-width:none;padding:0}
.scroll{overflow:visible}figure,tr,pre,.tiles,.missing,.data{break-inside:avoid}h2,h3,.sub{break-after:avoid}
.data td{white-space:normal}
table{font-size:8.5pt}th,td{padding:.25rem .35rem}figure img{width:auto;max-width:150mm;max-height:128mm}}
"""


def family(system: str) -> str:
    """A system in path coordinates looks like what it is in the others; where both are meant, the title says so."""
    return system.replace("_path", "")


def ordered(systems: Iterable[str]) -> list[str]:
    """Sort system names in the one order every table and legend uses; unknown names come last."""
    rank = {name: place for place, name in enumerate(SYSTEMS)}
    return sorted(systems, key=lambda name: (rank.get(family(name), len(rank)), name))


def label(system: str) -> str:
    """What a reader sees for a system."""
    return SYSTEMS[family(system)][0] if family(system) in SYSTEMS else system


def scenario_label(name: str) -> str:
    """What a reader sees for a scenario: S3, but seen as it is."""
    return name.upper() if re.fullmatch(r"s\d+", name) else name


def literal(text: str) -> str:
    """Text that matplotlib takes as it is, not as a formula."""
    return text.replace("$", r"\$")


def line(system: str) -> dict[str, Any]:
    """Keyword arguments of the line that stands for a system in every figure."""
    name, colour, dashes, width = SYSTEMS.get(
        family(system), (system, MUTED, (0, (1, 1)), 1.2)
    )
    top = {"sfkd": 5, "oracle": 4}.get(family(system), 3)
    return {
        "label": literal(name),
        "color": colour,
        "linestyle": dashes,
        "linewidth": width,
        "zorder": top,
    }


def canvas(height: float) -> Figure:
    """An empty figure, WIDTH x `height` [in], free of any global state."""
    return Figure(figsize=(WIDTH, height), layout="constrained")


def legend(figure: Figure, axes: Any) -> None:
    """Put one legend for the whole figure above it, and make the figure higher by the rows that it takes."""
    handles, labels = axes.get_legend_handles_labels()
    columns, size = (max(1, len(labels)), 9.5) if len(labels) <= 5 else (4, 9.0)
    figure.legend(
        handles,
        labels,
        loc="outside upper left",
        ncols=columns,
        columnspacing=1.4,
        fontsize=size,
    )
    figure.set_figheight(figure.get_figheight() + 0.2 * ((len(labels) - 1) // columns))


def principal(systems: Iterable[str]) -> list[str]:
    """The few systems to single out where all would be too many: SFKD, nominal and oracle, else the first."""
    names = ordered(systems)
    return [name for name in names if name in ("sfkd", "nominal", "oracle")] or names[
        :3
    ]


def save(path: Path, draw: Callable[..., Figure], *inputs: Any) -> Path:
    """Draw under the house style and write a PNG whose bytes depend on the inputs alone."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC)
        draw(*inputs).savefig(path, format="png", metadata={"Software": None})
    return path
