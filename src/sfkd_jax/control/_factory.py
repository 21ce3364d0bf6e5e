"""Dataclasses as controllers, and factories that take the fields of a dataclass."""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

from sfkd_jax.types import Controller

P = ParamSpec("P")
S = TypeVar("S")
R = TypeVar("R")


class Stateful:
    """Settings whose `init` and `act` are those of a controller."""

    def controller(self) -> Controller:
        """Return the controller, as two functions."""
        # A subclass defines both functions.
        subclass: Any = self
        return Controller(subclass.init, subclass.act)


def factory(settings: Callable[P, S], make: Callable[[S], R]) -> Callable[P, R]:
    """Return a function with the arguments of a dataclass.

    Editors and the settings of the commands read its signature.

    Args:
        settings: a dataclass, which checks its fields in `__post_init__`.
        make: (object of it) -> what the function returns.
    """

    @functools.wraps(settings, updated=())
    def build(*args: P.args, **options: P.kwargs) -> R:
        return make(settings(*args, **options))

    # `wraps` copies the annotations of the class itself, not those it inherits.
    hints = typing.get_type_hints(settings, include_extras=True)
    build.__annotations__ = hints
    return build
