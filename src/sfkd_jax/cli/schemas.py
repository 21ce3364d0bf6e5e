"""Dataclasses for Hydra, derived from the signatures of factories."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import MISSING, field, is_dataclass, make_dataclass
from typing import Any, NamedTuple, TypeGuard

from sfkd_jax.ranges import Ascending, Entries, Interval


class BelowRoot:
    """Annotates a setting that becomes a directory below `root`."""


class FileNames:
    """Annotates a mapping whose keys become names of files."""


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


def schema(
    title: str,
    /,
    *sources: Callable[..., Any],
    skip: tuple[str, ...] = (),
    entries: Mapping[str, int] | None = None,
    **parts: type,
) -> type:
    """Return a dataclass of the settings of factories.

    Args:
        title: name of the dataclass.
        sources: functions, whose settings are the keyword-only arguments, and classes,
            whose settings are the fields. The first one that has a name defines it.
        skip: names that something else decides.
        entries: name -> exact number of entries, where the factory takes any number.
        parts: name -> dataclass of a nested group of settings.
    """
    chosen: dict[str, tuple[Any, ...]] = {
        name: (name, part, field(default_factory=part)) for name, part in parts.items()
    }
    for source in sources:
        hints = typing.get_type_hints(source, include_extras=True)
        for name, parameter in inspect.signature(source).parameters.items():
            is_setting = inspect.isclass(source) or (
                parameter.kind is parameter.KEYWORD_ONLY
            )
            if is_setting and name not in (*skip, *chosen):
                hint = hints[name]
                if count := (entries or {}).get(name):
                    hint = typing.Annotated[hint, Entries(exactly=count)]
                chosen[name] = _field(name, hint, parameter.default)
    required_first = sorted(chosen.values(), key=lambda entry: not _required(entry[2]))
    return make_dataclass(title, required_first)


def is_schema(hint: Any) -> TypeGuard[type]:
    """Return whether a type is a nested group of settings."""
    return isinstance(hint, type) and is_dataclass(hint)


def rule_of(hint: Any) -> Rule:
    """Return the rule that an annotation states."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _annotated(rule_of(arguments[0]), arguments[1:])
    if origin in (typing.Union, types.UnionType):
        kinds = [kind for kind in arguments if kind is not types.NoneType]
        rule = rule_of(kinds[0]) if len(kinds) == 1 else Rule()
        return rule._replace(nullable=len(kinds) < len(arguments))
    if origin is tuple:
        exactly = None if Ellipsis in arguments else len(arguments)
        return rule_of(arguments[0])._replace(entries=Entries(exactly=exactly))
    if origin is dict:
        return Rule(values=rule_of(arguments[1]))
    return Rule(kind=hint if hint in (bool, int, float, str) else None)


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


def _field(name: str, hint: Any, default: Any) -> tuple[str, Any, Any]:
    """Return a dataclass field; sequences become lists, as in YAML."""
    about: Any = {"metadata": {"rule": rule_of(hint)}}
    if isinstance(default, tuple):
        about["default_factory"] = lambda: list(default)
    elif default is not inspect.Parameter.empty:
        about["default"] = default
    return name, _plain(hint), field(**about)


def _required(entry: Any) -> bool:
    return entry.default is MISSING and entry.default_factory is MISSING


def _plain(hint: Any) -> Any:
    """Return a type that OmegaConf knows: tuple[float, ...] becomes list[float]."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _plain(arguments[0])
    if origin is tuple:
        return list[_plain(arguments[0])]
    if origin is dict:
        return dict[str, _plain(arguments[1])]
    return Any if origin in (typing.Union, types.UnionType) else hint
