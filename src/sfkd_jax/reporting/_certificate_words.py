"""Sentences about a certificate: what is proved, what is measured, and where."""

from __future__ import annotations

from typing import Any

from sfkd_jax.reporting._blocks import Text
from sfkd_jax.reporting._numbers import (
    dig,
    interval,
    is_number,
    number,
    plain,
    short,
    upper,
)
from sfkd_jax.reporting._words import holds


def certificate_words(record: dict[str, Any]) -> list[Text]:
    """What is proved, what is measured and what is not claimed."""
    if not holds(record):
        reason = (
            plain(record.get("reason"))
            if record.get("reason")
            else "the file gives no reason"
        )
        return [
            Text(
                f"No contraction is certified for these weights: {reason}.",
                "Nothing is proved.",
            )
        ]
    boxes = "; ".join(
        f"{name}: {_box(dig(record, 'boxes', name), _axes(record, name))}"
        for name in _AXES
        if _axes(record, name)
    )
    limits = (
        f"Nothing is claimed outside the boxes in which d̄ was measured ({boxes}). The certificate says how a "
        "prediction error grows; how well the vehicle tracks is the measurement in the section above."
    )
    return [
        Text(_proved(record), "Proved."),
        Text(_measured(dig(record, "d_bar") or {}), "Measured, not proved."),
        Text(limits, "Not claimed."),
    ]


def _proved(record: dict[str, Any]) -> str:
    axes = _axes(record, "env")
    where = (
        f" with {_box(dig(record, 'boxes', 'env'), axes)}"
        if axes
        else ", which the model does not read"
    )
    alpha = upper(record["alpha"])
    text = (
        f"For every environment{where}, every control and any two latent states, one step of the "
        f"model leaves the two at most α = {alpha} times as far apart as they were. This is a "
        "bound on all of them, not an average over a sample. So an error made once fades, and errors of at "
        "most d̄ per step add up to no more than the tube Rₖ"
    )
    latent, ultimate = (
        dig(record, "tube", "latent") or [],
        dig(record, "tube", "ultimate"),
    )
    if latent:
        text += f": {upper(latent[0])} after one step, {upper(latent[-1])} after {len(latent)}"
    if is_number(ultimate):
        text += f", {upper(ultimate)} however far ahead"
    return text + "."


def _measured(bound: dict[str, Any]) -> str:
    value, level = upper(bound.get("value")), short(bound.get("level"))
    count = short(bound.get("trajectories"))
    text = (
        f"The one-step error bound d̄ = {value}, in latent units, is a conformal quantile at level {level} "
        f"over {count} calibration trajectories that training never saw; it includes the error of transport "
        "between environments."
    )
    if is_number(bound.get("coverage")):
        text += f" It covered a fraction of {number(bound['coverage'])} of held-out trajectories"
        text += f" (95 % interval {interval(bound.get('coverage_ci95'))})."
    return text


_AXES = {
    "state": (
        ("speed", " m/s"),
        ("lateral speed", " m/s"),
        ("yaw rate", " rad/s"),
        ("steering", " rad"),
    ),
    "control": (("steering", " rad"), ("acceleration or commanded speed", "")),
    "env": (("friction", ""), ("side wind", " m/s")),
}

_ALONG = _AXES | {
    "state": (("lateral deviation", " m"), ("heading error", " rad"), *_AXES["state"]),
    "control": (
        ("steering added", " rad"),
        ("drive added", ""),
        ("curvature", " 1/m"),
        ("speed asked for", " m/s"),
    ),
}


def _axes(record: dict[str, Any], box: str) -> tuple[tuple[str, str], ...]:
    """Name and unit of every side of a box: as the logs name them, or else as the benchmark's plants do."""
    named = dig(record, "boxes", "names", box)
    along = dig(record, "corridor") is not None
    return (
        (_ALONG if along else _AXES)[box]
        if named is None
        else tuple((str(name), "") for name in named)
    )


def _box(box: Any, names: tuple[tuple[str, str], ...]) -> str:
    """A box in words; it comes as [lows, highs], or else as [[low, high], …]."""
    if isinstance(box, list) and box and all(isinstance(side, list) for side in box):
        sides = list(zip(*box, strict=False)) if len(box) == 2 else []
        for pairs in (sides, box):
            if pairs and all(_rising(pair) for pair in pairs):
                known = [*names, *[("", "")] * len(pairs)]
                spans = [f"{short(low)} to {short(high)}" for low, high in pairs]
                named = zip(known, spans, strict=False)
                return ", ".join(
                    f"{name} {span}{unit}".strip() for (name, unit), span in named
                )
    return plain(box)


def _rising(pair: Any) -> bool:
    return len(pair) == 2 and all(map(is_number, pair)) and pair[0] <= pair[1]
