"""Variations of the protocol: every row under them, beside the same row without."""

from __future__ import annotations

import re
import textwrap
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from sfkd_jax.evaluation.formats import DASH, dig, is_number, millimetres, number
from sfkd_jax.evaluation.metrics import Row
from sfkd_jax.paper._dots import colour, common_range, dot, dot_panels, sample
from sfkd_jax.paper._setups import Entry, Setup, by_hardness, plant_of
from sfkd_jax.paper._study import Study
from sfkd_jax.paper._texts import text
from sfkd_jax.reporting.blocks import Table
from sfkd_jax.reporting.rows import name_of
from sfkd_jax.reporting.style import MUTED, scenario_label


class Variations(NamedTuple):
    """The variations of one setup on one scenario.

    Attributes:
        setup: of the rows.
        scenario: that was driven.
        levels: names of the variations, by kind and size.
        rows: by (name of the entry, level).
        study: texts of the page.
    """

    setup: Setup
    scenario: str
    levels: list[str]
    rows: dict[tuple[str, str], Row]
    study: Study

    @property
    def columns(self) -> list[str]:
        """All levels in the order of the table, with that of the unvaried protocol."""
        unvaried = [self.study.unvaried]
        last = self.study.unvaried_last
        return [*self.levels, *unvaried] if last else [*unvaried, *self.levels]

    def rmse(self, entry: Entry, level: str) -> float | None:
        """Mean RMSE of an entry under a variation, or None."""
        mean = dig(self.rows.get((entry.name, level)), "rmse_m", "mean")
        return mean if is_number(mean) else None

    @property
    def heading(self) -> str:
        """What varies, where and of which rows."""
        where = scenario_label(self.scenario)
        return f"{self.study.variations}, {where}: {self.setup.title}"

    @property
    def caption(self) -> str:
        """What the figure shows."""
        return text(
            "figures.variations",
            setup=self.setup.title,
            scenario=scenario_label(self.scenario),
            unvaried=self.study.unvaried,
            varied=self.study.varied,
        )

    @property
    def note(self) -> str:
        """What the numbers of the table are."""
        note = text("tables.variations", unvaried=self.study.unvaried)
        return " ".join(filter(None, [note, self.study.variations_note]))


def variations(rows: list[Row], setup: Setup, study: Study) -> list[Variations]:
    """The variations of a setup, by scenario."""
    varied = [row for row in rows if isinstance(row.get("variation"), str)]
    varied = [row for row in varied if _belongs(row, setup)]
    if not setup.owns(varied):
        return []
    names = by_hardness(str(row.get("scenario")) for row in varied)
    return [_on_scenario(varied, setup, study, name) for name in names]


def _on_scenario(
    varied: list[Row], setup: Setup, study: Study, scenario: str
) -> Variations:
    here = [row for row in varied if str(row.get("scenario")) == scenario]
    rows = {(_name(row), str(row["variation"])): row for row in here}
    rows |= {(one.name, study.unvaried): one.row(scenario) for one in setup.entries}
    levels = list(dict.fromkeys(str(row["variation"]) for row in here))
    kinds = list(dict.fromkeys(map(_kind, levels)))
    levels.sort(key=lambda level: (kinds.index(_kind(level)), _sizes(level)))
    return Variations(setup, scenario, levels, rows, study)


def _belongs(row: Row, setup: Setup) -> bool:
    same = plant_of(row) == (setup.vehicle, setup.inner_loop)
    return same and row.get("sampling") in (setup.sampling, None)


def _name(row: Row) -> str:
    """The entry of a row; an estimated e is a variation of a measured one."""
    return name_of(row | {"env": "measured"} if row.get("env") == "estimated" else row)


def _kind(level: str) -> str:
    """A level without its numbers."""
    return re.sub(r"[\d.]+", "", level)


def _sizes(level: str) -> list[float]:
    return [float(size) for size in re.findall(r"\d+(?:\.\d+)?", level)]


def variations_figure(varied: Variations) -> Figure:
    """One panel per variation: RMSE of every row with it and without it."""
    levels, entries = varied.levels, varied.setup.entries
    titles = [textwrap.fill(_typeset(level), 66 // len(levels)) for level in levels]
    figure, panels, heights = dot_panels(
        entries, lambda one: one.value(varied.scenario, "rmse_m", "mean"), titles
    )
    for axes, level in zip(panels, levels, strict=True):
        for one in entries:
            color, height = colour(one), heights[one.name]
            pair = [varied.rmse(one, name) for name in (varied.study.unvaried, level)]
            ends = [1e3 * value for value in pair if value is not None]
            bar: dict[str, Any] = {"linewidth": 1.6, "alpha": 0.45, "gid": "row"}
            axes.plot(ends, [height] * len(ends), color=color, **bar)
            for value, face in zip(pair, ("white", color), strict=True):
                if value is not None:
                    look = {"markerfacecolor": face, "markersize": 4.6, "zorder": 4}
                    dot(axes, 1e3 * value, height, color=color, **look)
    common_range(panels)
    where = scenario_label(varied.scenario)
    panels[len(panels) // 2].set_xlabel(f"lateral RMSE on {where} [mm]")
    marks = [
        sample(varied.study.unvaried, marker="o", markerfacecolor="white"),
        sample("as the title says", marker="o", color=MUTED),
    ]
    figure.legend(handles=marks, loc="outside upper left", ncols=2)
    return figure


def variations_table(varied: Variations) -> Table:
    """RMSE of every row at every level, over that of the same row without."""
    head = [f"{_typeset(level)}\n[mm]" for level in varied.columns]
    entries = varied.setup.entries
    rows = [
        [one.name, *(_cell(varied, one, level) for level in varied.columns)]
        for one in entries
    ]
    strong = [i for i, one in enumerate(entries) if one.is_main]
    return Table(["Row", *head], rows, tuple(strong))


def _typeset(level: str) -> str:
    """A level with a minus, a multiplication sign and unbreakable units."""
    signs = level.replace("-", "−").replace(" x ", " ×\u00a0")
    return re.sub(r"(?<=\d)\s+(?=%|m/s|s\b)", "\u00a0", signs)


def _cell(varied: Variations, entry: Entry, level: str) -> str:
    """The mean, the ratio, and how many episodes left the lane."""
    unvaried = varied.study.unvaried
    mean, base = (varied.rmse(entry, name) for name in (level, unvaried))
    if mean is None:
        return DASH
    ratio = f" ({number(mean / base, 2)})" if level != unvaried and base else ""
    left = dig(varied.rows.get((entry.name, level)), "departures")
    gone = f", {left} left" if is_number(left) and left else ""
    return f"{millimetres(mean)}{ratio}{gone}"
