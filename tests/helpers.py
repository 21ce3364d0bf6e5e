"""Builders that several test files share."""

import copy
import inspect
import json
import os
import resource
import subprocess
import sys
from contextlib import contextmanager
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from safetensors.numpy import save

from sfkd_jax import certification, models, paper, store
from sfkd_jax import data as datasets
from sfkd_jax.driving import drives, path_coordinates, path_following, plants
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.types import Space, Trajectory

jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
"""jax.jit for what runs once: it compiles two to three times as fast."""

fused = (
    {"xla_cpu_use_fusion_emitters": True}
    if "fusion_emitters" in os.environ["XLA_FLAGS"]
    else {}
)
optimised = partial(
    jax.jit, compiler_options={"xla_backend_optimization_level": 3, **fused}
)
"""jax.jit as it is where conftest.py does not speed compiling up: for what takes many
steps, or must agree with such a program to the last bit.
"""

ENV_LOW, ENV_HIGH = (0.3, -8.0), (0.9, 8.0)
SHARES = (0.4, 0.2, 0.2, 0.2)
TINY = {
    "rank": 8,
    "vertices": 3,
    "residual_hidden": (8, 8),
    "decoder_hidden": (8,),
    "encoder_hidden": 8,
    "embedding": 4,
    "budget": "sum",
}
VARIANTS = {
    "sfkd": {},
    "joint": {"budget": "joint"},
    "no_fiber": {"environment": False},
    "no_transport": {"transport": False},
    "no_residual": {"residual": "none"},
    "no_contraction": {"residual": "free"},
    "soft": {"residual": "free", "soft_penalty": 1.0},
    "path": {"frame": PATH_FRAME},
    "state": {
        "frame": PATH_FRAME,
        "transport": False,
        "lift": "state",
        "scheduled": True,
    },
}
HARD = ("sfkd", "no_fiber", "no_transport")
"""Variants whose operator and residual are each bounded by construction (and are
there).
"""
PHYSICS = ("oracle", "nominal")
FACTORIES = models.FACTORIES | paper.MODELS
OTHERS = tuple(name for name in FACTORIES if name != "sfkd")
"""Other learned models, with their default settings."""


def space(body=1):
    """Scales about those of the kinematic plant (body = 1) or the dynamic one (body =
    4).
    """
    return Space(
        body_mean=jnp.zeros(body).at[0].set(10.0),
        body_scale=jnp.full(body, 0.5).at[0].set(4.0),
        control_mean=jnp.asarray([0.0, 0.2]),
        control_scale=jnp.asarray([0.2, 2.0]),
        env_mean=jnp.asarray([0.6, 0.0]),
        env_scale=jnp.asarray([0.3, 8.0]),
        increment_mean=jnp.asarray([1.0, 0.0, 0.0]),
        increment_scale=jnp.asarray([0.3, 0.05, 0.1]),
    )


def path_space():
    """Scales about those of the kinematic plant along a path."""
    controls = {
        "control_mean": jnp.asarray([0.0, 0.0, 0.0, 9.0]),
        "control_scale": jnp.asarray([0.03, 1.0, 0.02, 1.5]),
    }
    return space(3)._replace(**controls)


def any_law(coordinates=3):
    """A law that follows a path slowly, the same in every environment."""
    corners = (2, 2, 2, 2)
    gain = np.zeros((*corners, 2, coordinates), np.float32)
    gain[..., 0, :2], gain[..., 1, 2] = (0.05, 0.5), 1.0
    turn = np.zeros((*corners, 2), np.float32)
    turn[0, ..., 0], turn[1, ..., 0] = -0.06, 0.06
    return path_following.PathLaw(
        low=jnp.asarray([-2.0, 8.0, 0.3, -8.0]),
        high=jnp.asarray([2.0, 10.5, 0.9, 8.0]),
        perturbation=jnp.asarray([0.03, 1.0]),
        state=jnp.zeros((*corners, coordinates)),
        control=jnp.asarray(turn),
        gain=jnp.asarray(gain),
    )


def tiny(name="sfkd", **changes):
    """A tiny SFKD of some variant."""
    body = changes.pop("body", 1)
    return models.sfkd(space(body), **TINY | VARIANTS[name] | changes)


@cache
def model_and_params(name="sfkd", scale=1.0):
    """A model by the name of a variant or of a physics row, and generic parameters,
    multiplied by `scale`.
    """
    plant = plants.kinematic()
    if name in PHYSICS:
        return models.physics(plant.step if name == "oracle" else plant.nominal), {}
    return _model(name), jax.tree.map(lambda leaf: scale * leaf, generic(name))


@cache
def _model(name):
    """Return one object per variant, so that it is compiled once."""
    if name not in OTHERS:
        return tiny(name)
    factory, known = FACTORIES[name], {}
    if "nominal" in inspect.signature(factory).parameters:
        known = {"nominal": plants.kinematic().nominal_derivative}
    return factory(space(), **known)


@cache
def generic(name):
    """Parameters in the shape of the model's own initial ones, none of them 0: weights
    of unit gain, small offsets.
    """
    random = np.random.default_rng(1)

    def drawn(leaf):
        spread = leaf.shape[-2] ** -0.5 if len(leaf.shape) > 1 else 0.3
        return jnp.asarray(
            spread * random.standard_normal(leaf.shape), dtype=leaf.dtype
        )

    return jax.tree.map(drawn, jax.eval_shape(_model(name).init, jax.random.key(0)))


def explicit(name="sfkd", scale=1.0):
    """The explicit structure that a certificate is about, in float64."""
    model, params = model_and_params(name, scale)
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, dtype=np.float64),
        jax.jit(model.structure.explicit)(params),
    )


@cache
def certified(name="sfkd", scale=1.0):
    """What is proved of such a model, nothing attacked."""
    return certification.prove(
        *model_and_params(name, scale), (ENV_LOW, ENV_HIGH), attack_starts=0
    )


def drive(plant, initial, controls, envs):
    """The plant's own trajectory, x_{k+1} = step(x_k, u_k, e_k), without any model."""

    def step(state, inputs):
        after = plant.step(state, *inputs)
        return after, after

    _, states = jax.lax.scan(step, initial, (controls, envs))
    return Trajectory(jnp.concatenate([initial[None], states]), controls, envs)


@cache
def driven(count=3, steps=12):
    """A few trajectories of the kinematic plant with bold controls and an environment
    that switches at every step.
    """
    plant = plants.kinematic()
    start_key, control_key, env_key = jax.random.split(jax.random.key(5), 3)
    spread = jnp.asarray([3.0, 3.0, 4.0, 2.0])
    initial = jnp.asarray([0.0, 0.0, 0.0, 10.0]) + spread * jax.random.uniform(
        start_key, (count, 4), minval=-1.0
    )
    controls = jnp.asarray([0.1, 1.0]) * jax.random.uniform(
        control_key, (count, steps, 2), minval=-1.0
    )
    low, high = jnp.asarray(ENV_LOW), jnp.asarray(ENV_HIGH)
    envs = low + (high - low) * jax.random.uniform(env_key, (count, steps, 2))
    return jit(jax.vmap(partial(drive, plant)))(initial, controls, envs)


def driver(plant):
    """The path-following law that drives while data are collected."""
    law = path_following.path_feedback(
        wheelbase=plant.wheelbase, speed_loop=plant.speed_loop
    )

    def follow(state, reference):
        curvature = path_coordinates.reference_curvature(reference)[0]
        return law(
            path_following.path_errors(state, reference[0], curvature),
            curvature,
            reference[0, 3],
        )

    return follow


@cache
def generator(count=120, steps=25):
    """key -> training segments of the kinematic plant, compiled once."""
    plant = plants.kinematic()
    return jit(
        partial(drives.generate, plant, driver(plant), segments=count, steps=steps)
    )


@cache
def segments(count=120, steps=25, seed=0):
    """A small batch of training segments."""
    return generator(count, steps)(jax.random.key(seed))


@cache
def dataset(count=120, steps=25):
    """The same, split into the four parts."""
    low, high = jnp.asarray(ENV_LOW), jnp.asarray(ENV_HIGH)
    return datasets.split(
        segments(count, steps),
        jax.random.key(1),
        shares=SHARES,
        env_low=low,
        env_high=high,
        scenarios=jnp.asarray(drives.segment_scenarios(count)),
    )


def straight(horizon, speed=10.0, dt=0.1):
    """A reference along the x axis."""
    ahead = speed * dt * jnp.arange(1, horizon + 1)
    zeros = jnp.zeros(horizon)
    return jnp.stack([ahead, zeros, zeros, jnp.full(horizon, speed)], axis=1)


def at(tree, index):
    """One entry along the leading axis of every leaf."""
    return jax.tree.map(lambda leaf: leaf[index], tree)


def same(left, right, **tolerance):
    """Whether two pytrees have the same structure and (nearly) the same leaves; NaN
    equals NaN, keys count.
    """
    if jax.tree.structure(left) != jax.tree.structure(right):
        return False
    pairs = zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    return all(
        jnp.allclose(_plain(a), _plain(b), equal_nan=True, **tolerance)
        for a, b in pairs
    )


def _plain(leaf):
    """Keys as the numbers behind them."""
    return (
        jax.random.key_data(leaf)
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        else leaf
    )


def run_command(name, *arguments, cwd, code=0):
    """Run a command in a process of its own, and expect this exit status."""
    command = [sys.executable, "-m", f"sfkd_jax.{name}", *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=600)
    assert done.returncode == code, done.stderr[-2000:]
    return done


def last_line(done):
    """Return the JSON document that a command prints last."""
    return json.loads(done.stdout.strip().splitlines()[-1])


@contextmanager
def largest_file(size):
    """The kernel stops every write beyond `size` bytes, in the middle of a write if
    need be.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


WEIGHTS = {"x": np.zeros(1)}
WEIGHTS_SHA256 = store.sha256_of_arrays(WEIGHTS)


def write_policy(run, document):
    """A policy.safetensors of one weight whose manifest says what a test wants."""
    manifest = {"kind": "policy", "format": store.FORMAT, "sha256": WEIGHTS_SHA256}
    manifest |= {"made_from": {}, "versions": {}} | document
    manifest["config"] = document.get("settings") or document.get("config") or {}
    manifest["content_sha256"] = store.content_hash(manifest)
    content = save(WEIGHTS, {"manifest": json.dumps(manifest)})
    (run / f"policy{store.SUFFIX}").write_bytes(content)


def refusal_of(action):
    """The one line with which an action fails as a command reports it; None if it does not
    fail.
    """
    try:
        action()
    except (store.ArtefactError, ValueError, OSError) as reason:
        line = str(reason)
    else:
        return None
    assert "\n" not in line
    return line


def put(document, path, value):
    """The same with the value at a dotted path replaced; the document stays as it is."""
    key, _, below = path.partition(".")
    changed = copy.copy(document)
    key = int(key) if isinstance(document, list) else key
    changed[key] = put(document[key], below, value) if below else value
    return changed
