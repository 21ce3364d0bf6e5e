"""Figure 2 for many rows: what side forces that nobody measures do to tracking and to what is claimed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure

from sfkd_jax.reporting._benchmark_rows import (
    Contest,
    Line,
    Row,
    drawn_for,
    measure,
    scenarios,
)
from sfkd_jax.reporting._benchmark_tables import millimetres, percent, slashed
from sfkd_jax.reporting._blocks import Table
from sfkd_jax.reporting._dots import colour, common_range, dot_panels, mark
from sfkd_jax.reporting._numbers import dig, is_number, plain, short
from sfkd_jax.reporting._violations import disturbed

_SQUARE: dict[str, Any] = {
    "marker": "s",
    "markerfacecolor": "none",
    "markersize": 5.5,
    "linestyle": "none",
}


def pushed(contest: Contest) -> tuple[str, list[Line]] | None:
    """The hardest scenario on which rows of a contest were pushed, and these rows; None where none was."""
    for name in reversed(scenarios(contest)):
        lines = [
            line for line in contest.lines if disturbed([line.rows.get(name) or {}])
        ]
        if drawn_for(contest, [line.rows[name] for line in lines]):
            return name, lines
    return None


def forces_of(scenario: str, lines: list[Line]) -> list[float]:
    """All forces that any row met [N]."""
    runs = [
        run
        for line in lines
        for run in line.rows[scenario]["disturbed"]
        if isinstance(run, dict)
    ]
    return sorted({run["force_n"] for run in runs if is_number(run.get("force_n"))})


def _at(line: Line, scenario: str, force: float) -> Row:
    runs = [run for run in line.rows[scenario]["disturbed"] if isinstance(run, dict)]
    return next((run for run in runs if run.get("force_n") == force), {})


def _certified(line: Line, scenario: str, key: str) -> Callable[[Row], Any]:
    """A measure of a pushed row, None without a certificate."""
    kind = dig(line.rows[scenario], "violation", "v1_tube")
    return lambda run: run.get(key) if kind == "certified" else None


def forces_tables(scenario: str, lines: list[Line]) -> tuple[Table, Table]:
    """Every row at every force: RMSE and who left the lane, then what became of the claims."""
    forces = forces_of(scenario, lines)

    def each(
        line: Line, show: Callable[[Any], str], value: Callable[[Row], Any]
    ) -> str:
        return slashed([show(value(_at(line, scenario, force))) for force in forces])

    def rmse(line: Line, force: float) -> str:
        return millimetres(dig(_at(line, scenario, force), "rmse_m", "mean"))

    tracked = [
        [
            line.name,
            *(rmse(line, force) for force in forces),
            each(line, short, lambda run: run.get("departures")),
        ]
        for line in lines
    ]
    claimed = [
        [
            line.name,
            each(line, percent, _certified(line, scenario, "v0")),
            each(line, percent, _certified(line, scenario, "v1")),
            each(line, percent, lambda run: run.get("v1_conformal")),
            each(line, percent, lambda run: run.get("v2")),
        ]
        for line in lines
    ]
    strong = tuple(
        place
        for place, line in enumerate(lines)
        if line.system == "sfkd" and line.env == "measured"
    )
    head = [f"RMSE [mm]\n{plain(force)} N" for force in forces]
    shares = [
        "V0, theorem\n[%]",
        "V1, certified\ntube [%]",
        "V1, conformal\ntube [%]",
        "V2, threshold\n[%]",
    ]
    return Table(["Row", *head, "Left the\nlane"], tracked, strong), Table(
        ["Row", *shares], claimed, strong
    )


def forces_figure(scenario: str, lines: list[Line]) -> Figure:
    """Four panels: RMSE, V1 and V2 at every force, the marker growing with it, and the width of the tubes."""
    forces = forces_of(scenario, lines)

    def score(line: Line) -> float | None:
        return measure(line, scenario, "rmse_m", "mean")

    titles = [
        "RMSE",
        "V1: segments\noutside the tube",
        "V2: beyond\nthe threshold",
        "mean radius\nof the tube",
    ]
    figure, panels, places = dot_panels(lines, score, titles)
    values: list[Callable[[Row], Any]] = [
        lambda run: _scaled(dig(run, "rmse_m", "mean"), 1e3),
        lambda run: _scaled(run.get("v1_conformal"), 1e2),
        lambda run: _scaled(run.get("v2"), 1e2),
    ]
    for line in lines:
        for axes, value in zip(panels, values, strict=False):
            _grow(
                axes,
                [value(_at(line, scenario, force)) for force in forces],
                places[line.name],
                colour(line),
            )
        certified = [
            _certified(line, scenario, "v1")(_at(line, scenario, force))
            for force in forces
        ]
        shares = [100 * share for share in certified if is_number(share)]
        panels[1].plot(
            shares[-1:],
            [places[line.name]] * len(shares[-1:]),
            color=colour(line),
            zorder=5,
            **_SQUARE,
        )
        _radii(panels[3], line.rows[scenario], places[line.name], colour(line))
    for axes in panels[1:3]:
        axes.set(xlim=(-8, 108), xticks=[0, 50, 100], xlabel="[%]")
    for axes, unit in ((panels[0], "[mm]"), (panels[3], "[m]")):
        common_range([axes])
        axes.set_xlabel(unit)
    marks = [
        mark(f"{plain(force)} N", marker="o", markersize=_size(place))
        for place, force in enumerate(forces)
    ]
    marks.append(mark("certified tube, at the largest force", **_SQUARE))
    figure.legend(
        handles=marks,
        loc="outside upper left",
        ncols=5,
        columnspacing=1.2,
        handletextpad=0.4,
    )
    return figure


def _size(place: int) -> float:
    return 2.4 + 1.1 * place


def _grow(axes: Any, values: list[Any], height: float, ink: str) -> None:
    """One marker a force, larger with it, on a line."""
    shown = [(place, value) for place, value in enumerate(values) if is_number(value)]
    axes.plot(
        [value for _, value in shown],
        [height] * len(shown),
        color=ink,
        linewidth=1.2,
        alpha=0.5,
        gid="row",
    )
    for place, value in shown:
        axes.plot(
            value,
            height,
            marker="o",
            color=ink,
            markersize=_size(place),
            markeredgewidth=0,
            alpha=0.8,
            zorder=4,
        )


def _radii(axes: Any, row: Row, height: float, ink: str) -> None:
    conformal, certified = (
        dig(row, "violation", key) for key in ("v1_conformal_radius_m", "v1_radius_m")
    )
    if is_number(conformal):
        axes.plot(
            conformal,
            height,
            marker="o",
            color=ink,
            markersize=4.5,
            linestyle="none",
            gid="row",
        )
    if dig(row, "violation", "v1_tube") == "certified" and is_number(certified):
        axes.plot(certified, height, color=ink, gid="row", **_SQUARE)


def _scaled(value: Any, factor: float) -> float | None:
    return factor * value if is_number(value) else None
