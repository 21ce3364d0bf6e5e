"""Settings: dataclasses made from the signatures of factories, parsed and checked.

A factory states its settings once, as annotated keyword-only arguments. `schema` makes
a frozen dataclass of them, `parse` an object of plain values (JSON or YAML), and
`plain` the values again.
"""

from __future__ import annotations

import difflib
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from functools import cache
from typing import Any, NamedTuple, TypeVar

from sfkd_jax.ranges import Ascending, Entries, Interval

LARGEST = {int: 2**31 - 1, float: 3e38}
"""What int32 and float32 hold."""
DEFAULT = {int: Interval("[1, inf)"), float: Interval("[0, inf)")}
"""Of numbers without an annotation."""
SIMILAR = 0.75
"""Similarity of two names, from 0 to 1, from which one is suggested for the other."""
_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "words"}

T = TypeVar("T")
Values = Mapping[str, Any]
"""Plain values by the names of settings, as JSON and YAML hold them."""


class BelowRoot:
    """Annotates a setting that becomes a directory below `root`."""


class FileNames:
    """Annotates a mapping whose keys become names of files."""


@dataclass(frozen=True, kw_only=True)
class Kinds:
    """Base of settings whose dataclass depends on their values."""

    @classmethod
    def kind_of(cls, values: Values) -> type:
        """Return the dataclass of these values."""
        del values
        return cls


def schema(
    title: str,
    base: type | None = None,
    /,
    *factories: Callable[..., Any],
    skip: tuple[str, ...] = (),
    entries: Mapping[str, int] | None = None,
    **parts: type,
) -> type[Any]:
    """Return a frozen dataclass of the settings of factories.

    Args:
        title: name of the dataclass.
        base: dataclass whose fields come first, or None.
        factories: functions, whose settings are the keyword-only arguments, and
            NamedTuples, whose settings are the fields. The first one that has a name
            defines it.
        skip: names that something else decides.
        entries: name -> exact number of entries, where the factory takes any number.
        parts: name -> dataclass of a nested group of settings.
    """
    known = {entry.name for entry in fields(base)} if base else set()
    chosen: dict[str, tuple[Any, ...]] = {
        name: (name, part, field(default_factory=part)) for name, part in parts.items()
    }
    for factory in factories:
        hints = typing.get_type_hints(factory, include_extras=True)
        for name, default in _arguments(factory).items():
            if name in known or name in chosen or name in skip:
                continue
            hint = hints[name]
            if count := (entries or {}).get(name):
                hint = typing.Annotated[hint, Entries(exactly=count)]
            absent = default is inspect.Parameter.empty
            chosen[name] = (name, hint, field(default=MISSING if absent else default))
    bases = (base,) if base else ()
    return make_dataclass(
        title, chosen.values(), bases=bases, frozen=True, kw_only=True
    )


def arguments(settings: Any, *factories: Callable[..., Any]) -> dict[str, Any]:
    """Return the settings that are arguments of factories, by name.

    Args:
        settings: an object made by `parse`.
        factories: as those of `schema`.
    """
    return {
        name: getattr(settings, name)
        for factory in factories
        for name in _arguments(factory)
        if hasattr(settings, name)
    }


def _arguments(factory: Callable[..., Any]) -> dict[str, Any]:
    """Defaults of the settings of a factory by name."""
    return {
        name: parameter.default
        for name, parameter in inspect.signature(factory).parameters.items()
        # A NamedTuple takes its fields by position,
        # a factory its settings by name alone.
        if inspect.isclass(factory) or parameter.kind is parameter.KEYWORD_ONLY
    }


def parse(kind: type[T], values: Values | T, above: str = "") -> T:
    """Return plain values as an object of a dataclass, with lists as tuples.

    Args:
        kind: dataclass of the settings; of `Kinds`, the values choose a subclass.
        values: plain values, or an object of `kind`, which is returned.
        above: name of the group with a dot, for messages.

    Raises:
        ValueError: naming a setting that does not exist, is missing or is out of its
            range.
    """
    if isinstance(values, kind):
        return values
    if not isinstance(values, Mapping):
        raise ValueError(f"{above.rstrip('.')} must be settings by name")
    if issubclass(kind, Kinds):
        kind = kind.kind_of(values)
    declared = hints_of(kind)
    # Names first: a misspelt one would silently leave the setting at its default.
    for name in values:
        if name not in declared:
            hint = did_you_mean(f"{above}{name}", list(names_of(kind, above)))
            raise ValueError(f"unknown setting {above}{name}{hint}")
    parsed: dict[str, Any] = {}
    for entry in fields(typing.cast(Any, kind)):
        name, hint = f"{above}{entry.name}", declared[entry.name]
        if entry.name not in values:
            if entry.default is MISSING and entry.default_factory is MISSING:
                raise ValueError(f"{name} must be set")
        elif is_dataclass(hint):
            inner: Any = hint
            parsed[entry.name] = parse(inner, values[entry.name], f"{name}.")
        else:
            rule = rule_of(hint)
            check(name, values[entry.name], rule)
            parsed[entry.name] = _as_tuple(values[entry.name], rule)
    # Pairs last: both ends have to be lists of numbers before they are compared.
    _check_boxes(above, parsed)
    return kind(**parsed)


def plain(settings: Any) -> Any:
    """Return an object of settings as plain values, with tuples as lists."""
    if is_dataclass(settings):
        return {
            entry.name: plain(getattr(settings, entry.name))
            for entry in fields(settings)
        }
    if isinstance(settings, Mapping):
        return {name: plain(value) for name, value in settings.items()}
    return [*map(plain, settings)] if isinstance(settings, list | tuple) else settings


@cache
def hints_of(kind: type) -> dict[str, Any]:
    """Return the annotations of the fields of a dataclass, by name."""
    return typing.get_type_hints(kind, include_extras=True)


def names_of(kind: type, above: str = "") -> Iterable[str]:
    """Yield the dotted names of all settings of a dataclass."""
    for name, hint in hints_of(kind).items():
        yield f"{above}{name}"
        if is_dataclass(hint):
            yield from names_of(typing.cast(type, hint), f"{above}{name}.")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean …?" with the closest of the known names, or nothing.

    A name that resembles none as a whole is compared with the last parts of them, so
    that `steps` leads to `training.steps`.
    """
    known = list(known)
    if close := difflib.get_close_matches(name, known, n=1, cutoff=SIMILAR):
        return f"; did you mean {close[0]}?"
    ends = {one.rpartition(".")[2] for one in known}
    last = name.rpartition(".")[2]
    ending = difflib.get_close_matches(last, ends, n=1, cutoff=SIMILAR)
    similar = [one for one in known if one.rpartition(".")[2] in ending]
    return f"; did you mean {' or '.join(similar[:3])}?" if similar else ""


def choose(table: Mapping[str, T], name: Any, what: str) -> T:
    """Return `table[name]`.

    Args:
        table: choices by name.
        name: of one of them.
        what: the name stands for, for the message.

    Raises:
        ValueError: no such name; the message lists the choices.
    """
    if not isinstance(name, str) or name not in table:
        raise ValueError(
            f"unknown {what} {name!r}; choose one of {', '.join(sorted(table))}"
        )
    return table[name]


class Rule(NamedTuple):
    """The values that one setting may take.

    Attributes:
        kind: of the value or of its entries; None if there is no single one.
        nullable: whether None is a value.
        interval: of its numbers; None for the default of their kind.
        entries: how many there may be; None for a setting that is no sequence.
        ascending: whether the entries must be in ascending order.
        below_root: whether the value is a path below `root`.
        values: of a mapping, the rule of its values.
        file_names: whether the keys of a mapping must be names of files.
    """

    kind: type | None = None
    nullable: bool = False
    interval: Interval | None = None
    entries: Entries | None = None
    ascending: bool = False
    below_root: bool = False
    values: Rule | None = None
    file_names: bool = False


def rule_of(hint: Any) -> Rule:
    """Return the rule that an annotation states."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _annotated(rule_of(parts[0]), parts[1:])
    if origin in (typing.Union, types.UnionType):
        kinds = [kind for kind in parts if kind is not types.NoneType]
        # A union of several kinds states nothing that one rule could check.
        rule = rule_of(kinds[0]) if len(kinds) == 1 else Rule()
        return rule._replace(nullable=len(kinds) < len(parts))
    if origin is tuple:
        exactly = None if Ellipsis in parts else len(parts)
        return rule_of(parts[0])._replace(entries=Entries(exactly=exactly))
    if origin is dict:
        return Rule(values=rule_of(parts[1]))
    return Rule(kind=hint if hint in _WORDS else None)


def _annotated(rule: Rule, marks: tuple[Any, ...]) -> Rule:
    """Add what stands beside the type in `Annotated`."""
    for mark in marks:
        if isinstance(mark, Interval):
            rule = rule._replace(interval=mark)
        elif isinstance(mark, Entries):
            rule = rule._replace(entries=mark)
        elif isinstance(mark, Ascending):
            rule = rule._replace(ascending=True)
        elif isinstance(mark, BelowRoot):
            rule = rule._replace(below_root=True)
        elif isinstance(mark, FileNames):
            rule = rule._replace(file_names=True)
    return rule


def check(name: str, value: Any, rule: Rule) -> None:
    """Check one setting; of a mapping, its keys and its values.

    Raises:
        ValueError: what the setting may be, and what it is.
    """
    if isinstance(value, Mapping) and rule.values is not None:
        for key, inner in value.items():
            # The key becomes a directory, with spaces replaced.
            if rule.file_names and not is_below("_".join(str(key).split())):
                raise ValueError(
                    f"{name} must have keys that are names of files, got {key!r}"
                )
            check(f"{name}.{key}", inner, rule.values)
        return
    if rule.kind is None and rule.values is None:
        return  # nothing is stated about it
    if problem := _problem(value, rule):
        raise ValueError(f"{name} must be {problem}, got {value!r}")
    if rule.below_root and not is_below(str(value)):
        raise ValueError(
            f"{name} must be a path below root without '..', empty parts or \\, "
            f"got {value!r}"
        )


def is_below(path: str) -> bool:
    """Return whether a relative path is printable and stays below where it starts."""
    parts = path.split("/")
    return path.isprintable() and "\\" not in path and not {"", ".", ".."} & set(parts)


def _as_tuple(value: Any, rule: Rule) -> Any:
    """Lists as tuples, also in mappings; what no rule speaks of stays as it is."""
    if isinstance(value, Mapping):
        inner = rule.values or Rule()
        return {key: _as_tuple(entry, inner) for key, entry in value.items()}
    # Tuples can be hashed, and nobody who is given settings can change them.
    stated = rule.entries is not None
    return tuple(value) if stated and isinstance(value, list) else value


def _check_boxes(above: str, settings: Values) -> None:
    """Check that the lower ends of intervals are below the upper ones."""
    for low, lower in settings.items():
        high = low.removesuffix("low") + "high"
        if not low.endswith("low") or high not in settings:
            continue
        ends = lower or (), settings[high] or ()
        if len(ends[0]) != len(ends[1]) or any(
            a > b for a, b in zip(*ends, strict=True)
        ):
            raise ValueError(
                f"{above}{low} must not lie above {above}{high}, entry by entry, "
                f"got {list(ends[0])} and {list(ends[1])}"
            )


def _problem(value: Any, rule: Rule) -> str | None:
    """Return what a setting must be, if it is something else."""
    if value is None:
        return None if rule.nullable else "set"
    listed = isinstance(value, list | tuple)
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
    rising = not rule.ascending or list(value) == sorted(value)
    return None if rising else "in rising order"


def _wrong_size(value: Any, wanted: Entries | None) -> str | None:
    """Return how many entries there must be, if there are others."""
    listed = isinstance(value, list | tuple)
    if wanted and wanted.exactly is not None:
        fits = listed and len(value) == wanted.exactly
        return None if fits else f"{wanted.exactly} entries"
    may_be_empty = wanted is not None and wanted.least == 0
    return "at least one entry" if listed and not value and not may_be_empty else None


def _is(value: Any, kind: type) -> bool:
    """Return whether a value is of a kind; ints are floats too, bools are neither."""
    # bool is a subclass of int: without this `true` would pass for the number 1.
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
    inside = math.isfinite(value) and abs(value) <= LARGEST[kind]
    return None if inside and interval.contains(value) else f"in {interval.text}"


def replace(settings: T, **changes: Any) -> T:
    """Return settings with changes of some fields, checked as `parse` does."""
    values: Any = {
        entry.name: getattr(settings, entry.name)
        for entry in fields(typing.cast(Any, settings))
    }
    return parse(type(settings), values | changes)
