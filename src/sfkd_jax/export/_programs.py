"""Programs of flat arrays, from a controller of pytrees."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.export
import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax import store
from sfkd_jax.policy import Policy, SystemPolicy

Shape: TypeAlias = jax.ShapeDtypeStruct
"""Shape and dtype of an array."""


class Leaf(NamedTuple):
    """Name, shape and dtype of an array that a program takes or returns."""

    name: str
    shape: tuple[int, ...]
    dtype: str


class Program(NamedTuple):
    """A function of flat arrays, with its inputs and outputs in order."""

    function: Callable[..., Sequence[Array]]
    inputs: tuple[Leaf, ...]
    outputs: tuple[Leaf, ...]

    def lower(self, *platforms: str) -> jax.export.Exported:
        """Return the program as StableHLO for platforms, including unused arguments."""
        shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in self.inputs]
        limit = "jax_traceback_in_locations_limit"
        before = getattr(jax.config, limit)
        # Source locations contain paths of this machine, and the result would depend on
        # it. Other threads should not trace meanwhile.
        jax.config.update(limit, 0)
        try:
            function = jax.jit(self.function, keep_unused=True)
            return jax.export.export(function, platforms=platforms)(*shapes)
        finally:
            jax.config.update(limit, before)


def flat_programs(
    trained: Policy | SystemPolicy, ahead: Mapping[str, Shape] | None = None
) -> dict[str, Program]:
    """Return the programs of a controller, with folded weights inside.

        init: (key) -> state leaves
        act: (state leaves, observation, env, *ahead)
             -> (control, state leaves, info leaves)

    Names are paths, such as `state.plan` and `info.plan.cost`. Keys are uint32 data.

    Args:
        trained: the policy.
        ahead: what its controller takes after e, by name; None for a reference.

    Raises:
        ValueError: the state of the controller changes its structure.
    """
    init = trained.controller.init

    def act(*inputs: Any) -> tuple[Any, Any, dict[str, Any]]:
        control, after, info = trained.controller.act(*inputs)
        return control, after, {"healthy": info.healthy, **info._asdict()}

    key, state = _state_of(trained)
    measured = measured_inputs(trained)
    if ahead is not None:
        del measured["reference"]
        measured |= ahead
    wrap = partial(jax.random.wrap_key_data, impl=key_implementation())
    # Flat and named: other programs know neither pytrees nor keys.
    template, structure = jax.tree.flatten(state)

    def flat_init(key_data: Array) -> tuple[Array, ...]:
        return tuple(_unpack(init(wrap(key_data))))

    def flat_act(*leaves: Array) -> tuple[Array, ...]:
        # The leaves of the state come first, then what is measured.
        state_leaves = [
            wrap(leaf) if _is_key(example) else leaf
            for example, leaf in zip(template, leaves, strict=False)
        ]
        measurements = leaves[len(template) :]
        # Without the barrier XLA evaluates functions of the weights at compile time and
        # rounds differently.
        params = jax.lax.optimization_barrier(trained.params)
        before = jax.tree.unflatten(structure, state_leaves)
        control, after, info = act(params, before, *measurements)
        return control, *_unpack(after), *map(jnp.asarray, jax.tree.leaves(info))

    shapes = tuple(measured.values())
    control, after, info = jax.eval_shape(act, trained.params, state, *shapes)
    states = _named("state", state)
    # Programs have fixed shapes, so a state must come out as it went in.
    if _named("state", after) != states or jax.tree.structure(after) != structure:
        raise ValueError(
            "cannot export a controller whose state changes its structure, "
            "shapes or dtypes"
        )
    inputs = (*states, *map(_leaf, measured, shapes))
    outputs = (_leaf("control", control), *states, *_named("info", info))
    return {
        "init": Program(flat_init, (_leaf("key", key),), states),
        "act": Program(flat_act, inputs, outputs),
    }


def measured_inputs(trained: Policy | SystemPolicy) -> dict[str, Shape]:
    """Return the shapes of what `act` takes after its state, by name."""
    interface = trained.interface
    shapes = {
        "observation": (len(interface["observation"]),),
        "env": (len(interface["environment"]["low"]),),
        "reference": trained.reference_shape,
    }
    return {
        name: jax.ShapeDtypeStruct(shape, jnp.float32) for name, shape in shapes.items()
    }


def _state_of(trained: Policy | SystemPolicy) -> tuple[Any, Any]:
    """Return the shapes of a random key and of the state of a controller."""
    key = jax.eval_shape(partial(jax.random.key, 0))
    return key, jax.eval_shape(trained.controller.init, key)


def key_implementation() -> str:
    """Return the name of the random generator; the shape of a key depends on it."""
    return str(jax.random.key_impl(jax.random.key(0)))


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _unpack(tree: Any) -> list[Array]:
    """Return the leaves, with keys as their data."""
    return [
        jax.random.key_data(leaf) if _is_key(leaf) else leaf
        for leaf in jax.tree.leaves(tree)
    ]


def _leaf(name: str, value: Any) -> Leaf:
    """Return name, shape and dtype of an array, or of the data of a key."""
    data = jax.eval_shape(jax.random.key_data, value) if _is_key(value) else value
    return Leaf(name, tuple(data.shape), str(data.dtype))


def _named(root: str, tree: Any) -> tuple[Leaf, ...]:
    """Return the leaves of a tree by dotted path."""
    name = partial(jax.tree_util.keystr, simple=True, separator=".")
    pairs = jax.tree_util.tree_leaves_with_path(tree)
    return tuple(_leaf(f"{root}.{name(path)}", leaf) for path, leaf in pairs)


def compile_iree(stablehlo: str, flags: Sequence[str]) -> bytes:
    """Return an IREE module (.vmfb) for CPUs, with the function `main`.

    IREE has no LAPACK: it refuses `koopman_mpc` and ControlSynth, which factorise.
    """
    try:
        from iree import compiler  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            "export.iree=true needs IREE: pip install 'sfkd-jax[cpp]'"
        ) from None
    try:
        return compiler.compile_str(
            stablehlo,
            input_type="stablehlo",
            target_backends=["llvm-cpu"],
            extra_args=list(flags),
        )
    except compiler.CompilerToolError as error:
        message = str(error).partition("Diagnostics:\n")[2] or str(error)
        raise ValueError(f"iree-compile failed: {store.one_line(message)}") from error


def warm_up(trained: Policy | SystemPolicy) -> jax.stages.Compiled:
    """Compile `act` for the shapes of a policy, so that no step waits for a compiler.

        act = warm_up(policy)
        control, state, info = act(policy.params, state, observation, env, reference)

    With JAX_COMPILATION_CACHE_DIR set, later processes load the machine code.

    It takes float32 arrays of the policy's shapes only.
    """
    _, state = _state_of(trained)
    measured = measured_inputs(trained).values()
    act = jax.jit(trained.controller.act)
    return act.lower(trained.params, state, *measured).compile()
