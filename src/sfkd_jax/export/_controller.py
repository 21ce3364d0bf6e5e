"""Write a controller as programs of flat arrays: StableHLO, and IREE made from it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sfkd_jax import policy, store
from sfkd_jax.certificate import write
from sfkd_jax.driving.lanes import Lane, Obstacles
from sfkd_jax.driving.path_following import InLane, moved_on
from sfkd_jax.driving.paths import Path as Road
from sfkd_jax.driving.sizes import length_scale
from sfkd_jax.policy import Policy
from sfkd_jax.ranges import MayBeEmpty, Names, Positive
from sfkd_jax.types import Controller

FORMAT = 2
"""Version of the manifest and of the order of arguments; run_controller.py reads no
other version.
"""
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
FILES = {"act": "controller", "init": "initial_state"}
"""Program -> the name of its files, without a suffix."""
MANIFEST = "controller.json"
SCRIPT = "run_controller.py"
"""The program in the export that runs it without sfkd_jax."""


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


def write_controller(
    trained: Policy,
    folder: Path,
    *,
    platforms: tuple[str, ...] = ("cpu", "cuda"),
    lane: Annotated[tuple[int, ...], MayBeEmpty()] = (),
    car: tuple[Positive, Positive] | None = None,
    iree: bool = False,
    iree_flags: Names = ("--iree-llvmcpu-target-cpu=host",),
) -> dict[str, Any]:
    """Write a controller for processes without sfkd_jax, and return its manifest.

    Args:
        trained: the policy.
        folder: to write; an earlier export in it is replaced.
        platforms: some of `PLATFORMS`, for which the programs are compiled.
        lane: (points of the road, obstacles, predicted steps of each) for a controller
            that drives in a lane; () for one that follows a reference.
        car: length and width of the car [m], for a lane; None for those of the vehicle.
        iree: whether to compile for C and C++ as well.
        iree_flags: for iree-compile.
    """
    if not platforms or not set(platforms) <= set(PLATFORMS):
        raise ValueError(
            f"export.platforms must be some of {', '.join(PLATFORMS)}, "
            f"got {list(platforms)}"
        )
    # Everything that can refuse comes before the first file is written.
    ahead = None
    car = car or trained.vehicle.size
    if lane:
        trained, ahead = in_window(trained, lane, car)
    programs = flat_programs(trained, ahead)
    exported = {name: program.lower(*platforms) for name, program in programs.items()}
    modules = _compile_all_for_iree(programs, iree_flags) if iree else {}
    _remove_earlier_export(folder)
    # The policy too, so that `load` reads an export as it reads a run.
    path = folder / "policy.safetensors"
    stored = policy.save(path, trained.weights, trained.settings, law=trained.law)
    manifest = {
        "kind": "controller",
        "format": FORMAT,
        "jax": jax.__version__,
        "calling_convention_version": exported["act"].calling_convention_version,
        "platforms": list(platforms),
        "key_implementation": _key_implementation(),
        "programs": {
            name: _write_program(folder, name, program, programs[name])
            for name, program in exported.items()
        },
        "iree": _write_modules(folder, modules) or None,
        "iree_flags": list(iree_flags) if iree else None,
        "weights_sha256": stored["sha256"],
        "certificate_sha256": _certificate(trained, folder, stored["content_sha256"]),
        **trained.interface,
        "car_m": list(car) if lane else None,
        "parameters": sum(np.size(leaf) for leaf in jax.tree.leaves(trained.weights)),
        "settings": trained.settings,
        "versions": store.versions(),
    }
    script = resources.files("sfkd_jax.export").joinpath(f"_{SCRIPT}").read_bytes()
    store.write_bytes(folder / SCRIPT, script)
    # Last: a folder with a manifest is whole.
    manifest["sha256"] = store.sha256(manifest)
    store.write_json(folder / MANIFEST, manifest)
    return manifest


def _compile_all_for_iree(
    programs: Mapping[str, Program], flags: Sequence[str]
) -> dict[str, bytes]:
    """Return the IREE module of each program, by its name."""
    return {
        name: _compile_iree(program.lower("cpu").mlir_module(), flags)
        for name, program in programs.items()
    }


def _remove_earlier_export(folder: Path) -> None:
    """Remove what would belong to another export than the one that is written next.

    The manifest goes first: a folder without it is no export.
    """
    modules = [f"{file}.vmfb" for file in FILES.values()]
    for name in (MANIFEST, policy.CERTIFICATE, *modules):
        (folder / name).unlink(missing_ok=True)


def _write_program(
    folder: Path, name: str, exported: jax.export.Exported, program: Program
) -> dict[str, Any]:
    """Write a program as StableHLO, and return its entry in the manifest."""
    path = folder / f"{FILES[name]}.stablehlo"
    return {
        **_write(path, bytes(exported.serialize())),
        "inputs": [leaf._asdict() for leaf in program.inputs],
        "outputs": [leaf._asdict() for leaf in program.outputs],
    }


def _write_modules(folder: Path, modules: Mapping[str, bytes]) -> dict[str, Any]:
    """Write IREE modules, and return their entries in the manifest."""
    return {
        name: _write(folder / f"{FILES[name]}.vmfb", module)
        for name, module in modules.items()
    }


def _write(path: Path, content: bytes) -> dict[str, Any]:
    """Write a file and return its name, size and hash."""
    store.write_bytes(path, content)
    digest = hashlib.sha256(content).hexdigest()
    return {"file": path.name, "bytes": len(content), "sha256": digest}


def _certificate(trained: Policy, folder: Path, policy_sha256: str) -> str | None:
    """Write the verified certificate of a policy, and return the hash of the file.

    It refers to the settings as exported, perhaps with another controller. None: the
    policy has no certificate.
    """
    if trained.certificate is None:
        return None
    path = folder / policy.CERTIFICATE
    provenance = replace(trained.certificate.provenance, policy_sha256=policy_sha256)
    # A signature stays if this changes nothing.
    write(path, replace(trained.certificate, provenance=provenance))
    return hashlib.sha256(path.read_bytes()).hexdigest()


# ---- programs


def flat_programs(
    trained: Policy, ahead: Mapping[str, jax.ShapeDtypeStruct] | None = None
) -> dict[str, Program]:
    """Return the programs of a controller, with folded weights inside.

        init: (key) -> state leaves
        act: (state leaves, observation, env, *ahead)
             -> (control, state leaves, info leaves)

    Names are paths, such as `state.plan` and `info.plan.cost`. Keys are uint32 data.

    Args:
        trained: the policy.
        ahead: what its controller takes after e, by name; None for a reference.
    """
    init = trained.controller.init

    def act(*inputs: Any) -> tuple[Any, Any, dict[str, Any]]:
        control, after, info = trained.controller.act(*inputs)
        return control, after, {"healthy": info.healthy, **info._asdict()}

    key, state, *measured = _example_inputs(trained)
    names = ["observation", "env", "reference"]
    if ahead is not None:
        names = [*names[:2], *ahead]
        measured = [*measured[:2], *ahead.values()]
    wrap = partial(jax.random.wrap_key_data, impl=_key_implementation())
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

    control, after, info = jax.eval_shape(act, trained.params, state, *measured)
    states = _named("state", state)
    # Programs have fixed shapes, so a state must come out as it went in.
    if _named("state", after) != states or jax.tree.structure(after) != structure:
        raise ValueError(
            "cannot export a controller whose state changes its structure, "
            "shapes or dtypes"
        )
    inputs = (*states, *map(_leaf, names, measured))
    outputs = (_leaf("control", control), *states, *_named("info", info))
    return {
        "init": Program(flat_init, (_leaf("key", key),), states),
        "act": Program(flat_act, inputs, outputs),
    }


def in_window(
    trained: Policy, lane: Sequence[int], car: tuple[float, float]
) -> tuple[Policy, dict[str, jax.ShapeDtypeStruct]]:
    """Return a policy in its lane that takes a scene as arrays, and their shapes.

    The road is a window of points. `moved` is by how many of them the window has moved
    on since the step before. It must reach from behind the car to beyond what is
    planned, or the car stops at its end.

    Args:
        trained: the policy.
        lane: (points of the road, obstacles, predicted steps of each).
        car: length and width of the car [m].
    """
    if len(lane) != 3 or min(lane) < 1:
        raise ValueError(
            "export.lane must be [points of the road, obstacles, predicted steps], "
            f"got {list(lane)}"
        )
    points, obstacles, steps = lane
    driver = trained.in_lane(car=(car[0], car[1]))
    apart = length_scale(trained.vehicle.wheelbase) * InLane.spacing
    shapes: dict[str, tuple[int, ...]] = {
        "road": (points, 4),
        "spacing": (),
        "left": (points,),
        "right": (points,),
        "speed": (points,),
        "position": (obstacles, steps, 2),
        "yaw": (obstacles,),
        "half": (obstacles, 2),
        "radius": (obstacles,),
        "present": (obstacles,),
        "moved": (),
    }

    def act(
        params: Any, state: Any, observation: Any, env: Any, *ahead: Array
    ) -> tuple[Any, Any, Any]:
        road, spacing, left, right, speed, *obstacles, moved = ahead
        window = Road(road, spacing)
        scene = Lane(window, left, right, speed), Obstacles(*obstacles)
        state = moved_on(state, window, moved, apart)
        return driver.act(params, state, observation, env, scene)

    dtypes = {"present": bool, "moved": jnp.int32}
    ahead = {
        name: jax.ShapeDtypeStruct(shape, dtypes.get(name, jnp.float32))
        for name, shape in shapes.items()
    }
    return replace(trained, controller=Controller(driver.init, act)), ahead


def _example_inputs(trained: Policy) -> tuple[Any, ...]:
    """Return the shapes of key, controller state, observation, env and reference."""
    key = jax.eval_shape(partial(jax.random.key, 0))
    state = jax.eval_shape(trained.controller.init, key)
    settings = trained.settings
    horizon = trained.interface["horizon"]
    return (
        key,
        state,
        jax.ShapeDtypeStruct((len(trained.vehicle.state_names),), jnp.float32),
        jax.ShapeDtypeStruct((len(settings["space"]["env_mean"]),), jnp.float32),
        jax.ShapeDtypeStruct((horizon, 4), jnp.float32),
    )


def _key_implementation() -> str:
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


def _compile_iree(stablehlo: str, flags: Sequence[str]) -> bytes:
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


def warm_up(trained: Policy) -> jax.stages.Compiled:
    """Compile `act` for the shapes of a policy, so that no step waits for a compiler.

        act = warm_up(policy)
        control, state, info = act(policy.params, state, observation, env, reference)

    With JAX_COMPILATION_CACHE_DIR set, later processes load the machine code.

    It takes float32 arrays of the policy's shapes only.
    """
    _, state, *measured = _example_inputs(trained)
    act = jax.jit(trained.controller.act)
    return act.lower(trained.params, state, *measured).compile()
