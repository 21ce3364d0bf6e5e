"""Attacks: searches for the largest slope of a map, a lower bound on any proof."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from sfkd_jax.certification._claims import FLOAT32, Box, Claims, attack_limits, decoders
from sfkd_jax.certification._core import Matrix, Vector
from sfkd_jax.certification._weights import CertificationRefused, Exported, one_thread
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.types import POSE, Key, Model, Params

PAIRS = 256
"""Random pairs (e, e') between which the transport is differentiated."""


class CertificateContradicted(CertificationRefused):
    """An attack exceeds a proved bound, which is a fault of the code, never of data.

    Either this package is wrong or what the model declares about itself.
    """


@one_thread()
def attack_claims(
    model: Model,
    params: Params,
    weights: Exported,
    claims: Claims,
    box: Box,
    starts: int,
) -> dict[str, float]:
    """Run all attacks and return the lower bounds that they reach, by name."""
    # Limits before the search: a proof that states none is an error at once.
    limits = attack_limits(claims, weights)
    reached = {}
    networks = {"residual": weights.residual, **decoders(weights)}
    for name, network in networks.items():
        if network:
            reached[f"{name}_slopes"] = attack_slopes(network)
    reached["step_slopes"] = max(
        # Every vertex: by convexity the largest slope of the hull is at one.
        attack_slopes(weights.residual, vertex, starts=8)
        for vertex in weights.operators.vertices
    )
    if starts:
        # Folded once: each of many thousand steps would bound the weights again.
        reached |= attack_model(model, fold(model, params, on_host), box, starts=starts)
    for name, value in reached.items():
        # `not <=` instead of `>`: a NaN contradicts the bound as well.
        if not value <= limits[name] * (1 + FLOAT32):
            raise CertificateContradicted(
                f"INTERNAL ERROR: the attack on the {name} reaches {value:.6f}, "
                f"above the bound {limits[name]:.6f}"
            )
    return reached


def attack_slopes(
    weights: Sequence[Matrix], linear: Matrix | None = None, *, starts: int = 24
) -> float:
    """Maximise ||A + W_L D_{L-1} W_{L-1} … D_1 W_1||_2 over slopes D_k in [0, 1].

    The norm is convex in each D_k, so the maximum is at slopes 0 or 1. With the top
    singular pair fixed, the slopes of one layer after another are set by the sign of
    their effect, until the norm stops growing.
    """
    # Without a network the operator alone is the map, and there are no slopes.
    if not weights:
        return float(np.linalg.norm(np.asarray(linear), 2))
    random = np.random.default_rng(0)
    best = 0.0
    base = 0.0 if linear is None else np.asarray(linear)
    for start in range(starts):
        # All slopes 1 is the linearisation at the origin, often close to the worst.
        share = 1.0 if start == 0 else random.uniform(0.2, 1.0)
        widths = [len(weight) for weight in weights[:-1]]
        slopes = [(random.uniform(size=width) < share) * 1.0 for width in widths]
        value = 0.0
        while True:
            for k in range(len(slopes)):
                slopes[k] = _best_layer(weights, slopes, base, k)
            after = float(np.linalg.norm(base + _chain(weights, slopes), 2))
            # Coordinate ascent never decreases, so this ends; 1e-12 is rounding.
            if after <= value * (1 + 1e-12):
                break
            value = after
        best = max(best, value)
    return best


def _chain(weights: Sequence[Matrix], slopes: Sequence[Vector]) -> Matrix:
    """Return W_L D_{L-1} … D_1 W_1."""
    chained = np.asarray(weights[0])
    for slope, weight in zip(slopes, weights[1:], strict=True):
        chained = weight @ (slope[:, None] * chained)
    return chained


def _best_layer(
    weights: Sequence[Matrix], slopes: Sequence[Vector], base: Any, layer: int
) -> Vector:
    """Slopes of one layer that maximise u'(A + …)v for the current top pair (u, v)."""
    left, _, right = np.linalg.svd(base + _chain(weights, slopes))
    # With (u, v) fixed the gain is a sum over units: each chooses its own sign.
    before = _chain(weights[: layer + 1], slopes[:layer]) @ right[0]
    after = left[:, 0] @ _chain(weights[layer + 1 :], slopes[layer + 1 :])
    return (before * after > 0).astype(float)


def attack_model(
    model: Model, params: Params, box: Box, *, starts: int
) -> dict[str, float]:
    """Maximise the slopes in z of the float32 model by ascent, and return their norms.

    "step" is ||∂(T(e → e') F(z, u, e))/∂z||_2 with F = `model.step` and T =
    `model.transport`; "transport" that of T alone, over random pairs (e, e'). Outputs
    are the pose increment of a step and, if the pose is part of the latent, of
    decoding: "position" [m], "yaw" [rad] and "decoder" (both); and the body state,
    "body". e and e' stay in the box; z and u are free, as in the certificate. Each
    ascent has `starts` starting points.
    """
    inject, *sizes = _coordinates(model, params, len(box[0]))
    # A key each: the number of starts of one attack leaves the others as they are.
    step_key, transport_key, output_key = jax.random.split(jax.random.key(0), 3)

    def step(params: Params, z: Any, control: Any, env: Any, later: Any) -> Any:
        fiber = model.fiber(params, env)
        fiber_next = model.fiber(params, later)
        after = model.step(fiber, inject(z), control)
        return model.vector(model.transport(fiber, fiber_next, after))

    def outputs(params: Params, z: Any, control: Any, env: Any, _: Any) -> Any:
        fiber = model.fiber(params, env)
        latent = inject(z)  # at the origin, so that an increment is a pose
        # The step's pose and the decoding of z: two places where a pose may come from.
        after = model.decode(fiber, model.step(fiber, latent, control))
        return jnp.concatenate([after[POSE], model.decode(fiber, latent)])

    def transport(params: Params, pair: Any) -> Any:
        before, after = (model.fiber(params, env) for env in pair)
        return jax.jacfwd(
            lambda z: model.vector(model.transport(before, after, inject(z)))
            # T is linear in z, hence its Jacobian is the same everywhere, also at 0.
        )(jnp.zeros(sizes[0]))

    steepest = partial(_steepest, params=params, sizes=sizes, box=box, starts=starts)
    low, high = (jnp.asarray(side, dtype=jnp.float32) for side in box)
    pairs = jax.random.uniform(
        transport_key, (PAIRS, 2, len(low)), minval=low, maxval=high
    )
    carried = jax.jit(jax.vmap(transport, in_axes=(None, 0)))(params, pairs)
    ends = steepest(outputs, key=output_key, iterations=60)
    if model.along_path:  # decoded from z: e_y, e_ψ, then the vehicle's own state
        poses = ends
        parts = {"position": slice(6, 7), "yaw": slice(7, 8)}
    else:
        # Rows 0-2: the pose after a step; 3-5: that of decoding, constant unless in z.
        poses = [part for jacobian in ends for part in (jacobian[:3], jacobian[3:6])]
        parts = {"position": slice(0, 2), "yaw": slice(2, 3), "decoder": slice(0, 3)}
    reached = {name: _largest_norm(poses, rows) for name, rows in parts.items()}
    body = slice(8 if model.along_path else 6, None)
    # Exact norms at the end, not the values of the ascent along one direction.
    return reached | {
        "body": _largest_norm(ends, body),
        "transport": _largest_norm(np.asarray(carried, dtype=np.float64)),
        "step": _largest_norm(steepest(step, key=step_key, iterations=120)),
    }


def _largest_norm(jacobians: Any, rows: slice = slice(None)) -> float:
    """Largest 2-norm of these rows."""
    return max(float(np.linalg.norm(jacobian[rows], 2)) for jacobian in jacobians)


def _steepest(
    function: Callable[..., Any],
    *,
    params: Params,
    sizes: Sequence[int],
    box: Box,
    key: Key,
    starts: int,
    iterations: int,
) -> list[Matrix]:
    """∂/∂z of `function(params, z, u, e, e')` at the end of each ascent.

    The ascent maximises |J v|²/|v|² over z, u, e, e' and the direction v.
    """
    rank, controls = sizes
    low, high = (np.asarray(side, dtype=np.float64) for side in box)
    inputs = rank + controls + 2 * len(low)
    envs = slice(rank + controls, inputs)

    def at(params: Params, z: Any, rest: Any) -> Any:
        return function(params, z, *jnp.split(rest, [controls, controls + len(low)]))

    # The ascent is over the direction as well: no singular vectors, a smooth objective.
    def loss(params: Params, point: Any) -> Any:
        z = point[:rank]
        rest = point[rank:inputs]
        direction = point[inputs:]
        _, gain = jax.jvp(lambda z: at(params, z, rest), (z,), (direction,))
        return 0.5 * (
            # A logarithm: far from the maximum slopes differ by orders of magnitude.
            jnp.log(jnp.sum(direction**2)) - jnp.log(jnp.sum(gain**2) + 1e-30)
        )

    with_gradient = jax.jit(jax.value_and_grad(loss, argnums=1))
    jacobian = jax.jit(
        lambda params, point: jax.jacfwd(at, argnums=1)(
            params, point[:rank], point[rank:inputs]
        )
    )

    def objective(flat: Vector) -> tuple[float, Vector]:
        value, gradient = with_gradient(params, jnp.asarray(flat, jnp.float32))
        # scipy works in float64; a NaN would end the search, a zero gradient this start
        return float(value), np.nan_to_num(np.asarray(gradient, dtype=np.float64))

    limits = [(None, None)] * (inputs + rank)
    # Only e is bounded by a box: z and u are free, as in the certificate.
    limits[envs] = 2 * list(zip(low, high, strict=True))
    search = {"method": "L-BFGS-B", "jac": True, "bounds": limits}
    jacobians = []
    for number, start_key in enumerate(jax.random.split(key, starts)):
        draw = jax.random.normal(start_key, (inputs + rank,))
        start = np.asarray(draw, dtype=np.float64)
        # slopes are steep at small latents and saturated at large ones
        start[: rank + controls] *= 10.0 ** (number % 4 - 2)
        # arctan maps a normal number into (0, 1), so that starts are inside the box.
        share = np.arctan(start[envs]) / np.pi + 0.5
        start[envs] = np.tile(low, 2) + share * np.tile(high - low, 2)
        end = scipy.optimize.minimize(
            objective, start, options={"maxiter": iterations}, **search
        ).x
        steepest = jacobian(params, jnp.asarray(end, jnp.float32))
        jacobians.append(np.asarray(steepest, dtype=np.float64))
    return jacobians


def _coordinates(
    model: Model, params: Params, entries: int
) -> tuple[Callable[[Any], Any], int, int]:
    """Return the map from z to a latent, the size of z and that of u.

    `model.vector` reads z from a latent; its transpose writes z into one.
    """
    assert model.structure.explicit is not None
    # Shapes only: no weights are computed to learn sizes.
    weights = jax.eval_shape(model.structure.explicit, params)
    state = jnp.zeros(3 + weights.readout.shape[0])
    env = jnp.zeros(entries)
    shapes = jax.eval_shape(lambda: model.encode(model.fiber(params, env), state))
    origin = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    # `vector` is linear, so that its transpose writes z and leaves the pose at 0.
    z, back = jax.vjp(model.vector, origin)
    return (
        lambda z: jax.tree.map(jnp.add, origin, back(z)[0]),
        z.shape[0],
        weights.declared.controls,
    )
