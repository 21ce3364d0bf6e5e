"""The paragraph on a sweep: its curves in words, with numbers of the records."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sfkd_jax.evaluation.formats import (
    dig,
    is_number,
    is_pair,
    number,
    plain,
    short,
    upper,
)
from sfkd_jax.paper._sweep_figure import title_of
from sfkd_jax.paper._sweep_records import Record, curves, scenario_of, steps_of
from sfkd_jax.reporting.style import scenario_label
from sfkd_jax.reporting.texts import load_texts

FILE = Path(__file__).with_name("sweep.toml")
text = load_texts(FILE)


def paragraph(records: list[Record]) -> str:
    """The ends of each curve, the gain of the joint bound, the best β, and refusals."""
    sentences = [text("text.compared", count=_runs(len(records)))]
    for line in curves(records):
        sentences += _along(line, records)
    sentences += [*_joint(records), *_chosen(records)]
    missing = sum(record["reason"] is not None for record in records)
    if missing:
        sentences.append(text("text.refused", count=_runs(missing)))
    return " ".join(sentences)


def _along(line: list[Record], records: list[Record]) -> list[str]:
    """The first and the last point of a curve, measure by measure."""
    scenario, first, last = str(scenario_of(records)), line[0], line[-1]
    ahead, horizon = steps_of(records, "open_loop"), steps_of(records, "tube")
    error = _change(first, last, "open_loop", "position_rmse_m", unit=" m")
    driven = _change(first, last, "closed_loop", scenario, "rmse_m", "mean", unit=" m")
    driven += _overlap(first, last, scenario) if driven else ""
    parts = {
        f"the position error after {ahead} steps": error,
        f"the lateral RMSE on {scenario_label(scenario)}": driven,
        f"the latent tube after {horizon} steps": _change(
            first, last, "tube", "latent", write=upper
        ),
        "the ultimate bound": _change(first, last, "ultimate", write=upper),
    }
    known = [f"{name} {change}" for name, change in parts.items() if change]
    title = title_of(first, records)
    where = f"{title[:1].upper()}{title[1:]}, β = {plain(first['beta'])}"
    low, high = upper(first["alpha"]), upper(last["alpha"])
    ends = f"at certified α = {low}"
    if first is not last:
        ends = f"from certified α = {low} to {high}"
    return [f"{where}: {ends}, {_listed(known)}."] if known else []


def _change(
    first: Record,
    last: Record,
    *keys: str,
    unit: str = "",
    write: Callable[[Any], str] = short,
) -> str:
    """One measure at both ends; empty if either is unknown."""
    ends = dig(first, *keys), dig(last, *keys)
    if not all(map(is_number, ends)):
        return ""
    low, high = map(write, ends)
    return f"is {low}{unit}" if first is last else f"goes from {low} to {high}{unit}"


def _overlap(first: Record, last: Record, scenario: str) -> str:
    """Whether the intervals of both RMSEs share a value."""
    keys = "closed_loop", scenario, "rmse_m", "ci95"
    pairs = [dig(record, *keys) for record in (first, last)]
    if first is last or not all(map(is_pair, pairs)):
        return ""
    (low, high), (other_low, other_high) = pairs
    shared = max(low, other_low) <= min(high, other_high)
    return f" (95 % intervals {'overlap' if shared else 'do not overlap'})"


def _joint(records: list[Record]) -> list[str]:
    """The gain of bounding the step as one map."""
    bounds = [
        (record["ultimate_separate"], record["ultimate"])
        for record in records
        if is_number(record["alpha_joint"])
    ]
    ratios = sorted(a / b for a, b in bounds if is_number(a) and is_number(b))
    if not ratios:
        return []
    ends = dict.fromkeys(number(ratio, 2) for ratio in (ratios[0], ratios[-1]))
    count = _runs(len(ratios))
    return [text("text.joint", span=" to ".join(ends), count=count)]


def _chosen(records: list[Record]) -> list[str]:
    """The best β on validation drives, for each ρ + β with several."""
    best = [record for record in records if record["smallest_of_its_betas"]]
    choices = [
        text(
            "text.choice",
            beta=record["beta"],
            sum=record["rho"] + record["beta"],
            title=title_of(record, records),
        )
        for record in best
    ]
    return [text("text.chosen", choices=_listed(choices))] if choices else []


def _runs(count: int) -> str:
    return f"{count} run{'s' if count != 1 else ''}"


def _listed(words: list[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
