"""Numbers as finished strings: closed loop, certificate, open loop, settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sfkd_jax.reporting._benchmark_rows import name_of, search_words
from sfkd_jax.reporting._benchmark_tables import certified, percent
from sfkd_jax.reporting._blocks import Table
from sfkd_jax.reporting._numbers import (
    DASH,
    dig,
    interval,
    is_number,
    mean_std,
    number,
    plain,
    short,
    upper,
)
from sfkd_jax.reporting._style import ordered, scenario_label

PAPER_RMSE_M = {"s2": (0.098, 0.014), "s3": (0.120, 0.018)}
"""Mean and standard deviation that the paper reports for SFKD, by scenario; its
simulator is another one.
"""

_SEES = {"measured": "measured", "estimated": "estimated", "none": "no"}


def blocks_of(rows: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Closed-loop rows that may be compared: one list per scenario, vehicle, sampling, controller and planner.

    A row without sampling (its controller draws none) stands in every block of its
    scenario and vehicle.
    """
    where = ("scenario", "vehicle", "inner_loop")
    places = sorted({tuple(str(row.get(key)) for key in where) for row in rows})
    found = []
    for place in places:
        here = [
            row for row in rows if tuple(str(row.get(key)) for key in where) == place
        ]
        kinds = {
            (row["sampling"], search_words(row)) for row in here if row.get("sampling")
        }
        for kind in sorted(kinds) or [None]:
            block = [
                row
                for row in here
                if not row.get("sampling")
                or (row["sampling"], search_words(row)) == kind
            ]
            rank = {
                name: index
                for index, name in enumerate(
                    ordered({str(r.get("system")) for r in block})
                )
            }
            found.append(sorted(block, key=lambda row: rank[str(row.get("system"))]))
    return found


def block_title(block: list[dict[str, Any]]) -> str:
    """What a block of rows has in common, in words."""
    row = block[0]
    way = search_words(next((r for r in block if r.get("sampling")), {}))
    parts = [f"Scenario {scenario_label(str(row.get('scenario')))}"]
    if row.get("vehicle"):
        loop = " under a speed loop" if row.get("inner_loop") == "speed" else ""
        parts.append(f"{row['vehicle']} vehicle{loop}")
    if way:
        parts.append(way)
    if is_number(row.get("episodes")):
        length = (
            f" of {short(row['episode_s'])} s"
            if is_number(row.get("episode_s"))
            else ""
        )
        parts.append(f"{short(row['episodes'])} episodes{length}")
    return ", ".join(parts)


_MAIN: dict[str, Callable[[dict[str, Any]], str]] = {
    "System": name_of,
    "RMSE [m]\nmean ± std": lambda row: mean_std(row.get("rmse_m")),
    "RMSE over\noracle": lambda row: number(row.get("ratio_to_oracle"), 2),
    "95 % interval\n[m]": lambda row: interval(dig(row, "rmse_m", "ci95")),
    "Largest\n[m]": lambda row: number(row.get("max_deviation_m")),
    "Steering rate\n[rad/s]": lambda row: number(row.get("smoothness_rad_per_s")),
    "Sees\nμ, w": lambda row: _SEES.get(str(row.get("env")), DASH),
}

_MORE: dict[str, Callable[[dict[str, Any]], str]] = {
    "System": _MAIN["System"],
    "Median\n[m]": lambda row: number(dig(row, "rmse_m", "median")),
    "95th perc.\n[m]": lambda row: number(dig(row, "rmse_m", "p95")),
    "After a\nswitch [m]": lambda row: number(row.get("rmse_after_switch_m")),
    "RMSE minus\nSFKD [m]": lambda row: number(
        dig(row, "difference_to_sfkd", "mean"), 4
    ),
    "its 95 %\ninterval [m]": lambda row: interval(
        dig(row, "difference_to_sfkd", "ci95"), 4
    ),
    "Left the\nlane": lambda row: short(row.get("departures")),
    "Parameters": lambda row: short(row.get("params")),
}

_PLANNER: dict[str, Callable[[dict[str, Any]], str]] = {
    "System": _MAIN["System"],
    "Effective\nsamples": lambda row: number(row.get("ess"), 0),
    "Control step,\nmedian [ms]": lambda row: number(dig(row, "act_ms", "p50"), 2),
    "Control step,\n99 % [ms]": lambda row: number(dig(row, "act_ms", "p99"), 2),
    "Plan held,\nsteps [%]": lambda row: percent(row.get("unhealthy_steps")),
}


def closed_loop(block: list[dict[str, Any]]) -> Table:
    """The score of each system of a block, SFKD stressed."""
    return _table(_MAIN, block)


def closed_loop_more(block: list[dict[str, Any]]) -> Table:
    """The remaining measures of a block."""
    return _measured(_MORE, block)


def planner_table(block: list[dict[str, Any]]) -> Table:
    """What the planner of each system of a block made of its samples, and what a control step takes."""
    return _measured(_PLANNER, block)


def _measured(
    columns: dict[str, Callable[[dict[str, Any]], str]], block: list[dict[str, Any]]
) -> Table:
    """A table in which a measure that no row has gets no column."""
    known = {
        name
        for name, cell in columns.items()
        if name == "System" or any(cell(row) != DASH for row in block)
    }
    return _table(
        {name: cell for name, cell in columns.items() if name in known}, block
    )


def violation_table(block: list[dict[str, Any]]) -> Table:
    """How often each system of a block left what is claimed about its predictions, and how wide the claim is."""
    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "System": _MAIN["System"],
        "V0, theorem\n[%]": lambda row: percent(dig(row, "violation", "v0")),
        "V1, certified\ntube [%]": lambda row: percent(certified(row, "v1")),
        "its mean\nradius [m]": lambda row: number(certified(row, "v1_radius_m")),
        "V1, conformal\ntube [%]": lambda row: percent(
            dig(row, "violation", "v1_conformal")
        ),
        "mean radius\nof that [m]": lambda row: number(
            dig(row, "violation", "v1_conformal_radius_m")
        ),
        "V2, threshold\n[%]": lambda row: percent(dig(row, "violation", "v2")),
    }
    return _table(columns, block)


def _table(
    columns: dict[str, Callable[[dict[str, Any]], str]], block: list[dict[str, Any]]
) -> Table:
    strong = tuple(place for place, row in enumerate(block) if name_of(row) == "SFKD")
    return Table(
        list(columns),
        [[cell(row) for cell in columns.values()] for row in block],
        strong,
    )


def open_loop_table(errors: dict[str, Any]) -> Table:
    """Prediction error at 1, 5, 10 and 20 steps, or as far as the artefact reaches."""
    keys = {
        "Position\n[m]": "position_rmse_m",
        "Along\n[m]": "longitudinal_rmse_m",
        "Across\n[m]": "lateral_rmse_m",
        "Yaw\n[rad]": "yaw_rmse_rad",
        "Speed\n[m/s]": "speed_rmse_m_per_s",
    }
    steps = errors["steps"]
    rows = []
    for step in (1, 5, 10, 20):
        if step not in steps:
            continue
        place = steps.index(step)
        columns = [errors.get(key) or [] for key in keys.values()]
        cells = [
            number(values[place], 4) if place < len(values) else DASH
            for values in columns
        ]
        rows.append(
            [
                str(step),
                number(step * errors["dt"] if is_number(errors.get("dt")) else None, 1),
                *cells,
            ]
        )
    return Table(["Steps\nahead", "Seconds\nahead", *keys], rows)


def certificate_table(record: dict[str, Any]) -> Table:
    """Every number of the certificate, with what it is."""
    tube = dig(record, "tube", "latent") or []
    rows = [
        ["α, contraction of one step", upper(record.get("alpha"))],
        ["ρ + β, the separate bounds added", upper(record.get("alpha_separate"))],
        ["ρ, norm of A(e)", upper(record.get("rho"))],
        ["β, Lipschitz constant of the residual", upper(record.get("beta"))],
        ["κ, condition number of P", plain(record.get("kappa"))],
        ["Lipschitz constant of the decoder", _bound(record.get("decoder_lipschitz"))],
        ["Lipschitz constant of the transport", _bound(record.get("transport_lipschitz"))],
        ["d̄, one-step error (measured)", upper(dig(record, "d_bar", "value"))],
        [f"Latent radius after 1 and {len(tube)} steps" if tube else "Latent radius",
         f"{upper(tube[0])}, {upper(tube[-1])}" if tube else DASH],
        ["Ultimate bound d̄ / (1 − α)", upper(dig(record, "tube", "ultimate"))],
        ["Physical radius at the last step", _physical(dig(record, "tube", "physical"))],
        ["Attack: largest contraction factor found", plain(record.get("attack"))],
        ["Tightness, bound over attack", plain(record.get("tightness"))],
        ["Mode", plain(record.get("mode"))],
        ["Scope", plain(record.get("scope"))],
        ["SHA-256 of the weights", plain(record.get("weights_sha256"))],
        ["Time to certify [s]", short(record.get("seconds"))],
    ]  # fmt: skip
    return Table(["Quantity", "Value"], rows, prose=True)


_UNITS = {"position_m": "position [m]", "yaw_rad": "yaw [rad]", "body": "body state"}


def _physical(tube: Any) -> str:
    """The last radius of each physical quantity."""
    parts = (
        {"": tube} if isinstance(tube, list) else tube if isinstance(tube, dict) else {}
    )
    last = [
        (name, radii[-1])
        for name, radii in parts.items()
        if isinstance(radii, list) and radii
    ]
    return (
        "; ".join(
            f"{_UNITS.get(name, name)} {_bound(radius)}".strip()
            for name, radius in last
        )
        or DASH
    )


def _bound(value: Any) -> str:
    return upper(value) if is_number(value) else plain(value)


def settings_table(settings: dict[str, Any]) -> Table:
    """The settings of a run, one row per group."""
    rows = [[str(group), plain(value)] for group, value in settings.items()]
    return Table(["Group", "Settings"], rows, prose=True)
