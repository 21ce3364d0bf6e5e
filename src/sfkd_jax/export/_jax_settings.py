"""Change process-wide settings of jax for the duration of one task."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import jax


@contextmanager
def jax_settings(values: Mapping[str, object]) -> Iterator[None]:
    """Set settings of jax and restore them afterwards.

    Other threads should not trace or compile meanwhile.

    Args:
        values: by their names in `jax.config`.
    """
    before = {name: getattr(jax.config, name) for name in values}
    try:
        _set(values)
        yield
    finally:
        _set(before)


def _set(values: Mapping[str, object]) -> None:
    for name, value in values.items():
        jax.config.update(name, value)
