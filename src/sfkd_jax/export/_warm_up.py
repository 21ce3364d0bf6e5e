"""Compile a controller before its first step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

from sfkd_jax.export._jax_settings import jax_settings
from sfkd_jax.export._programs import example_inputs
from sfkd_jax.policy import Policy

CACHE_SETTINGS = {
    "jax_enable_compilation_cache": True,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
"""Cache every compilation, however short and small."""


def warm_up(policy: Policy, *, cache: str | Path | None = None) -> jax.stages.Compiled:
    """Compile `act` for the shapes of a policy, so that no step waits for a compiler.

        act = warm_up(policy)
        control, state, info = act(policy.params, state, observation, env, reference)

    With `cache` the machine code is stored in jax's persistent compilation cache, and
    later processes with the same kind of machine, jax and controller load it. The cache
    is a setting of the whole process: it is changed for this compilation and restored
    afterwards, and other threads should not compile meanwhile. To cache everything that
    a process compiles, set JAX_COMPILATION_CACHE_DIR instead.

    Args:
        policy: as `load` returns it.
        cache: a directory, created if it is missing. It holds machine code that will be
            executed, so it must be trusted.

    Returns:
        The compiled function, for float32 arrays of the policy's shapes only.
    """
    _, state, *measured = example_inputs(policy)

    # A new function: jax would not compile and cache one again that has run.
    def act(*arguments: Any) -> Any:
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
    """Use jax's compilation cache in `directory`, and restore the former one.

    The cache is reset, since an open one ignores changed settings.
    """
    try:
        with jax_settings(
            CACHE_SETTINGS | {"jax_compilation_cache_dir": str(directory)}
        ):
            compilation_cache.reset_cache()
            yield
    finally:
        compilation_cache.reset_cache()
