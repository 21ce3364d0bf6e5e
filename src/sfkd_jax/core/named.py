"""Objects that settings name as "package.module:name"."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def imported(name: str, setting: str) -> Any:
    """Import and return "package.module:name".

    Args:
        name: of the object.
        setting: that names it, for the message.

    Raises:
        ValueError: there is no such module or name.
    """
    module, _, attribute = name.partition(":")
    try:
        return getattr(import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as reason:
        raise ValueError(
            f"{setting}={name}: {reason}; name it as package.module:function"
        ) from None
