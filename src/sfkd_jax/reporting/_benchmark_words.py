"""Sentences: what the paper claims, what came out here, and who beats SFKD at what."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from sfkd_jax.reporting._benchmark_rows import (
    Contest,
    Line,
    difference,
    is_quoted,
    known,
    line_of,
    measure,
    ratio,
    scenarios,
    side,
    title,
)
from sfkd_jax.reporting._benchmark_tables import (
    STEPS,
    Paper,
    bounds,
    certified,
    conformal,
    millimetres,
    percent,
)
from sfkd_jax.reporting._blocks import Block, Heading, Table, Text
from sfkd_jax.reporting._numbers import DASH, dig, is_number, number, short
from sfkd_jax.reporting._style import label, scenario_label

_RIVALS = (
    "icode_mppi",
    "icode_mppi_one_step",
    "icode_mppi_reads_env",
    "sfkd_no_fiber",
    "sfkd_no_contraction",
)
"""Whom the paper's text says that SFKD beats."""

_Value = Callable[[Line], Any]


def words(found: list[Contest], paper: Paper) -> list[Block]:
    """The paper's claims, then ours contest by contest."""
    blocks: list[Block] = [Heading(2, "SFKD and its rivals")]
    if is_quoted(found, paper):
        blocks = [
            Heading(2, "The paper's claims, and what came out here"),
            *_printed(paper),
        ]
    for contest in found:
        if line_of(contest, "sfkd") is None:
            blocks.append(
                Text(
                    "SFKD was not driven, so nothing is compared with it.",
                    f"{title(contest)}.",
                    "",
                )
            )
            continue
        blocks += [Heading(3, title(contest)), *_claims(contest)]
    return blocks


def beaten(contest: Contest) -> list[Block]:
    """Every measure of SFKD with all rows that have a smaller number, then those at which nobody has."""
    own, rows, unbeaten = line_of(contest, "sfkd"), [], []
    for name, value, show, scenario in _measures(contest):
        mine = value(own) if own else None
        if not is_number(mine):
            continue
        better = [
            line
            for line in contest.lines
            if line is not own and is_number(value(line)) and value(line) < mine
        ]
        shown = [
            f"{line.name} {show(value(line))}{_certainly(contest, line, scenario)}"
            for line in better
        ]
        if shown:
            rows.append([f"{name}: {show(mine)}", "; ".join(shown)])
        else:
            unbeaten.append(f"{name}: {show(mine)}")
    blocks: list[Block] = (
        [Table(["SFKD, where it is beaten", "Rows with less"], rows, prose=True)]
        if rows
        else []
    )
    return (
        [
            *blocks,
            Text(f"{'; '.join(unbeaten)}.", "No row has less than SFKD in:", "note"),
        ]
        if unbeaten
        else blocks
    )


def _certainly(contest: Contest, line: Line, scenario: str | None) -> str:
    """† where the paired interval lies below zero; only RMSE has one."""
    found = difference(contest, line, scenario) if scenario else None
    return " †" if side(dig(found, "ci95")) < 0 else ""


def _measures(
    contest: Contest,
) -> Iterator[tuple[str, _Value, Callable[[Any], str], str | None]]:
    """Name, value, how it is written, and the scenario if it is an RMSE with a paired interval."""
    names = scenarios(contest)
    parts: list[tuple[str, Callable[[dict[str, Any]], Any], Callable[[Any], str]]] = [
        ("RMSE [mm]", lambda row: dig(row, "rmse_m", "mean"), millimetres),
        (
            "largest deviation [mm]",
            lambda row: row.get("max_deviation_m"),
            lambda value: millimetres(value, 0),
        ),
        (
            "RMSE after a switch [mm]",
            lambda row: row.get("rmse_after_switch_m"),
            millimetres,
        ),
        ("steering rate [rad/s]", lambda row: row.get("smoothness_rad_per_s"), number),
        (
            "V1, conformal tube [%]",
            lambda row: conformal(row, "v1_conformal", "v1"),
            _share,
        ),
        (
            "mean conformal radius [m]",
            lambda row: conformal(row, "v1_conformal_radius_m", "v1_radius_m"),
            short,
        ),
        ("V2 [%]", lambda row: dig(row, "violation", "v2"), _share),
        ("departures", lambda row: row.get("departures"), short),
    ]
    for name, value, show in parts:
        for scenario in names:
            paired = scenario if name == "RMSE [mm]" else None
            yield (
                f"{scenario_label(scenario)} {name}",
                _at(scenario, value),
                show,
                paired,
            )
    for step in STEPS:
        yield f"prediction, {step} ahead [mm]", _ahead(step), millimetres, None
    yield (
        "control step, median [ms]",
        lambda line: known(line, "act_ms", "p50"),
        lambda value: number(value, 2),
        None,
    )
    yield "parameters", lambda line: known(line, "params"), short, None


def _share(value: Any) -> str:
    """A share in percent to three digits, or two that differ would look the same."""
    return short(100 * value)


def _at(scenario: str, value: Callable[[dict[str, Any]], Any]) -> _Value:
    return lambda line: value(line.rows.get(scenario) or {})


def _ahead(step: str) -> _Value:
    return lambda line: known(line, "open_loop_rmse_m", step)


def _printed(paper: Paper) -> list[Block]:
    """What the paper says SFKD gains."""
    said = []
    for rival in ("icode_mppi", "sfkd_no_fiber", "sfkd_no_contraction"):
        for name in ("s2", "s3"):
            ours, theirs = (
                dig(paper.get(system), f"rmse_{name}_m") for system in ("sfkd", rival)
            )
            if is_number(ours) and is_number(theirs):
                pair = f"{millimetres(ours, 0)} against {millimetres(theirs, 0)} mm"
                said.append(
                    f"{_change(ours, theirs)} than {label(rival)} on {scenario_label(name)} ({pair})"
                )
    rates = [
        (system, dig(paper.get(system), "violation_rate"))
        for system in ("sfkd", "icode_mppi")
    ]
    told = [
        f"{percent(rate)} % for {label(system)}"
        for system, rate in rates
        if is_number(rate)
    ]
    text = [f"SFKD's RMSE is {'; '.join(said)}."] if said else []
    text += [f"Its violation rates: {', '.join(told)}."] if told else []
    return (
        [Text(" ".join(text), "The paper.")]
        if text
        else [Text("No numbers of the paper are in these settings.")]
    )


def _claims(contest: Contest) -> list[Block]:
    """One paragraph a rival, one on the oracle, one on violations."""
    own = line_of(contest, "sfkd")
    rivals = [
        line for line in contest.lines if line.system in _RIVALS and line is not own
    ]
    said: list[Block] = [
        Text(_against(contest, line), f"SFKD against {line.name}.") for line in rivals
    ]
    return said + [Text(text, f"{lead}.") for lead, text in _rest(contest) if text]


def _rest(contest: Contest) -> Iterator[tuple[str, str]]:
    yield "Against the oracle", _oracle(contest)
    yield f"Violations {_on(scenarios(contest)[-1])}", _violating(contest)


def _on(scenario: str) -> str:
    """Where: on S3, at seen levels."""
    shown = scenario_label(scenario)
    return f"at {shown} levels" if shown == scenario else f"on {shown}"


def _against(contest: Contest, line: Line) -> str:
    """SFKD's RMSE beside a rival's on the hardest scenario, in percent, with the paired difference."""
    own, hardest = line_of(contest, "sfkd"), scenarios(contest)[-1]
    ours, theirs = (
        one and measure(one, hardest, "rmse_m", "mean") for one in (own, line)
    )
    where = _on(hardest)
    if ours is None or theirs is None:
        return f"Not measured {where}."
    pair = f"{millimetres(ours)} against {millimetres(theirs)} mm"
    text = f"{where[:1].upper()}{where[1:]} {pair}, {_change(ours, theirs)}"
    found = difference(contest, line, hardest)
    shown = bounds(dig(found, "ci95"))
    if shown == DASH:
        return f"{text}."
    verdicts = {
        1: "so SFKD is better",
        -1: f"so {line.name} is better",
        0: "which holds zero, so it is undecided",
    }
    verdict = verdicts[side(dig(found, "ci95"))]
    return f"{text}; paired difference {millimetres(dig(found, 'mean'))} mm, 95 % interval {shown}, {verdict}."


def _change(ours: float, theirs: float) -> str:
    """How much smaller the first is than the second, in percent of the second."""
    if theirs == 0:
        return "larger"
    share = 100 * (1 - ours / theirs)
    return f"{number(abs(share), 0)} % {'lower' if share >= 0 else 'higher'}"


def _oracle(contest: Contest) -> str:
    own = line_of(contest, "sfkd")
    found = (
        [(name, ratio(contest, own, name)) for name in scenarios(contest)]
        if own
        else []
    )
    said = [
        f"{number(value, 2)} {_on(name)}" for name, value in found if value is not None
    ]
    return (
        f"SFKD's RMSE is {', '.join(said)} times that of a planner with the true vehicle."
        if said
        else ""
    )


def _violating(contest: Contest) -> str:
    """V0, V1 and V2 on the hardest scenario of SFKD and of the paper's main rival."""
    said = []
    for line in contest.lines:
        row = line.rows.get(scenarios(contest)[-1])
        if row is None or line.system not in ("sfkd", "icode_mppi"):
            continue
        pairs = [
            ("V0", dig(row, "violation", "v0"), None),
            (
                "V1 of the certified tube",
                certified(row, "v1"),
                certified(row, "v1_radius_m"),
            ),
            (
                "V1 of the conformal tube",
                conformal(row, "v1_conformal", "v1"),
                conformal(row, "v1_conformal_radius_m", "v1_radius_m"),
            ),
            ("V2", dig(row, "violation", "v2"), None),
        ]
        parts = [
            f"{name} {percent(share)} %"
            + (f" (mean radius {short(radius)} m)" if is_number(radius) else "")
            for name, share, radius in pairs
            if is_number(share)
        ]
        said += [f"{line.name}: {', '.join(parts)}"] if parts else []
    return f"{'; '.join(said)}." if said else ""
