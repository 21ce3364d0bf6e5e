"""A controller as two functions from flat arrays to flat arrays, every array with a name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
from jaxtyping import Array

from sfkd_jax import build
from sfkd_jax.exporting._jax_settings import jax_settings
from sfkd_jax.policy import Policy


class Leaf(NamedTuple):
    """One array that crosses the border."""

    name: str
    shape: tuple[int, ...]
    dtype: str


class Program(NamedTuple):
    """A function of flat arrays, what it takes and what it returns, in order."""

    function: Callable[..., tuple[Array, ...]]
    inputs: tuple[Leaf, ...]
    outputs: tuple[Leaf, ...]


class Programs(NamedTuple):
    """A controller as others run it.

    Attributes:
        init: (key) -> state leaves.
        act: (state leaves, observation, env, reference) -> (control, state leaves, info
            leaves).
        key_implementation: how keys are drawn from; outside they are their uint32 data.
    """

    init: Program
    act: Program
    key_implementation: str


def example_inputs(policy: Policy) -> tuple[Any, ...]:
    """Shapes of (key, controller state, observation, env, reference) of a policy's controller."""
    key = jax.eval_shape(partial(jax.random.key, 0))
    settings = policy.settings
    plant = build.build_vehicle(settings["vehicle"])
    sizes = (len(plant.state_names),), (len(settings["space"]["env_mean"]),)
    shapes = *sizes, (build.controller_horizon(settings["controller"]), 4)
    measured = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)
    return key, jax.eval_shape(policy.controller.init, key), *measured


def flat_programs(policy: Policy) -> Programs:
    """The controller of a policy over flat arrays, its weights inside, folded.

    Names are paths: `state.inner.plan`, `info.cost`. Typed keys do not cross a border,
    so their uint32 data do.

    Raises:
        ValueError: the controller's state changes its structure, shapes or dtypes from
            step to step.
    """
    key, state, *measured = example_inputs(policy)
    implementation = str(jax.random.key_impl(jax.random.key(0)))
    wrap = partial(jax.random.wrap_key_data, impl=implementation)
    template, structure = jax.tree.flatten(state)
    folded = jax.jit(policy.model.fold)(policy.params)

    def init(key_data: Array) -> tuple[Array, ...]:
        return tuple(_opened(policy.controller.init(wrap(key_data))))

    def closed(leaves: Sequence[Array]) -> Any:
        wrapped = [
            wrap(leaf) if _is_key(like) else leaf
            for like, leaf in zip(template, leaves, strict=True)
        ]
        return jax.tree.unflatten(structure, wrapped)

    def act(*leaves: Array) -> tuple[Array, ...]:
        *before, observation, env, reference = leaves
        # Without the barrier XLA evaluates at compile time what depends on weights
        # alone, and rounds otherwise.
        params = jax.lax.optimization_barrier(folded)
        control, after, info = policy.controller.act(
            params, closed(before), observation, env, reference
        )
        return control, *_opened(after), *jax.tree.leaves(info)

    control, after, info = jax.eval_shape(
        policy.controller.act, folded, state, *measured
    )
    if (
        _named("state", after) != _named("state", state)
        or jax.tree.structure(after) != structure
    ):
        raise ValueError(
            "cannot export a controller whose state changes its structure, shapes or dtypes"
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
    started = Program(init, (_leaf("key", key),), _named("state", state))
    return Programs(started, Program(act, inputs, outputs), implementation)


def specifications(program: Program) -> tuple[jax.ShapeDtypeStruct, ...]:
    """The shapes of a program's inputs as jax takes them."""
    return tuple(
        jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in program.inputs
    )


def lowered(
    function: Callable[..., Any], program: Program, platforms: tuple[str, ...]
) -> jax.export.Exported:
    """A function of a program's inputs as StableHLO; no argument is dropped, also if nothing depends on it.

    Without the places in source files that jax notes beside every operation: they tell
    where this machine keeps its files, and make the same program another one elsewhere.
    """
    with jax_settings({"jax_traceback_in_locations_limit": 0}):
        lower = jax.export.export(
            jax.jit(function, keep_unused=True), platforms=platforms
        )
        return lower(*specifications(program))


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _opened(tree: Any) -> list[Array]:
    """Leaves, keys as their data."""
    return [
        jax.random.key_data(leaf) if _is_key(leaf) else leaf
        for leaf in jax.tree.leaves(tree)
    ]


def _leaf(name: str, value: Any) -> Leaf:
    """What is known of an array before it is there."""
    data = jax.eval_shape(jax.random.key_data, value) if _is_key(value) else value
    return Leaf(name, tuple(data.shape), str(data.dtype))


def _named(root: str, tree: Any) -> tuple[Leaf, ...]:
    """The leaves of a tree under dotted paths."""
    paths = jax.tree_util.tree_leaves_with_path(tree)
    names = (
        f"{root}.{jax.tree_util.keystr(path, simple=True, separator='.')}"
        for path, _ in paths
    )
    return tuple(
        _leaf(name, leaf) for name, (_, leaf) in zip(names, paths, strict=True)
    )
