"""What a setting may be: checked when a command is composed, before anything is made from it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

LARGEST_INT, LARGEST_FLOAT = 2**31 - 1, 3e38
"""What int32 and float32 hold."""
_PLANTS = "mass yaw_inertia front_length rear_length front_stiffness rear_stiffness steering_lag steering_rate"
_INTERVALS = {
    "(-inf, inf)": "vehicle.wind_lever vehicle.control_low vehicle.control_high dataset.env_low dataset.env_high "
    "evaluation.env_sensor.bias",
    "[0, inf)": "seed dataset.seed evaluation.seed comparison.seeds comparison.share evaluation.timed_steps "
    "demo.timed_steps certification.attack_starts model.environment_degree model.forcing_hidden "
    "*.num_proposals *.smoothing_window "
    "*.smoothing_order *.chunk",
    "(0, inf)": f"{' '.join(f'vehicle.{name}' for name in _PLANTS.split())} vehicle.dt vehicle.creep_speed "
    "vehicle.wheelbase vehicle.speed_gain scenario.speed scenario.wavelengths dataset.speed dataset.gap "
    "dataset.wavelengths dataset.steering_excitation dataset.speed_excitation model.rate model.ridges "
    "model.lateral_range model.heading_range model.curvature_range *.temperature *.noise_std "
    "controller.task.control_rate controller.model_law.steering controller.model_law.drive "
    "controller.estimator.model_error "
    "training.learning_rate training.clip_norm evaluation.threshold_m dataset.peak_curvature "
    "dataset.lateral_acceleration dataset.law.lateral_acceleration dataset.law.perturbation dataset.law.speed "
    "dataset.law.curvature dataset.law.drive certification.corridor.dwell",
    "(0, 1)": "dataset.shares model.rho model.beta model.alpha certification.level certification.monitor_level "
    "controller.gradient.shrink",
    "[0, 1)": "certification.margin",
    "(0, 1]": "*.risk_level controller.monitor.slow_factor training.data_share",
    "[0, 1]": "*.noise_correlation controller.mppi.adapt",
    "(1, inf)": "controller.estimator.dwell",
    # What settles at the start is not scored.
    "(2, inf)": "evaluation.episode_s demo.episode_s certification.corridor.duration",
    "[2, inf)": "controller.*.horizon model.horizon controller.gradient.steps controller.estimator.points "
    "*.noise_knots dataset.law.points",
    "[4, inf)": "dataset.segments",
}
_ENTRIES = {
    2: "scenario.wavelengths dataset.speed dataset.steering_excitation dataset.speed_excitation *.noise_std "
    "controller.task.control_rate evaluation.env_sensor.noise evaluation.env_sensor.bias comparison.share "
    "dataset.law.speed dataset.law.perturbation dataset.wavelengths "
    "certification.corridor.dwell",
    3: "dataset.law.points",
    4: "dataset.shares",
}
_RISING = {
    "scenario.wavelengths",
    "dataset.wavelengths",
    "dataset.speed",
    "dataset.law.speed",
    "dataset.steering_excitation",
    "dataset.speed_excitation",
    "certification.corridor.dwell",
}
_EMPTY = {
    "vehicle.control_low",
    "vehicle.control_high",
    "dataset.columns.environment",
    "evaluation.side_forces",
    "training.loss.tube",
    "evaluation.observation_noise",
    "export.iree_flags",
    "comparison.vehicles",
    "comparison.seeds",
    "comparison.only",
}
_PAIRS = (
    ("dataset.env_low", "dataset.env_high"),
    ("vehicle.control_low", "vehicle.control_high"),
)
_BOXES = {name for pair in _PAIRS for name in pair}
_FOLDERS = ("name", "model.system", "comparison.policies")
"""Settings that become folders below `root`."""
_LABELS = ("comparison.rows", "comparison.variations", "comparison.own_controllers")
"""Mappings whose keys become files or folders there."""
_KINDS = {
    int: "seed demo.episodes demo.timed_steps comparison.share",
    float: "demo.episode_s controller.task.control_rate dataset.env_low dataset.env_high",
    str: "name root env_source report.compare vehicle.step controller.sampling evaluation.variation dataset.columns.drive "
    "comparison.rows.* comparison.variations.* comparison.own_controllers.*",
}
"""Kinds of settings that no schema knows, or that may be null."""
_NULL = (
    "report.compare vehicle.step controller.sampling evaluation.variation dataset.columns.drive comparison.share "
    "controller.task.control_rate dataset.env_low dataset.env_high comparison.rows.* comparison.variations.* "
    "comparison.own_controllers.*"
)
_REQUIRED = (
    "seed",
    "name",
    "root",
    "env_source",
    "demo.episodes",
    "demo.episode_s",
    "demo.timed_steps",
)
_WORDS = {int: "a whole number", float: "a number", str: "words"}


class Rule(NamedTuple):
    """What one setting may be.

    Attributes:
        interval: of its numbers, as it is said.
        entries: how many if it is a list, None for at least one.
        kind: of it or its entries; None where a schema has checked that.
    """

    interval: str | None
    entries: int | None
    kind: type | None


def check(settings: Mapping[str, Any]) -> None:
    """Refuse the first setting that cannot be meant.

    A whole number is at least 1, another number finite and at least 0, a list or a word
    not empty, unless the tables of this file say otherwise.

    Args:
        settings: composed, nested, plain.

    Raises:
        ValueError: the setting, what it may be, and what it is.
    """
    flat = dict(_leaves(settings))
    for name, value in (dict.fromkeys(_REQUIRED) | flat).items():
        rule = rule_of(name)
        if said := _wrong(name, value, rule):
            raise ValueError(f"{name} must be {said}, got {value!r}")
    for name in _FOLDERS:
        if isinstance(flat.get(name), str) and not is_below(flat[name]):
            raise ValueError(
                f"{name} must be a path below root without '..', empty parts or \\, got {flat[name]!r}"
            )
    for name in _LABELS:
        for label in (settings.get("comparison") or {}).get(
            name.removeprefix("comparison."), ()
        ):
            if not is_below(
                "_".join(str(label).split())
            ):  # as the folder of a cell is called
                raise ValueError(
                    f"{name} must have keys that are names of files, got {label!r}"
                )
    for low, high in _PAIRS:
        below, above = flat.get(low) or (), flat.get(high) or ()
        if len(below) != len(above) or not all(
            a <= b for a, b in zip(below, above, strict=True)
        ):
            raise ValueError(
                f"{low} must not lie above {high}, entry by entry, got {below} and {above}"
            )


def is_below(path: str) -> bool:
    """Whether a relative path stays below the folder that it starts from, on any system, and can be shown."""
    parts = path.split("/")
    return path.isprintable() and "\\" not in path and not {"", ".", ".."} & set(parts)


@cache
def rule_of(name: str) -> Rule:
    """What the tables say of a setting by its dotted name."""
    return Rule(_find(_INTERVALS, name), _find(_ENTRIES, name), _find(_KINDS, name))


def patterns() -> set[str]:
    """Every name in the tables, `*` for any."""
    listed = [*_INTERVALS.values(), *_ENTRIES.values(), *_KINDS.values()]
    return {
        *_RISING,
        *_EMPTY,
        *_NULL.split(),
        *(name for names in listed for name in names.split()),
        *_BOXES,
    }


def fits(name: str, pattern: str) -> bool:
    """Whether a dotted name is one that a pattern with at most one `*` means."""
    before, star, after = pattern.partition("*")
    return name == pattern or bool(
        star and name.startswith(before) and name.endswith(after)
    )


def _find(table: Mapping[Any, str], name: str) -> Any:
    """The key under which a table lists a name, or None."""
    return next(
        (
            key
            for key, names in table.items()
            if any(fits(name, one) for one in names.split())
        ),
        None,
    )


def _leaves(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values; lists are values. Of a comparison, some mappings hold what their schema says."""
    for key, value in settings.items():
        name = f"{above}{key}"
        if not isinstance(value, Mapping):
            yield name, value
        elif name not in ("comparison.paper", "comparison.controllers"):
            yield from _leaves(value, f"{name}.")


def _wrong(name: str, value: Any, rule: Rule) -> str | None:
    """What a setting must be that is something else; None if all is well."""
    if value is None:
        return None if _find({True: _NULL}, name) else "set"
    listed = isinstance(value, list)
    entries = value if listed else [value]
    if any(entry is None or isinstance(entry, (dict, list)) for entry in entries):
        return "a list of numbers or words"
    size = f"{rule.entries} entries" if rule.entries else "at least one entry"
    if not (entries or name in _EMPTY) or (
        rule.entries and (not listed or len(value) != rule.entries)
    ):
        return size
    if listed != (rule.entries is not None or name in _BOXES) and rule.kind:
        return "a list" if name in _BOXES else _WORDS[rule.kind]
    if rule.kind is not None and not all(_is(entry, rule.kind) for entry in entries):
        return _WORDS[rule.kind] + (" each" if listed else "")
    for entry in entries:
        if said := _outside(entry, rule.interval):
            return said + (" each" if listed else "")
    return "in rising order" if name in _RISING and value != sorted(value) else None


def _is(value: Any, kind: type) -> bool:
    """Whether a value is of a kind; a whole number is a number, true and false are none."""
    return isinstance(
        value, (int, float) if kind is float else kind
    ) and not isinstance(value, bool)


def _outside(value: Any, interval: str | None) -> str | None:
    """What a value must be that is not in its interval."""
    if isinstance(value, str):
        return None if value.strip() else "words, not nothing"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    interval = interval or ("[1, inf)" if isinstance(value, int) else "[0, inf)")
    low, high = map(float, interval[1:-1].split(","))
    largest = LARGEST_INT if isinstance(value, int) else LARGEST_FLOAT
    above = low < value if interval[0] == "(" else low <= value
    below = value < high if interval[-1] == ")" else value <= high
    if math.isfinite(value) and abs(value) <= largest and above and below:
        return None
    return f"in {interval}"
