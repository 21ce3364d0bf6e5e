"""Sentences: what the paper claims, what these results show, and who beats SFKD."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from sfkd_jax.evaluation.formats import (
    DASH,
    dig,
    is_number,
    millimetres,
    number,
    percent,
    short,
)
from sfkd_jax.evaluation.metrics import BY_NAME, Metric, Row
from sfkd_jax.paper._setups import Entry, Setup, difference, ratio, side
from sfkd_jax.paper._study import Study
from sfkd_jax.paper._tables import PREDICTIONS, bounds
from sfkd_jax.reporting.blocks import Block, Heading, Table, Text
from sfkd_jax.reporting.style import label, scenario_label

_SCORES = [
    BY_NAME[name]
    for name in (
        "rmse_m",
        "max_deviation_m",
        "rmse_after_switch_m",
        "smoothness_rad_per_s",
        "violation.v1_conformal",
        "violation.v1_conformal_radius_m",
        "violation.v2",
        "departures",
    )
]
_CONSTANTS = [*PREDICTIONS, BY_NAME["act_ms.p50"], BY_NAME["params"]]


class _Score(NamedTuple):
    """A number of every entry, smaller is better.

    Attributes:
        name: with its unit.
        value: of an entry, or None.
        shown: the same as text.
        scenario: where it is an RMSE, which has a paired interval.
    """

    name: str
    value: Callable[[Entry], Any]
    shown: Callable[[Entry], str]
    scenario: str | None = None


def claims(setups: list[Setup], study: Study) -> list[Block]:
    """The claims of the paper where it prints numbers, then ours setup by setup."""
    blocks: list[Block] = [Heading(2, "SFKD and its rivals")]
    if study.is_printed(setups):
        title = "The paper's claims, and what came out here"
        blocks = [Heading(2, title), *_printed(study)]
    for setup in setups:
        if setup.entry("sfkd") is None:
            missing = "There is no row of SFKD, so nothing is compared with it."
            blocks.append(Text(missing, f"{setup.title}."))
            continue
        blocks += [Heading(3, setup.title), *_measured(setup, study)]
    return blocks


def better_rows(setup: Setup) -> list[Block]:
    """Every score of SFKD with the rows that have less, then scores that none beats."""
    main, rows, best = setup.entry("sfkd"), [], []
    for score in _scores(setup) if main else ():
        own = score.value(main) if main else None
        if not main or not is_number(own):
            continue
        better = [
            f"{entry.name} {score.shown(entry)}{_certainty(setup, entry, score)}"
            for entry in setup.entries
            if is_number(score.value(entry)) and score.value(entry) < own
        ]
        shown = f"{score.name}: {score.shown(main)}"
        if better:
            rows.append([shown, "; ".join(better)])
        else:
            best.append(shown)
    heads = ["SFKD, where it is beaten", "Rows with less"]
    blocks: list[Block] = [Table(heads, rows, prose=True)] if rows else []
    lead = "No row has less than SFKD in:"
    return [*blocks, Text(f"{'; '.join(best)}.", lead, "note")] if best else blocks


def _certainty(setup: Setup, entry: Entry, score: _Score) -> str:
    """† where the paired difference is below zero; only RMSE has one."""
    if score.scenario is None:
        return ""
    record = difference(setup, entry, score.scenario)
    return " †" if side(record) < 0 else ""


def _scores(setup: Setup) -> Iterator[_Score]:
    for metric in _SCORES:
        for scenario in setup.scenarios:
            yield _on_scenario(metric, scenario)
    for metric in _CONSTANTS:
        kind = "prediction " if metric in PREDICTIONS else ""
        name = kind + _lower(metric.head(mm=True))
        yield _score(name, metric, lambda entry, m=metric: entry.row_with(m))


def _on_scenario(metric: Metric, scenario: str) -> _Score:
    """A metric on one scenario; of RMSE the mean."""
    where = scenario_label(scenario)
    if metric.name == "rmse_m":

        def rmse(entry: Entry) -> float | None:
            return entry.value(scenario, "rmse_m", "mean")

        def text(entry: Entry) -> str:
            return millimetres(rmse(entry))

        return _Score(f"{where} RMSE [mm]", rmse, text, scenario)
    name = f"{where} {_lower(metric.head(mm=True))}"
    return _score(name, metric, lambda entry: entry.row(scenario))


def _score(name: str, metric: Metric, row: Callable[[Entry], Row]) -> _Score:
    def text(entry: Entry) -> str:
        """Shares and radii to three digits, so that different values look different."""
        value = metric.value(row(entry))
        if metric.unit == "%" and is_number(value):
            return short(100 * value)
        if metric.name.endswith("_radius_m"):
            return short(value)
        return metric.text(row(entry), mm=True)

    return _Score(name, lambda entry: metric.value(row(entry)), text)


def _lower(text: str) -> str:
    """Text with a small first letter, unless it begins with an abbreviation."""
    return text[:1].lower() + text[1:] if text[1:2].islower() else text


def _printed(study: Study) -> list[Block]:
    """What the paper says SFKD gains."""
    gains = []
    rivals = [name for name in study.rivals if name not in study.printed_as]
    columns = dict.fromkeys(key for row in study.printed.values() for key in row)
    for rival in rivals:
        for column in columns:
            ours, theirs = (study.number(name, column) for name in ("sfkd", rival))
            rmse = column.startswith("rmse_") and column.endswith("_m")
            if rmse and is_number(ours) and is_number(theirs):
                scenario = scenario_label(column.split("_")[1])
                pair = f"{millimetres(ours, 0)} against {millimetres(theirs, 0)} mm"
                gain = f"{_change(ours, theirs)} than {label(rival)} on {scenario}"
                gains.append(f"{gain} ({pair})")
    rates = [
        f"{percent(rate)} % for {label(system)}"
        for system in ("sfkd", *rivals[:1])
        if is_number(rate := study.number(system, "violation_rate"))
    ]
    text = [f"SFKD's RMSE is {'; '.join(gains)}."] if gains else []
    text += [f"Its violation rates: {', '.join(rates)}."] if rates else []
    if not text:
        return [Text("These settings hold no numbers of the paper.")]
    return [Text(" ".join(text), "The paper.")]


def _measured(setup: Setup, study: Study) -> list[Block]:
    """One paragraph per rival, one on the oracle, one on violations."""
    main = setup.entry("sfkd")
    rivals = [
        entry
        for entry in setup.entries
        if entry.system in study.rivals and entry is not main
    ]
    blocks: list[Block] = [
        Text(_against(setup, entry), f"SFKD against {entry.name}.") for entry in rivals
    ]
    rest = {
        "Against the oracle": _oracle(setup),
        f"Violations {_where(setup.hardest)}": _violations(setup, study),
    }
    return blocks + [Text(text, f"{lead}.") for lead, text in rest.items() if text]


def _where(scenario: str) -> str:
    """The scenario with its preposition: on S3, at seen levels."""
    shown = scenario_label(scenario)
    return f"at {shown} levels" if shown == scenario else f"on {shown}"


def _against(setup: Setup, entry: Entry) -> str:
    """RMSE of SFKD beside that of a rival, with the paired difference."""
    main, hardest = setup.entry("sfkd"), setup.hardest
    ours, theirs = (
        one.value(hardest, "rmse_m", "mean") if one else None for one in (main, entry)
    )
    where = _where(hardest)
    if ours is None or theirs is None:
        return f"Not measured {where}."
    pair = f"{millimetres(ours)} against {millimetres(theirs)} mm"
    text = f"{where[:1].upper()}{where[1:]} {pair}, {_change(ours, theirs)}"
    record = difference(setup, entry, hardest)
    shown = bounds(dig(record, "ci95"))
    if shown == DASH:
        return f"{text}."
    corrected = is_number(dig(record, "p_holm"))
    verdict = {
        1: "so SFKD is better",
        -1: f"so {entry.name} is better",
        0: "undecided with Holm's correction"
        if corrected
        else "which holds zero, so it is undecided",
    }[side(record)]
    gap = f"paired difference {millimetres(dig(record, 'mean'))} mm"
    return f"{text}; {gap}, 95 % interval {shown}, {verdict}."


def _change(ours: float, theirs: float) -> str:
    """How much smaller the first number is, in percent of the second."""
    if theirs == 0:
        return "larger"
    share = 100 * (1 - ours / theirs)
    return f"{number(abs(share), 0)} % {'lower' if share >= 0 else 'higher'}"


def _oracle(setup: Setup) -> str:
    """RMSE of SFKD over that of the oracle, by scenario."""
    main = setup.entry("sfkd")
    ratios = [
        f"{number(value, 2)} {_where(name)}"
        for name in (setup.scenarios if main else [])
        if main and (value := ratio(setup, main, name)) is not None
    ]
    times = "times that of a planner with the true vehicle"
    return f"SFKD's RMSE is {', '.join(ratios)} {times}." if ratios else ""


def _violations(setup: Setup, study: Study) -> str:
    """V0, V1 and V2 of SFKD and of the main rival on the hardest scenario."""
    entries = [
        f"{entry.name}: {parts}"
        for entry in setup.entries
        if entry.system in ("sfkd", *study.rivals[:1])
        and (parts := _shares(entry.row(setup.hardest)))
    ]
    return f"{'; '.join(entries)}." if entries else ""


def _shares(row: Row) -> str:
    """The shares of violations of a row, with the radii of the tubes."""
    tubes = {
        "V0": ("v0", None),
        "V1 of the certified tube": ("v1", "v1_radius_m"),
        "V1 of the conformal tube": ("v1_conformal", "v1_conformal_radius_m"),
        "V2": ("v2", None),
    }
    parts = []
    for name, (share, radius) in tubes.items():
        metric = BY_NAME[f"violation.{share}"]
        wide = BY_NAME[f"violation.{radius}"].value(row) if radius else None
        if is_number(metric.value(row)):
            behind = f" (mean radius {short(wide)} m)" if is_number(wide) else ""
            parts.append(f"{name} {metric.text(row)} %{behind}")
    return ", ".join(parts)
