"""Controllers as functions of flat, named arrays, and compiled before a first step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
from jax.experimental.compilation_cache import compilation_cache
from jax.extend.core import ClosedJaxpr, Literal, Var, jaxpr_as_fun
from jaxtyping import Array

from sfkd_jax import build
from sfkd_jax.policy import Policy


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

    @property
    def shapes(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        """Of the inputs."""
        return tuple(
            jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in self.inputs
        )

    def lower(self, *platforms: str) -> jax.export.Exported:
        """Return the program as StableHLO for platforms, including unused arguments.

        Source locations are left out: they contain paths of this machine and would make
        the result depend on it.
        """
        with _jax_settings({"jax_traceback_in_locations_limit": 0}):
            function = jax.jit(self.function, keep_unused=True)
            return jax.export.export(function, platforms=platforms)(*self.shapes)


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


def _example_inputs(policy: Policy) -> tuple[Any, ...]:
    """The shapes of key, controller state, observation, env and reference."""
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
    key, state, *measured = _example_inputs(policy)
    implementation = str(jax.random.key_impl(jax.random.key(0)))
    wrap = partial(jax.random.wrap_key_data, impl=implementation)
    # Flat and named: other programs know neither pytrees nor keys.
    template, structure = jax.tree.flatten(state)

    def init(key_data: Array) -> tuple[Array, ...]:
        return tuple(_unpack(policy.controller.init(wrap(key_data))))

    def act(*leaves: Array) -> tuple[Array, ...]:
        *before, observation, env, reference = leaves
        before = [
            wrap(leaf) if _is_key(like) else leaf
            for like, leaf in zip(template, before, strict=True)
        ]
        # Without the barrier XLA evaluates functions of the weights at compile time and
        # rounds differently.
        params = jax.lax.optimization_barrier(policy.params)
        control, after, info = policy.controller.act(
            params, jax.tree.unflatten(structure, before), observation, env, reference
        )
        return control, *_unpack(after), *jax.tree.leaves(info)

    control, after, info = jax.eval_shape(
        policy.controller.act, policy.params, state, *measured
    )
    states = _named("state", state)
    # Programs have fixed shapes, so a state must come out as it went in.
    if _named("state", after) != states or jax.tree.structure(after) != structure:
        raise ValueError(
            "cannot export a controller whose state changes its structure, "
            "shapes or dtypes"
        )
    names = ("observation", "env", "reference")
    inputs = (*states, *map(_leaf, names, measured))
    outputs = (_leaf("control", control), *states, *_named("info", info))
    initial = Program(init, (_leaf("key", key),), states)
    return Programs(initial, Program(act, inputs, outputs), implementation)


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
    name = partial(jax.tree_util.keystr, simple=True, separator=".")
    pairs = jax.tree_util.tree_leaves_with_path(tree)
    return tuple(_leaf(f"{root}.{name(path)}", leaf) for path, leaf in pairs)


def fold_constants(program: Program) -> Program:
    """Return the same program with all operations on constants replaced by results.

    IREE has no LAPACK and cannot compile factorisations. With folded parameters one
    model still has factorisations of its weights: ControlSynth, for the inverse of its
    metric's factor. Factorisations in every control step remain: those of the quadratic
    program of `koopman_mpc` and the eigenvectors of `curvature`. The rounding differs
    from that of a single program.
    """
    closed = jax.make_jaxpr(program.function)(*program.shapes)
    jaxpr = closed.jaxpr
    known, ahead, rest = set(jaxpr.constvars), [], []
    for equation in jaxpr.eqns:
        # An effect, such as a print, belongs to every step.
        constant = not equation.effects and all(
            isinstance(atom, Literal) or atom in known for atom in equation.invars
        )
        (ahead if constant else rest).append(equation)
        known |= set(equation.outvars) if constant else set()
    wanted = [atom for equation in rest for atom in equation.invars]
    wanted += list(jaxpr.outvars)
    border: Any = [
        atom
        for atom in dict.fromkeys(x for x in wanted if isinstance(x, Var))
        if atom in known
    ]
    names = jaxpr.debug_info.with_unknown_names()
    first = jaxpr.replace(invars=[], outvars=border, eqns=ahead, debug_info=names)
    values = jax.jit(jaxpr_as_fun(ClosedJaxpr(first, closed.consts)))()
    second = jaxpr.replace(constvars=border, eqns=rest, debug_info=names)
    remaining = jaxpr_as_fun(ClosedJaxpr(second, values))

    def main(*leaves: Array) -> Sequence[Array]:
        return remaining(*leaves)

    return program._replace(function=main)


def compile_iree(program: Program, *, flags: Sequence[str] = ()) -> bytes:
    """Return an IREE module (.vmfb) for CPUs, with the function `main`.

    Arguments and results are those of the manifest.

    Args:
        program: to compile.
        flags: for iree-compile, such as the processor or the target triple.

    Raises:
        ValueError: IREE is not installed, or does not compile this program; with its
            first error.
    """
    try:
        from iree import compiler  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ValueError(
            "export.iree=true needs IREE: pip install 'sfkd-jax[cpp]'"
        ) from None
    text = fold_constants(program).lower("cpu").mlir_module()
    try:
        return compiler.compile_str(
            text,
            input_type="stablehlo",
            target_backends=["llvm-cpu"],
            extra_args=list(flags),
        )
    except compiler.CompilerToolError as error:
        message = str(error).partition("Diagnostics:\n")[2] or str(error)
        raise ValueError(
            f"iree-compile failed: {message.splitlines()[0][:300]}"
        ) from error


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
    _, state, *measured = _example_inputs(policy)

    # A new function: jax would not compile and cache one again that has run.
    def act(*arguments: Any) -> Any:
        return policy.controller.act(*arguments)

    lowered = jax.jit(act).lower(policy.params, state, *measured)
    if cache is None:
        return lowered.compile()
    # Every compilation is kept, however short and small.
    settings = {
        "jax_enable_compilation_cache": True,
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
        "jax_compilation_cache_dir": str(Path(cache).expanduser().resolve()),
    }
    try:
        with _jax_settings(settings):
            # An open cache ignores changed settings.
            compilation_cache.reset_cache()
            return lowered.compile()
    finally:
        compilation_cache.reset_cache()


@contextmanager
def _jax_settings(values: Mapping[str, object]) -> Iterator[None]:
    """Set settings of jax by name, and restore them afterwards.

    Other threads should not trace or compile meanwhile.
    """
    before = {name: getattr(jax.config, name) for name in values}
    try:
        for name, value in values.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
