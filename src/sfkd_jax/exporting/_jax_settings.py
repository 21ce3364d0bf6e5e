"""Settings of jax that have no narrower scope than a process, made for one piece of work."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import jax


@contextmanager
def jax_settings(asked: Mapping[str, object]) -> Iterator[None]:
    """Settings as asked, and afterwards as they were; other threads should not trace or compile meanwhile.

    Args:
        asked: by their names in `jax.config`.
    """
    before = {name: getattr(jax.config, name) for name in asked}
    try:
        _set(asked)
        yield
    finally:
        _set(before)


def _set(values: Mapping[str, object]) -> None:
    for name, value in values.items():
        jax.config.update(name, value)
