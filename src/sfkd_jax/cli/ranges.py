"""Check settings against the ranges that their schemas state."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from sfkd_jax.cli import messages
from sfkd_jax.cli.options import GROUPS
from sfkd_jax.cli.schemas import Rule, is_schema
from sfkd_jax.ranges import Entries, Interval

LARGEST = {int: 2**31 - 1, float: 3e38}
"""What int32 and float32 hold."""
DEFAULT = {int: Interval("[1, inf)"), float: Interval("[0, inf)")}
"""Of numbers without an annotation."""
_WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "words",
}


def check(config: DictConfig, schema: type) -> None:
    """Refuse the first setting that does not exist or is out of its range.

    Args:
        config: composed settings; the type of each group is the schema of its option.
        schema: of the settings that belong to no group.

    Raises:
        ValueError: the setting, what it may be, and what it is.
    """
    settings = OmegaConf.to_container(config, resolve=True)
    names = list(messages.setting_names(settings))
    _check_node("", settings, config, schema, names)


def is_below(path: str) -> bool:
    """Return whether a relative path is printable and stays below where it starts."""
    parts = path.split("/")
    return path.isprintable() and "\\" not in path and not {"", ".", ".."} & set(parts)


def _check_node(
    above: str, settings: Any, node: Any, schema: type, names: list[str]
) -> None:
    """Check the settings of one schema, and those below it."""
    declared = {entry.name: entry for entry in dataclasses.fields(schema)}
    for key in {**declared, **settings}:
        name, value = f"{above}{key}", settings.get(key)
        inner = _schema_of(node, key) or (
            declared[key].type if key in declared else None
        )
        if is_schema(inner):
            below = value if isinstance(value, dict) else {}
            _check_node(f"{name}.", below, node.get(key), inner, names)
        elif name in GROUPS:
            continue  # a part of other options, with no schema of its own
        elif key not in declared:
            known = [one for one in names if not f"{one}.".startswith(f"{name}.")]
            raise ValueError(messages.unknown_setting(name, known))
        else:
            _check_value(name, value, declared[key].metadata["rule"])
    for key in settings:
        if key.endswith("_low") and f"{key[:-4]}_high" in settings:
            _check_box(above, key, f"{key[:-4]}_high", settings)


def _schema_of(node: Any, key: str) -> Any:
    """Return the dataclass of a part of a composed configuration, or None."""
    if not isinstance(node, DictConfig) or key not in node:
        return None
    kind = OmegaConf.get_type(node, key)
    return kind if is_schema(kind) else None


def _check_value(name: str, value: Any, rule: Rule) -> None:
    """Check one setting; of a mapping, its keys and its values."""
    if isinstance(value, dict) and rule.values is not None:
        for key, inner in value.items():
            # The key becomes a directory, with spaces replaced.
            if rule.file_names and not is_below("_".join(str(key).split())):
                raise ValueError(
                    f"{name} must have keys that are names of files, got {key!r}"
                )
            _check_value(f"{name}.{key}", inner, rule.values)
        return
    if value == "???" or (rule.kind is None and rule.values is None):
        return  # nothing is stated about it
    if problem := _problem(value, rule):
        raise ValueError(f"{name} must be {problem}, got {value!r}")
    if rule.below_root and not is_below(str(value)):
        raise ValueError(
            f"{name} must be a path below root without '..', empty parts or \\, "
            f"got {value!r}"
        )


def _check_box(above: str, low: str, high: str, settings: Mapping[str, Any]) -> None:
    """Check that the lower ends of intervals are below the upper ones."""
    lower, upper = settings[low] or (), settings[high] or ()
    if len(lower) != len(upper) or any(
        a > b for a, b in zip(lower, upper, strict=True)
    ):
        raise ValueError(
            f"{above}{low} must not lie above {above}{high}, entry by entry, "
            f"got {lower} and {upper}"
        )


def _problem(value: Any, rule: Rule) -> str | None:
    """Return what a setting must be, if it is something else."""
    if value is None:
        return None if rule.nullable else "set"
    listed = isinstance(value, list)
    entries = value if listed else [value]
    if any(entry is None or isinstance(entry, dict | list) for entry in entries):
        return "a list of numbers or words"
    if size := _wrong_size(value, rule.entries):
        return size
    if listed != (rule.entries is not None) and rule.kind is not None:
        return _WORDS[rule.kind] if listed else "a list"
    if rule.kind and not all(_is(entry, rule.kind) for entry in entries):
        return _WORDS[rule.kind] + (" each" if listed else "")
    for entry in entries:
        if problem := _outside(entry, rule):
            return problem + (" each" if listed else "")
    return "in rising order" if rule.ascending and value != sorted(value) else None


def _wrong_size(value: Any, wanted: Entries | None) -> str | None:
    """Return how many entries there must be, if there are others."""
    if wanted and wanted.exactly is not None:
        fits = isinstance(value, list) and len(value) == wanted.exactly
        return None if fits else f"{wanted.exactly} entries"
    may_be_empty = wanted is not None and wanted.least == 0
    return "at least one entry" if value == [] and not may_be_empty else None


def _is(value: Any, kind: type) -> bool:
    """Return whether a value is of a kind; ints are floats too, bools are neither."""
    if isinstance(value, bool) or kind is bool:
        return isinstance(value, bool) and kind is bool
    return isinstance(value, int | float if kind is float else kind)


def _outside(value: Any, rule: Rule) -> str | None:
    """Return what a value must be, if it is not in its interval."""
    if isinstance(value, str):
        return None if value.strip() else "words, not nothing"
    if isinstance(value, bool):
        return None
    kind = rule.kind or type(value)
    interval = rule.interval or DEFAULT[kind]
    if (
        math.isfinite(value)
        and abs(value) <= LARGEST[kind]
        and interval.contains(value)
    ):
        return None
    return f"in {interval.text}"
