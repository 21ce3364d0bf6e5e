"""The style of figures: colours, names, line styles, and what many figures draw."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import style
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

ACCENT, SECOND, THIRD, MUTED = "#0b57b0", "#e8a33d", "#009e73", "#6b7280"
DARK, SOFT, AXIS, ROAD = "#30363d", "#57606a", "#9aa1ab", "#d5dae1"
DEPARTED = "#c2410c"
"""Colour of a car that leaves its lane."""
PLATE = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
"""Background of text on lines."""
SWITCH: dict[str, Any] = dict(color=MUTED, ls=(0, (4, 3)), linewidth=0.9, zorder=1)
"""Line at a switch of the environment, or at a level."""
WIDTH = 6.9
"""Of every figure [in]: text of 10 pt stays legible at the width of a phone."""
_STYLE = Path(__file__).with_name("figures.mplstyle")
_SYSTEMS = Path(__file__).with_name("systems.toml")

SYSTEMS: dict[str, dict[str, Any]] = tomllib.loads(_SYSTEMS.read_text("utf-8"))
"""Name in the artefacts -> label, colour, dashes and width, in the order of tables."""


def family(system: str) -> str:
    """The name of a system without its coordinates."""
    return system.replace("_path", "")


def rank(system: str) -> tuple[int, str]:
    """Sort key for the order of every table; unknown systems come last."""
    order, name = [*SYSTEMS], family(system)
    return (order.index(name) if name in order else len(order), system)


def ordered(systems: Iterable[str]) -> list[str]:
    """Sort system names as in every table and legend."""
    return sorted(systems, key=rank)


def label(system: str) -> str:
    """The label of a system."""
    return SYSTEMS.get(family(system), {"label": system})["label"]


def scenario_label(name: str) -> str:
    """The label of a scenario: s3 is S3, other names are unchanged."""
    return name.upper() if re.fullmatch(r"s\d+", name) else name


def file_stem(text: str) -> str:
    """Text as part of a file name."""
    return "".join(letter if letter.isalnum() else "_" for letter in text)


def literal(text: str) -> str:
    """Escape text that matplotlib would read as a formula."""
    return text.replace("$", r"\$")


def line(system: str) -> dict[str, Any]:
    """Keyword arguments of the line of a system in every figure."""
    unknown = {"colour": MUTED, "dashes": [1, 1], "width": 1.2}
    own = SYSTEMS.get(family(system), unknown)
    return {
        "label": literal(label(system)),
        "color": own["colour"],
        "linestyle": (0, tuple(own["dashes"])) if own["dashes"] else "-",
        "linewidth": own["width"],
        "zorder": {"sfkd": 5, "oracle": 4}.get(family(system), 3),
    }


def canvas(height: float) -> Figure:
    """An empty figure, WIDTH x `height` [in], that no global state refers to."""
    return Figure(figsize=(WIDTH, height), layout="constrained")


def legend(figure: Figure, axes: Any) -> None:
    """Put one legend above the whole figure, which grows by the rows of the legend."""
    handles, labels = axes.get_legend_handles_labels()
    columns, size = (max(1, len(labels)), 9.5) if len(labels) <= 5 else (4, 9.0)
    placed = {"loc": "outside upper left", "ncols": columns, "columnspacing": 1.4}
    figure.legend(handles, labels, fontsize=size, **placed)
    figure.set_figheight(figure.get_figheight() + 0.2 * ((len(labels) - 1) // columns))


def note(axes: Any, x: Any, y: Any, words: str, **options: Any) -> None:
    """Write small text, on a plate if it may cover lines."""
    axes.text(x, y, words, **{"fontsize": 8.5, "color": SOFT, "bbox": PLATE} | options)


def conditions(
    friction: Any, wind: Any, envs: Float[np.ndarray, "time 2"], dt: float
) -> None:
    """Draw friction and wind over time, each on its own axes."""
    time = dt * np.arange(len(envs) + 1)
    for axes, values in zip((friction, wind), envs.T, strict=True):
        fill = {"baseline": 0.0, "fill": True, "color": "#b9c6d6", "linewidth": 0.0}
        axes.stairs(values, time, **fill)
        axes.stairs(values, time, baseline=None, color="#4a5a6d", linewidth=1.1)
    friction.set(ylim=(0.0, 1.0), yticks=[0.0, 0.5, 1.0], ylabel="friction\nμ [-]")
    peak = max(1.0, float(np.max(np.abs(envs[:, 1]))))
    wind.set(ylim=(-1.15 * peak, 1.15 * peak), ylabel="wind\n[m/s]")
    wind.yaxis.set_major_locator(MaxNLocator(nbins=2, symmetric=True))


def mark(axes: Any, steps: Iterable[int], dt: float, **options: Any) -> None:
    """Draw dashed lines at steps, and no other vertical lines."""
    axes.grid(visible=False, axis="x")
    for step in steps:
        axes.axvline(step * dt, **SWITCH | options)


def shade(friction: float) -> tuple[float, float, float]:
    """Background colour: white for a dry road, blue grey for a slippery one."""
    depth = float(np.clip((0.9 - friction) / 0.6, 0.0, 1.0))
    return 1.0 - 0.14 * depth, 1.0 - 0.10 * depth, 1.0 - 0.05 * depth


def env_text(friction: float, wind: float) -> str:
    """Friction and wind as text."""
    words = f"w {wind:+.2g} m/s".replace("-", "−") if abs(wind) > 1e-3 else "no wind"
    return f"μ {friction:.2g}, {words}"


def principal(systems: Iterable[str]) -> list[str]:
    """SFKD, nominal and oracle, or else the first three systems."""
    names = ordered(systems)
    known = [name for name in names if name in ("sfkd", "nominal", "oracle")]
    return known or names[:3]


def save(path: Path, draw: Callable[..., Figure], *inputs: Any) -> Path:
    """Draw in the common style and write a PNG that depends on the inputs alone."""
    with style.context(_STYLE, after_reset=True):
        draw(*inputs).savefig(path, format="png", metadata={"Software": None})
    return path
