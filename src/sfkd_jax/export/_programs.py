"""Controllers as functions of flat, named arrays, and compiled before a first step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import Array

from sfkd_jax import build
from sfkd_jax.policy import Policy

CACHE_SETTINGS = {
    "jax_enable_compilation_cache": True,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
"""Cache every compilation, however short and small."""


class Leaf(NamedTuple):
    """Name, shape and dtype of an array that a program takes or returns."""

    name: str
    shape: tuple[int, ...]
    dtype: str


class Program(NamedTuple):
    """A function of flat arrays, with its inputs and outputs in order."""

    function: Callable[..., tuple[Array, ...]]
    inputs: tuple[Leaf, ...]
    outputs: tuple[Leaf, ...]


class Programs(NamedTuple):
    """The two programs of a controller.

    Attributes:
        init: (key) -> state leaves.
        act: (state leaves, observation, env, reference) -> (control, state leaves, info
            leaves).
        key_implementation: of random keys, which are passed as their uint32 data.
    """

    init: Program
    act: Program
    key_implementation: str


def example_inputs(policy: Policy) -> tuple[Any, ...]:
    """Return the shapes of key, controller state, observation, env and reference."""
    key = jax.eval_shape(partial(jax.random.key, 0))
    settings = policy.settings
    plant = build.build_vehicle(settings["vehicle"])
    sizes = (len(plant.state_names),), (len(settings["space"]["env_mean"]),)
    shapes = *sizes, (build.controller_horizon(settings["controller"]), 4)
    measured = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)
    return key, jax.eval_shape(policy.controller.init, key), *measured


def flat_programs(policy: Policy) -> Programs:
    """Return the controller of a policy as programs, with folded weights inside.

    Names are paths, such as `state.plan` and `info.cost`. Keys are passed as
    their uint32 data.

    Raises:
        ValueError: the controller's state changes its structure, shapes or dtypes from
            step to step.
    """
    key, state, *measured = example_inputs(policy)
    implementation = str(jax.random.key_impl(jax.random.key(0)))
    wrap = partial(jax.random.wrap_key_data, impl=implementation)
    # Flat and named: other programs know neither pytrees nor keys.
    template, structure = jax.tree.flatten(state)

    def init(key_data: Array) -> tuple[Array, ...]:
        return tuple(_unpack(policy.controller.init(wrap(key_data))))

    def pack(leaves: Sequence[Array]) -> Any:
        wrapped = [
            wrap(leaf) if _is_key(like) else leaf
            for like, leaf in zip(template, leaves, strict=True)
        ]
        return jax.tree.unflatten(structure, wrapped)

    def act(*leaves: Array) -> tuple[Array, ...]:
        *before, observation, env, reference = leaves
        # Without the barrier XLA evaluates functions of the weights at compile time and
        # rounds differently.
        params = jax.lax.optimization_barrier(policy.params)
        control, after, info = policy.controller.act(
            params, pack(before), observation, env, reference
        )
        return control, *_unpack(after), *jax.tree.leaves(info)

    control, after, info = jax.eval_shape(
        policy.controller.act, policy.params, state, *measured
    )
    if (
        _named("state", after) != _named("state", state)
        or jax.tree.structure(after) != structure
    ):
        raise ValueError(
            "cannot export a controller whose state changes its structure, "
            "shapes or dtypes"
        )
    arguments = zip(("observation", "env", "reference"), measured, strict=True)
    inputs = _named("state", state) + tuple(
        _leaf(name, value) for name, value in arguments
    )
    outputs = (
        _leaf("control", control),
        *_named("state", after),
        *_named("info", info),
    )
    initial = Program(init, (_leaf("key", key),), _named("state", state))
    return Programs(initial, Program(act, inputs, outputs), implementation)


def input_shapes(program: Program) -> tuple[jax.ShapeDtypeStruct, ...]:
    """Return the shapes of a program's inputs."""
    return tuple(
        jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in program.inputs
    )


def lower(
    function: Callable[..., Any], program: Program, platforms: tuple[str, ...]
) -> jax.export.Exported:
    """Return a function of a program's inputs as StableHLO, including unused arguments.

    Source locations are left out: they contain paths of this machine and would make the
    result depend on it.

    Args:
        function: to lower.
        program: for its inputs.
        platforms: to lower for.
    """
    with jax_settings({"jax_traceback_in_locations_limit": 0}):
        export = jax.export.export(
            jax.jit(function, keep_unused=True), platforms=platforms
        )
        return export(*input_shapes(program))


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _unpack(tree: Any) -> list[Array]:
    """Return the leaves, with keys as their data."""
    return [
        jax.random.key_data(leaf) if _is_key(leaf) else leaf
        for leaf in jax.tree.leaves(tree)
    ]


def _leaf(name: str, value: Any) -> Leaf:
    """Name, shape and dtype of an array, or of the data of a key."""
    data = jax.eval_shape(jax.random.key_data, value) if _is_key(value) else value
    return Leaf(name, tuple(data.shape), str(data.dtype))


def _named(root: str, tree: Any) -> tuple[Leaf, ...]:
    """Return the leaves of a tree by dotted path."""
    paths = jax.tree_util.tree_leaves_with_path(tree)
    names = (
        f"{root}.{jax.tree_util.keystr(path, simple=True, separator='.')}"
        for path, _ in paths
    )
    return tuple(
        _leaf(name, leaf) for name, (_, leaf) in zip(names, paths, strict=True)
    )


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


@contextmanager
def jax_settings(values: Mapping[str, object]) -> Iterator[None]:
    """Set settings of jax and restore them afterwards.

    Other threads should not trace or compile meanwhile.

    Args:
        values: by their names in `jax.config`.
    """
    before = {name: getattr(jax.config, name) for name in values}
    try:
        for name, value in values.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
