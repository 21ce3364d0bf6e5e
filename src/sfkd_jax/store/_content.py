"""Flatten trees, hash content and compare settings."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def flatten(tree: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the leaves of nested dicts as "a/b/c"; an empty inner dict becomes "a/b/".

    Raises:
        ValueError: a key is not a string, is empty or holds "/"; a leaf is neither
            array nor number.
    """
    flat: dict[str, np.ndarray] = {}
    for key, value in tree.items():
        if not isinstance(key, str) or not key or "/" in key:
            raise ValueError(f"cannot flatten the key {key!r}")
        if isinstance(value, Mapping):
            inner = flatten(value) or {"": np.zeros(0, np.float32)}
            flat |= {f"{key}/{name}": leaf for name, leaf in inner.items()}
        elif hasattr(value, "__array__") or isinstance(
            value, bool | int | float | complex
        ):
            flat[key] = np.asarray(value)
        else:
            raise ValueError(
                f"cannot flatten {key!r}: "
                f"a {type(value).__name__} is neither dict nor array"
            )
    return flat


def unflatten(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested dicts of flat names, the inverse of `flatten`.

    Raises:
        ValueError: one name is both a leaf and a dict.
    """
    tree: dict[str, Any] = {}
    for name, leaf in flat.items():
        *branches, last = name.split("/")
        node = tree
        for branch in branches:
            node = node.setdefault(branch, {})
            if not isinstance(node, dict):
                raise ValueError(f"{name!r} is below a leaf")
        if last and node.setdefault(last, leaf) is not leaf:
            raise ValueError(f"{name!r} is both a leaf and a dict")
    return tree


def sha256(data: Mapping[str, Any] | Sequence[Any]) -> str:
    """Hash the content, independent of its order and memory layout.

    The hash of a flat dict of arrays covers names, dtypes, shapes and values; that of
    anything else covers the JSON that it would become.
    """
    if not (
        isinstance(data, Mapping)
        and data
        and all(_is_array(value) for value in data.values())
    ):
        return hashlib.sha256(
            json.dumps(plain(data), sort_keys=True).encode()
        ).hexdigest()
    digest = hashlib.sha256()
    for name in sorted(data):
        array = np.asarray(data[name])
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """List where settings differ, by dotted key; 1 and 1.0 are equal.

    An entry reads "training.steps was 4000, is now 100".

    Args:
        old: recorded settings.
        new: current settings.
    """
    lines = []
    for key in dict.fromkeys([*old, *new]):
        a, b = old.get(key, ...), new.get(key, ...)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            lines += [f"{key}.{line}" for line in differences(a, b)]
        elif isinstance(a, bool) != isinstance(b, bool) or plain(a) != plain(b):
            lines.append(f"{key} was {_short(a)}, is now {_short(b)}")
    return lines


def plain(value: Any) -> Any:
    """Convert to JSON types; arrays become lists, NaN and infinities None."""
    if hasattr(value, "__array__"):
        value = np.asarray(value).tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def _is_array(value: Any) -> bool:
    return hasattr(value, "__array__") and not isinstance(value, np.generic)


def _short(value: Any) -> str:
    text = "absent" if value is ... else str(plain(value))
    return text if len(text) <= 60 else f"{text[:57]}..."
