"""Attacks: they search for the largest contraction factor that a map really has, a lower bound for any certificate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from sfkd_jax.certification._core import Matrix, Vector
from sfkd_jax.certification._environments import Box
from sfkd_jax.types import POSE, Key, Model, Params


def attack_slopes(
    weights: Sequence[Matrix],
    linear: Matrix | None = None,
    *,
    starts: int = 24,
    seed: int = 0,
) -> float:
    """Largest ||A + W_L D_{L-1} W_{L-1} … D_1 W_1||_2 found over slopes D_k in [0, 1].

    The norm is convex in each D_k, so its maximum is at 0 or 1: with the top singular
    pair fixed, each layer's slopes are chosen by the sign of their effect, in turn,
    until nothing grows.

    Args:
        weights: W_1 … W_L, or nothing.
        linear: A.
        starts: random beginnings, the first all ones.
        seed: of these.
    """
    random, best = np.random.default_rng(seed), 0.0
    if not weights:
        return float(np.linalg.norm(np.asarray(linear), 2))
    base = (
        np.zeros((weights[-1].shape[0], weights[0].shape[1]))
        if linear is None
        else np.asarray(linear)
    )
    for start in range(starts):
        share = 1.0 if start == 0 else random.uniform(0.2, 1.0)
        slopes = [
            (random.uniform(size=len(weight)) < share).astype(float)
            for weight in weights[:-1]
        ]
        value = 0.0
        while True:
            for k in range(len(slopes)):
                slopes[k] = _best_layer(weights, slopes, base, k)
            after = float(np.linalg.norm(base + _chain(weights, slopes), 2))
            if after <= value * (1 + 1e-12):
                break
            value = after
        best = max(best, value)
    return best


def attack_step(
    model: Model,
    params: Params,
    box: Box,
    key: Key,
    *,
    starts: int = 12,
    iterations: int = 120,
) -> float:
    """Largest ||∂(T(e → e') F(z, u, e))/∂z||_2 of the model as it runs in float32, by ascent over z, u, e, e'.

    F is `model.step` followed by `model.transport`. e and e' stay in the box; z and u
    are free, as the certificate claims. The ascent follows |J v|²/|v|² over the
    direction v as well; the value returned is the full norm.

    Args:
        model: with `explicit`.
        params: its weights.
        box: lower and upper corner of E.
        key: for the beginnings.
        starts: how many.
        iterations: of L-BFGS-B, each.
    """
    inject, *_ = _coordinates(model, params, len(box[0]))

    def step(params: Params, z: Any, control: Any, env: Any, later: Any) -> Any:
        fiber, fiber_next = model.fiber(params, env), model.fiber(params, later)
        return model.vector(
            model.transport(fiber, fiber_next, model.step(fiber, inject(z), control))
        )

    found = _steepest(
        step, model, params, box, key, starts=starts, iterations=iterations
    )
    return max(float(np.linalg.norm(jacobian, 2)) for jacobian in found)


def attack_decoder(
    model: Model,
    params: Params,
    box: Box,
    key: Key,
    *,
    starts: int = 12,
    iterations: int = 60,
) -> dict[str, float]:
    """Largest ||∂/∂z|| of what the model emits as it runs: "position" [m], "yaw" [rad], "decoder" (both), "body".

    The pose increment is that of a step and, where the pose lies in the latent, that of
    reading it; see `attack_step`.
    """
    inject, *_ = _coordinates(model, params, len(box[0]))

    def emitted(params: Params, z: Any, control: Any, env: Any, later: Any) -> Any:
        del later
        fiber, latent = (
            model.fiber(params, env),
            inject(z),
        )  # at the origin, so that an increment is a pose
        after, read = (
            model.decode(fiber, model.step(fiber, latent, control)),
            model.decode(fiber, latent),
        )
        return jnp.concatenate([after[POSE], read])

    found = _steepest(
        emitted, model, params, box, key, starts=starts, iterations=iterations
    )
    if (
        model.along_path
    ):  # the pose is read from z with the body state: e_y, e_ψ, then the rest
        parts = {"position": slice(6, 7), "yaw": slice(7, 8), "body": slice(8, None)}
        return {
            name: max(float(np.linalg.norm(part[row], 2)) for part in found)
            for name, row in parts.items()
        }
    rows = {"position": slice(0, 2), "yaw": slice(2, 3), "decoder": slice(0, 3)}
    poses = [part for jacobian in found for part in (jacobian[:3], jacobian[3:6])]
    steepest = {
        name: max(float(np.linalg.norm(part[row], 2)) for part in poses)
        for name, row in rows.items()
    }
    return steepest | {
        "body": max(float(np.linalg.norm(jacobian[6:], 2)) for jacobian in found)
    }


def _steepest(
    function: Callable[..., Any],
    model: Model,
    params: Params,
    box: Box,
    key: Key,
    *,
    starts: int,
    iterations: int,
) -> list[Matrix]:
    """Jacobians by z of `function(params, z, u, e, e')`, each where an ascent over all four ended."""
    _, rank, controls = _coordinates(model, params, len(box[0]))
    low, high = (np.asarray(side, dtype=np.float64) for side in box)
    inputs = rank + controls + 2 * len(low)
    envs = slice(rank + controls, inputs)

    def at(params: Params, z: Any, rest: Any) -> Any:
        return function(params, z, *jnp.split(rest, [controls, controls + len(low)]))

    def loss(params: Params, point: Any) -> Any:
        z, rest, direction = point[:rank], point[rank:inputs], point[inputs:]
        _, gain = jax.jvp(lambda z: at(params, z, rest), (z,), (direction,))
        return 0.5 * (
            jnp.log(jnp.sum(direction**2)) - jnp.log(jnp.sum(gain**2) + 1e-30)
        )

    objective = jax.jit(jax.value_and_grad(loss, argnums=1))
    jacobian = jax.jit(
        lambda params, point: jax.jacfwd(at, argnums=1)(
            params, point[:rank], point[rank:inputs]
        )
    )
    limits = [(None, None)] * (inputs + rank)
    limits[envs] = 2 * list(zip(low, high, strict=True))
    found = []
    for number, start_key in enumerate(jax.random.split(key, starts)):
        start = np.asarray(
            jax.random.normal(start_key, (inputs + rank,)), dtype=np.float64
        )
        start[: rank + controls] *= 10.0 ** (
            number % 4 - 2
        )  # small latents see steep slopes, large saturated ones
        start[envs] = np.tile(low, 2) + (
            np.arctan(start[envs]) / np.pi + 0.5
        ) * np.tile(high - low, 2)
        search = {
            "method": "L-BFGS-B",
            "jac": True,
            "bounds": limits,
            "options": {"maxiter": iterations},
        }
        ended = minimize(_float64(partial(objective, params)), start, **search)
        found.append(
            np.asarray(
                jacobian(params, jnp.asarray(ended.x, jnp.float32)), dtype=np.float64
            )
        )
    return found


def attack_transport(
    model: Model, params: Params, box: Box, key: Key, *, samples: int = 256
) -> float:
    """Largest ||∂T(e → e') z/∂z||_2 at random pairs of environments in the box; T is linear in z.

    Args:
        model, params: as in `attack_step`.
        box: of E.
        key: for the pairs.
        samples: how many.
    """
    inject, rank, _ = _coordinates(model, params, len(box[0]))
    low, high = (jnp.asarray(side, dtype=jnp.float32) for side in box)
    draws = jax.random.uniform(key, (samples, 2, low.shape[0]), minval=low, maxval=high)

    def matrix(params: Params, pair: Any) -> Any:
        before, after = (model.fiber(params, env) for env in pair)
        return jax.jacfwd(
            lambda z: model.vector(model.transport(before, after, inject(z)))
        )(jnp.zeros(rank))

    found = np.asarray(
        jax.jit(jax.vmap(matrix, in_axes=(None, 0)))(params, draws), dtype=np.float64
    )
    return float(np.max(np.linalg.norm(found, 2, axis=(1, 2))))


def _chain(weights: Sequence[Matrix], slopes: Sequence[Vector]) -> Matrix:
    """W_L D_{L-1} … D_1 W_1."""
    chained = np.asarray(weights[0])
    for slope, weight in zip(slopes, weights[1:], strict=True):
        chained = weight @ (slope[:, None] * chained)
    return chained


def _best_layer(
    weights: Sequence[Matrix], slopes: Sequence[Vector], base: Matrix, layer: int
) -> Vector:
    """The slopes of one layer that raise u'(A + …)v most, (u, v) the top singular pair now."""
    left, _, right = np.linalg.svd(base + _chain(weights, slopes))
    before = _chain(weights[: layer + 1], slopes[:layer]) @ right[0]
    after = left[:, 0] @ _chain(
        [np.eye(len(slopes[layer])), *weights[layer + 1 :]],
        [np.ones(len(slopes[layer])), *slopes[layer + 1 :]],
    )
    return (before * after > 0).astype(float)


def _coordinates(
    model: Model, params: Params, entries: int
) -> tuple[Callable[[Any], Any], int, int]:
    """z -> a latent that holds it (`vector` picks z out, its transpose puts z back), and the sizes of z and u.

    Args:
        model, params: of a claim.
        entries: of e.
    """
    assert model.explicit is not None
    weights = jax.eval_shape(model.explicit, params)
    state = jax.ShapeDtypeStruct((3 + weights.readout.shape[0],), jnp.float32)
    env = jax.ShapeDtypeStruct((entries,), jnp.float32)
    shapes = jax.eval_shape(
        lambda env, state: model.encode(model.fiber(params, env), state), env, state
    )
    origin = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    z, back = jax.vjp(model.vector, origin)
    return (
        lambda z: jax.tree.map(jnp.add, origin, back(z)[0]),
        z.shape[0],
        weights.declared.controls,
    )


def _float64(
    objective: Callable[[Any], tuple[Any, Any]],
) -> Callable[[Vector], tuple[float, Vector]]:
    """A jitted float32 objective as scipy calls it."""

    def call(flat: Vector) -> tuple[float, Vector]:
        value, gradient = objective(jnp.asarray(flat, jnp.float32))
        return float(value), np.nan_to_num(np.asarray(gradient, dtype=np.float64))

    return call
