"""Unmeasured side forces: their effect on tracking and on the claims."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from sfkd_jax.evaluation.formats import (
    dig,
    is_number,
    millimetres,
    percent,
    plain,
    short,
)
from sfkd_jax.evaluation.metrics import BY_NAME, Row
from sfkd_jax.paper._dots import colour, common_range, dot, dot_panels, sample
from sfkd_jax.paper._setups import Entry, Setup
from sfkd_jax.paper._side_forces import disturbed
from sfkd_jax.paper._tables import slashed
from sfkd_jax.paper._texts import text
from sfkd_jax.reporting.blocks import Table
from sfkd_jax.reporting.style import scenario_label

_SQUARE: dict[str, Any] = {"marker": "s", "markerfacecolor": "none", "markersize": 5.5}
_CERTIFIED = ("v0", "v1")
"""Claims of rows with a certificate."""


class Forces(NamedTuple):
    """The entries of a setup that were simulated under side forces.

    Attributes:
        setup: of the entries.
        scenario: the hardest one with side forces.
        entries: with side forces.
    """

    setup: Setup
    scenario: str
    entries: list[Entry]

    @property
    def sizes(self) -> list[float]:
        """All forces [N]."""
        runs = [run for one in self.entries for run in self.runs(one)]
        return sorted({run["force_n"] for run in runs if is_number(run.get("force_n"))})

    def runs(self, entry: Entry) -> list[Row]:
        """The runs of an entry, one per force."""
        runs = entry.rows[self.scenario]["disturbed"]
        return [run for run in runs if isinstance(run, dict)]

    def values(self, entry: Entry, *keys: str) -> list[Any]:
        """A value of an entry at every force; None for V0 without a certificate."""
        kind = dig(entry.rows[self.scenario], "violation", "v1_tube")
        hidden = keys[0] in _CERTIFIED and kind != "certified"
        runs = self.runs(entry)
        at = [
            next((run for run in runs if run.get("force_n") == size), {})
            for size in self.sizes
        ]
        return [None if hidden else dig(run, *keys) for run in at]

    @property
    def caption(self) -> str:
        """What the figure shows."""
        where = scenario_label(self.scenario)
        return text("figures.forces", setup=self.setup.title, scenario=where)

    @property
    def note(self) -> str:
        """What the numbers of the tables are."""
        return text("tables.forces", forces=slashed(list(map(plain, self.sizes))))


def forces_of(setup: Setup) -> Forces | None:
    """The entries under side forces on the hardest scenario that has any."""
    for name in reversed(setup.scenarios):
        entries = [one for one in setup.entries if disturbed([one.row(name)])]
        if setup.owns([one.rows[name] for one in entries]):
            return Forces(setup, name, entries)
    return None


def forces_tables(forces: Forces) -> tuple[Table, Table]:
    """Tracking and departures of every entry at every force, then its claims."""

    def each(entry: Entry, key: str, write: Callable[[Any], str]) -> str:
        return slashed([write(value) for value in forces.values(entry, key)])

    tracked = [
        [
            one.name,
            *(millimetres(value) for value in forces.values(one, "rmse_m", "mean")),
            each(one, "departures", short),
        ]
        for one in forces.entries
    ]
    claims = ("v0", "v1", "v1_conformal", "v2")
    claimed = [
        [one.name, *(each(one, key, percent) for key in claims)]
        for one in forces.entries
    ]
    strong = tuple(i for i, one in enumerate(forces.entries) if one.is_main)
    heads = [f"RMSE [mm]\n{plain(size)} N" for size in forces.sizes]
    shares = [BY_NAME[f"violation.{key}"].head() for key in claims]
    return (
        Table(["Row", *heads, BY_NAME["departures"].head()], tracked, strong),
        Table(["Row", *shares], claimed, strong),
    )


def forces_figure(forces: Forces) -> Figure:
    """RMSE, V1 and V2 at every force, and the radii of the tubes."""
    titles = [
        "RMSE",
        "V1: segments\noutside the tube",
        "V2: beyond\nthe threshold",
        "mean radius\nof the tube",
    ]
    figure, panels, heights = dot_panels(
        forces.entries, lambda one: one.value(forces.scenario, "rmse_m", "mean"), titles
    )
    for one in forces.entries:
        height, color = heights[one.name], colour(one)
        _grow(
            panels[0], _scaled(forces.values(one, "rmse_m", "mean"), 1e3), height, color
        )
        _grow(
            panels[1], _scaled(forces.values(one, "v1_conformal"), 1e2), height, color
        )
        _grow(panels[2], _scaled(forces.values(one, "v2"), 1e2), height, color)
        certified = [x for x in _scaled(forces.values(one, "v1"), 1e2) if x is not None]
        for share in certified[-1:]:
            dot(panels[1], share, height, color=color, zorder=5, **_SQUARE)
        _radii(panels[3], one.rows[forces.scenario], height, color)
    for axes in panels[1:3]:
        axes.set(xlim=(-8, 108), xticks=[0, 50, 100], xlabel="[%]")
    for axes, unit in ((panels[0], "[mm]"), (panels[3], "[m]")):
        common_range([axes])
        axes.set_xlabel(unit)
    marks = [
        sample(f"{plain(size)} N", marker="o", markersize=_size(i))
        for i, size in enumerate(forces.sizes)
    ]
    marks.append(sample("certified tube, at the largest force", **_SQUARE))
    spacing = {"columnspacing": 1.2, "handletextpad": 0.4}
    figure.legend(handles=marks, loc="outside upper left", ncols=5, **spacing)
    return figure


def _size(index: int) -> float:
    return 2.4 + 1.1 * index


def _grow(axes: Any, values: list[float | None], height: float, color: str) -> None:
    """Draw one mark per force, larger with it, on a line."""
    shown = [(i, value) for i, value in enumerate(values) if value is not None]
    line: dict[str, Any] = {"linewidth": 1.2, "alpha": 0.5, "gid": "row"}
    axes.plot([value for _, value in shown], [height] * len(shown), color=color, **line)
    for i, value in shown:
        look = {"markersize": _size(i), "markeredgewidth": 0, "alpha": 0.8}
        dot(axes, value, height, color=color, zorder=4, **look)


def _radii(axes: Any, row: Row, height: float, color: str) -> None:
    """Draw the mean radii of the tubes of a row."""
    conformal, own, kind = (
        dig(row, "violation", key)
        for key in ("v1_conformal_radius_m", "v1_radius_m", "v1_tube")
    )
    if is_number(conformal):
        dot(axes, conformal, height, color=color, markersize=4.5, gid="row")
    if kind == "certified" and is_number(own):
        dot(axes, own, height, color=color, gid="row", **_SQUARE)


def _scaled(values: list[Any], factor: float) -> list[float | None]:
    return [factor * value if is_number(value) else None for value in values]
