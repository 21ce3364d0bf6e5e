"""One paragraph on many runs: what the curve shows, with numbers from the records alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sfkd_jax.evaluation.formats import (
    DASH,
    dig,
    interval,
    is_number,
    number,
    plain,
    short,
    upper,
)
from sfkd_jax.paper._sweep_figure import title_of
from sfkd_jax.paper._sweep_records import Record, curves, scenario_of, steps_of
from sfkd_jax.reporting.style import scenario_label


def paragraph(records: list[Record]) -> str:
    """From the smallest certified α of each curve to its largest; what the joint bound gains; which β; what failed."""
    sentences = [f"This page compares {_runs(len(records))}."]
    for line in curves(records):
        sentences += _along(line, records)
    sentences += [*_joint(records), *_chosen(records)]
    missing = sum(record["reason"] is not None for record in records)
    if missing:
        sentences.append(
            f"Without a certificate: {_runs(missing)}, for reasons that are given below."
        )
    return " ".join(sentences)


def _along(line: list[Record], records: list[Record]) -> list[str]:
    """The first and the last point of a curve, measure by measure."""
    scenario, first, last = str(scenario_of(records)), line[0], line[-1]
    ahead, horizon = steps_of(records, "open_loop"), steps_of(records, "tube")
    driven = _change(first, last, "closed_loop", scenario, "rmse_m", "mean", unit=" m")
    parts = {
        f"the position error after {ahead} steps": _change(
            first, last, "open_loop", "position_rmse_m", unit=" m"
        ),
        f"the lateral RMSE on {scenario_label(scenario)}": driven
        and driven + _overlap(first, last, scenario),
        f"the latent tube after {horizon} steps": _change(
            first, last, "tube", "latent", write=upper
        ),
        "the ultimate bound": _change(first, last, "ultimate", write=upper),
    }
    known = [f"{name} {change}" for name, change in parts.items() if change]
    if not known:
        return []
    where = f"{_capital(title_of(first, records))}, β = {plain(first['beta'])}"
    if first is last:
        return [f"{where}: at certified α = {upper(first['alpha'])}, {_listed(known)}."]
    return [
        f"{where}: from certified α = {upper(first['alpha'])} to {upper(last['alpha'])}, {_listed(known)}."
    ]


def _change(
    first: Record,
    last: Record,
    *keys: str,
    unit: str = "",
    write: Callable[[Any], str] = short,
) -> str:
    """One measure at both ends, or nothing if either is unknown."""
    ends = dig(first, *keys), dig(last, *keys)
    if not all(map(is_number, ends)):
        return ""
    low, high = map(write, ends)
    return f"is {low}{unit}" if first is last else f"goes from {low} to {high}{unit}"


def _overlap(first: Record, last: Record, scenario: str) -> str:
    """Whether the intervals of both RMSEs share a value."""
    pairs = [
        dig(record, "closed_loop", scenario, "rmse_m", "ci95")
        for record in (first, last)
    ]
    if first is last or any(interval(pair) == DASH for pair in pairs):
        return ""
    (low, high), (other_low, other_high) = pairs
    shared = max(low, other_low) <= min(high, other_high)
    return f" (95 % intervals {'overlap' if shared else 'do not overlap'})"


def _joint(records: list[Record]) -> list[str]:
    """What is gained by bounding the step as one map."""
    pairs = [
        (record["ultimate"], record["ultimate_separate"])
        for record in records
        if is_number(record["alpha_joint"])
    ]
    ratios = sorted(
        separate / ultimate
        for ultimate, separate in pairs
        if is_number(separate) and is_number(ultimate)
    )
    if not ratios:
        return []
    span = _span(ratios)
    return [
        f"Bounding the whole step as one map divides the ultimate bound of ρ + β by {span} ({_runs(len(ratios))})."
    ]


def _span(ratios: list[float]) -> str:
    low, high = number(ratios[0], 2), number(ratios[-1], 2)
    return low if low == high else f"{low} to {high}"


def _chosen(records: list[Record]) -> list[str]:
    """The β with the smallest ultimate bound on validation drives, for each ρ + β at which there are several."""
    best = [record for record in records if record["smallest_of_its_betas"]]
    words = [
        f"β = {plain(record['beta'])} for ρ + β = {plain(record['rho'] + record['beta'])} ({title_of(record, records)})"
        for record in best
    ]
    return (
        [f"On validation drives the ultimate bound is smallest with {_listed(words)}."]
        if words
        else []
    )


def _runs(count: int) -> str:
    return f"{count} run{'s' if count != 1 else ''}"


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
