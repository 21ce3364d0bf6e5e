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
"""What int32 and float32 hold."""
DEFAULT = {int: Interval("[1, inf)"), float: Interval("[0, inf)")}
"""Of numbers without an annotation."""
_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "words"}

T = TypeVar("T")
Values = Mapping[str, Any]
"""Plain values by the names of settings, as JSON and YAML hold them."""


class BelowRoot:
    """Annotates a setting that becomes a directory below `root`."""


class OneOf(tuple[str, ...]):
    """Annotates a word of which there are only these."""


def takes(
    *factories: Callable[..., Any], skip: tuple[str, ...] = (), **parts: type
) -> Callable[[type[T]], type[T]]:
    """Make a class a frozen dataclass of its fields and the settings of factories.

    Args:
        factories: functions, whose settings are the keyword-only arguments, and
            classes, whose settings are the fields. The first that has a name wins.
        skip: names that something else decides.
        parts: name -> dataclass of a nested group of settings.
    """

    def decorate(cls: type[T]) -> type[T]:
        known, added = typing.get_type_hints(cls), {}
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
    title: str, base: type[T], *factories: Callable[..., Any], **about: Any
) -> type[T]:
    """Return a subclass of `base` with the settings of factories, see `takes`."""
    made: Any = type(title, (base,), {})
    return takes(*factories, **about)(made)


def arguments(settings: Any, factory: Callable[..., Any]) -> dict[str, Any]:
    """Return the settings that are arguments of a factory, by name."""
    names = [name for name in _arguments(factory) if hasattr(settings, name)]
    return {name: getattr(settings, name) for name in names}


def _arguments(factory: Callable[..., Any]) -> dict[str, Any]:
    """Defaults of the settings of a factory by name."""
    return {
        name: parameter.default
        for name, parameter in inspect.signature(factory).parameters.items()
        # A NamedTuple takes fields by position, a factory its settings by name alone.
        if inspect.isclass(factory) or parameter.kind is parameter.KEYWORD_ONLY
    }


def parse(kind: type[T], values: Values | T, above: str = "") -> T:
    """Return plain values as an object of a dataclass, with lists as tuples.

    An object of `kind` is returned as it is; `kind_of`, if a dataclass has it, returns
    the subclass that fits the values. `above` is the group with a dot, for messages.
    """
    if isinstance(values, kind):
        return values
    if not isinstance(values, Mapping):
        raise ValueError(f"{above.rstrip('.')} must be settings by name")
    if choose_kind := getattr(kind, "kind_of", None):
        kind = choose_kind(values)
    declared = _hints(kind)
    # Names first: a misspelt one would silently leave the setting at its default.
    for name in values:
        if name not in declared:
            hint = did_you_mean(f"{above}{name}", [above + one for one in declared])
            raise ValueError(f"unknown setting {above}{name}{hint}")
    parsed: dict[str, Any] = {}
    for entry in fields(typing.cast(Any, kind)):
        name = entry.name
        if name in values:
            parsed[name] = _checked(above + name, values[name], declared[name])
        elif entry.default is MISSING and entry.default_factory is MISSING:
            raise ValueError(f"{above}{name} must be set")
    # Pairs last: both ends have to be lists of numbers before they are compared.
    _check_boxes(above, parsed)
    return kind(**parsed)


def replace(settings: T, **changes: Any) -> T:
    """Return settings with changes of some fields, checked as `parse` does."""
    return parse(type(settings), vars(settings) | changes)


@cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


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
    """Whether a relative path is printable and stays below where it starts."""
    parts = path.split("/")
    return path.isprintable() and "\\" not in path and not {"", ".", ".."} & set(parts)


def _checked(name: str, value: Any, hint: Any, *marks: Any) -> Any:
    """Return a value as its annotation states it, with lists as tuples.

    `marks` are what stood beside the annotation `hint` in `Annotated`.
    """
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _checked(name, value, parts[0], *parts[1:], *marks)
    if origin in (typing.Union, types.UnionType):
        kinds = [kind for kind in parts if kind is not types.NoneType]
        if value is None and len(kinds) < len(parts):
            return None
        # A union of several kinds states nothing that could be checked here.
        return _checked(name, value, kinds[0] if len(kinds) == 1 else Any, *marks)
    if is_dataclass(hint):
        return parse(typing.cast(type, hint), value, f"{name}.")
    if origin in (tuple, list):
        # Tuples where they are asked for: nobody can change what they are given.
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
    inner, count = parts[0], len(parts)
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


def _problem(value: Any, kind: Any, marks: tuple[Any, ...]) -> str | None:
    """Return what a number, a word or a truth value must be, if it is not."""
    if kind not in _WORDS:
        return None  # nothing is stated about it
    if value is None:
        return "set"
    # bool is a subclass of int: without this `true` would pass for the number 1.
    is_truth = isinstance(value, bool)
    right = (int, float) if kind is float else kind
    if is_truth != (kind is bool) or not isinstance(value, right):
        return _WORDS[kind]
    for mark in marks:
        if isinstance(mark, OneOf) and value not in mark:
            return f"one of {', '.join(mark)}"
        if isinstance(mark, BelowRoot) and not _is_below(value):
            return "a path below root without '..', empty parts or \\"
    if is_truth or isinstance(value, str):
        return None if is_truth or value.strip() else "words, not nothing"
    given = (mark for mark in marks if isinstance(mark, Interval))
    interval = next(given, DEFAULT[kind])
    inside = math.isfinite(value) and abs(value) <= LARGEST[kind]
    return None if inside and interval.contains(value) else f"in {interval.text}"


def _check_boxes(above: str, settings: Values) -> None:
    """Check that the lower ends of intervals are below the upper ones."""
    for low, lower in settings.items():
        high = low.removesuffix("low") + "high"
        if not low.endswith("low") or high not in settings:
            continue
        ends = list(lower or ()), list(settings[high] or ())
        crossed = any(a > b for a, b in zip(*ends, strict=False))
        if crossed or len(ends[0]) != len(ends[1]):
            raise ValueError(
                f"{above}{low} must not lie above {above}{high}, entry by entry, "
                f"got {ends[0]} and {ends[1]}"
            )
