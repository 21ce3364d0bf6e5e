"""Compiling a controller before the first step is due."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

from sfkd_jax.exporting._jax_settings import jax_settings
from sfkd_jax.exporting._programs import example_inputs
from sfkd_jax.policy import Policy

KEPT = {
    "jax_enable_compilation_cache": True,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
"""Whatever was asked to be kept is kept, however small."""


def warm_up(policy: Policy, *, cache: str | Path | None = None) -> jax.stages.Compiled:
    """Compile `act` for the shapes of a policy, so that no control step waits for a compiler.

        act = warm_up(policy);   control, state, info = act(policy.params, state, observation, env, reference)

    With `cache` the machine code is kept in jax's persistent compilation cache: a later
    process on the same kind of machine, with the same jax and controller, reads it
    back. jax knows one cache for a whole process and offers no narrower one, so the
    setting is made for this compilation alone and given back; other threads should not
    compile meanwhile. To keep everything that a process compiles, set
    JAX_COMPILATION_CACHE_DIR for it instead.

    Args:
        policy: as `load` returns it.
        cache: a directory, made if missing; it holds machine code, so trust it as such.

    Returns:
        The compiled function; it takes float32 arrays of these shapes and nothing else.
    """
    _, state, *measured = example_inputs(policy)

    def act(
        *arguments: Any,
    ) -> (
        Any
    ):  # a new function: of one that has run, jax compiles and keeps nothing more
        return policy.controller.act(*arguments)

    lowered = jax.jit(act).lower(policy.params, state, *measured)
    with (
        nullcontext()
        if cache is None
        else _persistent_cache(Path(cache).expanduser().resolve())
    ):
        return lowered.compile()


@contextmanager
def _persistent_cache(directory: Path) -> Iterator[None]:
    """jax's compilation cache in `directory`, and afterwards as it was; an open one does not follow its settings."""
    try:
        with jax_settings(KEPT | {"jax_compilation_cache_dir": str(directory)}):
            compilation_cache.reset_cache()
            yield
    finally:
        compilation_cache.reset_cache()
