"""Settings: dataclasses made from the signatures of factories, parsed and checked.

A factory states its settings once, as annotated keyword-only arguments. `takes` makes
a class a frozen dataclass of them, and `parse` an object of plain values (JSON or
YAML), which `store.plain` returns again.
"""

from __future__ import annotations

import difflib
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from typing import Any, TypeVar

from sfkd_jax.ranges import Ascending, Interval, MayBeEmpty

LARGEST = {int: 2**31 - 1, float: 3e38}
"""The largest values that int32 and float32 hold."""
DEFAULT = {int: Interval("[1, inf)"), float: Interval("[0, inf)")}
"""The interval of a number that is annotated with none."""
_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "words"}
"""What a value of a type is called in messages."""

T = TypeVar("T")
Values = Mapping[str, Any]
"""Plain values by the names of settings, as JSON and YAML hold them."""


class BelowRoot:
    """Annotates a setting that becomes a directory below `root`."""


class OneOf(tuple[str, ...]):
    """Annotates a setting that must be one of these words."""


def takes(
    *factories: Callable[..., Any], skip: tuple[str, ...] = (), **parts: type
) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen dataclass of its fields and the settings of factories.

    Args:
        factories: functions, whose settings are the keyword-only arguments, and
            classes, whose settings are the fields. If several have a setting of one
            name, the first of them defines it.
        skip: names that are no settings, because something else decides them.
        parts: name -> dataclass of a nested group of settings.
    """

    def decorate(cls: type[T]) -> type[T]:
        known = typing.get_type_hints(cls)
        added: dict[str, Any] = {}
        for name, part in parts.items():
            added[name] = part
            setattr(cls, name, field(default_factory=part))
        for factory in factories:
            hints = typing.get_type_hints(factory, include_extras=True)
            for name, default in _arguments(factory).items():
                if name in known or name in added or name in skip:
                    continue
                added[name] = hints[name]
                if default is not inspect.Parameter.empty:
                    setattr(cls, name, default)
        cls.__annotations__ = inspect.get_annotations(cls) | added
        return dataclass(frozen=True, kw_only=True)(cls)

    return decorate


def schema(
    title: str, base: type[T], *factories: Callable[..., Any], **options: Any
) -> type[T]:
    """Return a subclass of `base` with the settings of factories.

    Args:
        title: name of the subclass.
        base: a class, with fields or without.
        factories: functions and classes, see `takes`.
        options: `skip` and `parts` of `takes`.
    """
    subclass: Any = type(title, (base,), {})
    return takes(*factories, **options)(subclass)


def arguments(settings: Any, factory: Callable[..., Any]) -> dict[str, Any]:
    """Return the settings that are arguments of a factory, by name."""
    names = [name for name in _arguments(factory) if hasattr(settings, name)]
    return {name: getattr(settings, name) for name in names}


def _arguments(factory: Callable[..., Any]) -> dict[str, Any]:
    """Return the settings of a factory with their defaults, by name."""
    return {
        name: parameter.default
        for name, parameter in inspect.signature(factory).parameters.items()
        # A NamedTuple takes fields by position, a factory its settings by name alone.
        if inspect.isclass(factory) or parameter.kind is parameter.KEYWORD_ONLY
    }


def parse(dataclass_type: type[T], values: Values | T, group: str = "") -> T:
    """Return plain values as an object of a dataclass, with lists as tuples.

    A dataclass may have a class method `subclass_for(values)`: the object is then of
    the subclass that this method returns.

    Args:
        dataclass_type: the dataclass, as `takes` makes it.
        values: plain values by name; an object of the dataclass is returned as it is.
        group: the group of the settings with a dot, such as "model.", for messages.

    Raises:
        ValueError: a value or a name does not fit; the message names the setting.
    """
    if isinstance(values, dataclass_type):
        return values
    if not isinstance(values, Mapping):
        raise ValueError(f"{group.rstrip('.')} must be settings by name")
    if subclass_for := getattr(dataclass_type, "subclass_for", None):
        dataclass_type = subclass_for(values)
    declared = _hints(dataclass_type)
    # Names first: a misspelt one would silently leave the setting at its default.
    for name in values:
        if name not in declared:
            known = [group + known_name for known_name in declared]
            hint = did_you_mean(f"{group}{name}", known)
            raise ValueError(f"unknown setting {group}{name}{hint}")
    parsed: dict[str, Any] = {}
    for entry in fields(typing.cast(Any, dataclass_type)):
        name = entry.name
        if name in values:
            parsed[name] = _checked(group + name, values[name], declared[name])
        elif entry.default is MISSING and entry.default_factory is MISSING:
            raise ValueError(f"{group}{name} must be set")
    # Pairs last: both ends have to be lists of numbers before they are compared.
    _check_boxes(group, parsed)
    return dataclass_type(**parsed)


def replace(settings: T, **changes: Any) -> T:
    """Return settings with changes of some fields, checked as `parse` does."""
    return parse(type(settings), vars(settings) | changes)


@cache
def _hints(dataclass_type: type) -> dict[str, Any]:
    return typing.get_type_hints(dataclass_type, include_extras=True)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean …?" with the closest of the known names, or nothing."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]}?" if close else ""


def choose(table: Mapping[str, T], name: Any, what: str) -> T:
    """Return `table[name]`, or raise a ValueError that lists the choices of `what`."""
    if not isinstance(name, str) or name not in table:
        raise ValueError(
            f"unknown {what} {name!r}; choose one of {', '.join(sorted(table))}"
        )
    return table[name]


def _is_below(path: str) -> bool:
    """Return whether a relative path is printable and stays below its start."""
    parts = path.split("/")
    return path.isprintable() and "\\" not in path and not {"", ".", ".."} & set(parts)


def _checked(name: str, value: Any, hint: Any, *marks: Any) -> Any:
    """Return a value as its annotation states it, with lists as tuples.

    Args:
        name: of the setting, for messages.
        value: the plain value.
        hint: the annotation.
        marks: what stood beside the annotation in `Annotated`, such as an `Interval`.
    """
    origin = typing.get_origin(hint)
    parts = typing.get_args(hint)
    if origin is typing.Annotated:
        return _checked(name, value, parts[0], *parts[1:], *marks)
    if origin in (typing.Union, types.UnionType):
        alternatives = [part for part in parts if part is not types.NoneType]
        if value is None and len(alternatives) < len(parts):
            return None
        # A union of several types states nothing that could be checked here.
        inner = alternatives[0] if len(alternatives) == 1 else Any
        return _checked(name, value, inner, *marks)
    if is_dataclass(hint):
        return parse(typing.cast(type, hint), value, f"{name}.")
    if origin in (tuple, list):
        # A tuple where the annotation says so: the receiver cannot change it.
        return origin(_sequence(name, value, parts, marks))
    if origin is dict and isinstance(value, Mapping):
        return {
            key: _checked(f"{name}.{key}", inner, parts[1])
            for key, inner in value.items()
        }
    wrong = "settings by name" if origin is dict else _problem(value, hint, marks)
    if wrong:
        raise ValueError(f"{name} must be {wrong}, got {value!r}")
    return value


def _sequence(
    name: str, value: Any, parts: tuple[Any, ...], marks: tuple[Any, ...]
) -> list[Any]:
    """Return the entries of a list, all of them checked; see `_checked`."""
    inner = parts[0]
    count = len(parts)
    problem = None
    if not isinstance(value, list | tuple):
        problem = "a list"
    elif count > 1 and Ellipsis not in parts and len(value) != count:
        problem = f"{count} entries"
    elif not value and not any(isinstance(mark, MayBeEmpty) for mark in marks):
        problem = "at least one entry"
    if problem:
        raise ValueError(f"{name} must be {problem}, got {value!r}")
    entries = [
        _checked(f"{name}[{number}]", entry, inner)
        for number, entry in enumerate(value)
    ]
    rising = any(isinstance(mark, Ascending) for mark in marks)
    if rising and entries != sorted(entries):
        raise ValueError(f"{name} must be in rising order, got {value!r}")
    return entries


def _problem(value: Any, expected: Any, marks: tuple[Any, ...]) -> str | None:
    """Return what a number, a word or a truth value must be, or None if it is that.

    `expected` is its type, `marks` what stood beside the type in `Annotated`.
    """
    if expected not in _WORDS:
        return None  # nothing is stated about it
    if value is None:
        return "set"
    # bool is a subclass of int: without this `true` would pass for the number 1.
    is_truth = isinstance(value, bool)
    accepted = (int, float) if expected is float else expected
    if is_truth != (expected is bool) or not isinstance(value, accepted):
        return _WORDS[expected]
    for mark in marks:
        if isinstance(mark, OneOf) and value not in mark:
            return f"one of {', '.join(mark)}"
        if isinstance(mark, BelowRoot) and not _is_below(value):
            return "a path below root without '..', empty parts or \\"
    if is_truth:
        return None
    if isinstance(value, str):
        return None if value.strip() else "words, not nothing"
    stated = (mark for mark in marks if isinstance(mark, Interval))
    interval = next(stated, DEFAULT[expected])
    representable = math.isfinite(value) and abs(value) <= LARGEST[expected]
    if representable and interval.contains(value):
        return None
    return f"in {interval.text}"


def _check_boxes(group: str, settings: Values) -> None:
    """Check that settings `…low` do not lie above the `…high` of the same name.

    Raises:
        ValueError: they do, or have another number of entries.
    """
    for low_name in settings:
        high_name = low_name.removesuffix("low") + "high"
        if not low_name.endswith("low") or high_name not in settings:
            continue
        low = list(settings[low_name] or ())
        high = list(settings[high_name] or ())
        crossed = any(a > b for a, b in zip(low, high, strict=False))
        if crossed or len(low) != len(high):
            raise ValueError(
                f"{group}{low_name} must not lie above {group}{high_name}, "
                f"entry by entry, got {low} and {high}"
            )
