"""Attacks: searches for the largest slope of a map.

What an attack reaches is a lower bound of every Lipschitz constant that can be proved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from sfkd_jax.certificate import Box, Claims
from sfkd_jax.certification._claims import FLOAT32, attack_limits, decoders
from sfkd_jax.certification._core import Matrix, Vector
from sfkd_jax.certification._weights import CertificationRefused, Exported, one_thread
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.types import BODY, POSE, Frame, Key, Model, Params

PAIRS = 256
"""Number of random pairs (e, e') between which the transport is differentiated."""


class CertificateContradicted(CertificationRefused):
    """An attack exceeds a proved bound.

    This is a fault of code and never of data: either this package is wrong, or what the
    model declares about itself.
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
    """Run all attacks and return the lower bounds that they reach, by name.

    Args:
        model: that is certified.
        params: its weights.
        weights: the explicit weights.
        claims: the proved bounds.
        box: of the environments.
        starts: starting points of each ascent on the float32 model; 0 for no ascent.

    Raises:
        CertificateContradicted: an attack exceeds a proved bound.
    """
    # The limits come before the search, so that missing ones are an error at once.
    limits = attack_limits(claims, weights)
    reached = {}
    networks = {"residual": weights.residual, **decoders(weights)}
    for name, network in networks.items():
        if network:
            reached[f"{name}_slopes"] = attack_slopes(network)
    # By convexity the largest slope of the hull is at one of its vertices.
    reached["step_slopes"] = max(
        attack_slopes(weights.residual, vertex, starts=8)
        for vertex in weights.operators.vertices
    )
    if starts:
        # Folded once. Otherwise each of many thousand steps would bound the weights
        # again.
        folded = fold(model, params, on_host)
        reached.update(attack_model(model, folded, box, starts=starts))
    for name, value in reached.items():
        # `not <=` instead of `>`, so that a NaN contradicts the bound as well.
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

    The norm is convex in each D_k, so that the maximum is at slopes 0 or 1. The search
    fixes the top singular pair and sets the slopes of one layer by the sign of their
    effect. It goes on from layer to layer until the norm stops growing.

    Args:
        weights: W_1 … W_L; () for no network.
        linear: A; None for 0.
        starts: number of starting points.
    """
    # Without a network the map is the operator alone, and there are no slopes.
    if not weights:
        return float(np.linalg.norm(np.asarray(linear), 2))
    random = np.random.default_rng(0)
    best = 0.0
    base = 0.0 if linear is None else np.asarray(linear)
    for start in range(starts):
        # First all slopes are 1. This linearisation at the origin is often nearly the
        # worst case.
        share = 1.0 if start == 0 else random.uniform(0.2, 1.0)
        widths = [len(weight) for weight in weights[:-1]]
        slopes = [
            (random.uniform(size=width) < share).astype(float) for width in widths
        ]
        value = 0.0
        while True:
            for k in range(len(slopes)):
                slopes[k] = _best_layer(weights, slopes, base, k)
            after = float(np.linalg.norm(base + _chain(weights, slopes), 2))
            # Coordinate ascent never decreases the norm, so that this ends. The factor
            # 1 + 1e-12 covers rounding.
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
    """Return slopes of one layer that maximise u'(A + …)v for the top pair (u, v)."""
    left, _, right = np.linalg.svd(base + _chain(weights, slopes))
    # With (u, v) fixed the gain is a sum over the units of the layer. The slope is 1
    # where the summand is positive.
    before = _chain(weights[: layer + 1], slopes[:layer]) @ right[0]
    after = left[:, 0] @ _chain(weights[layer + 1 :], slopes[layer + 1 :])
    return (before * after > 0).astype(float)


def attack_model(
    model: Model, params: Params, box: Box, *, starts: int
) -> dict[str, float]:
    """Maximise the slopes in z of the float32 model by ascent, and return their norms.

    "step" is the largest ||∂(T(e → e') F(z, u, e))/∂z||_2 with F = `model.step` and
    T = `model.transport`. "transport" is the largest slope of T alone, over random
    pairs (e, e'). The others are slopes of the outputs of the frame, and, if it
    has a pose, "decoder" of the whole pose increment.

    e and e' stay in the box. z and u are free, as in the certificate.

    Args:
        model: that is attacked.
        params: its weights, folded or not.
        box: of the environments.
        starts: number of starting points of each ascent.
    """
    inject, *sizes = _coordinates(model, params, len(box[0]))
    # A key for every attack: more starts of one attack leave the others as they are.
    step_key, transport_key, output_key = jax.random.split(jax.random.key(0), 3)

    def step(params: Params, z: Any, control: Any, env: Any, later: Any) -> Any:
        fiber = model.fiber(params, env)
        fiber_next = model.fiber(params, later)
        after = model.step(fiber, inject(z), control)
        return model.vector(model.transport(fiber, fiber_next, after))

    def outputs(params: Params, z: Any, control: Any, env: Any, _: Any) -> Any:
        fiber = model.fiber(params, env)
        # The pose of this latent is the origin, so that an increment of it is a pose.
        latent = inject(z)
        # A pose may come from the step, or from decoding z.
        after = model.decode(fiber, model.step(fiber, latent, control))
        return jnp.concatenate([after[POSE], model.decode(fiber, latent)])

    def transport_jacobian(params: Params, pair: Any) -> Any:
        before, after = (model.fiber(params, env) for env in pair)

        def transported(z: Any) -> Any:
            return model.vector(model.transport(before, after, inject(z)))

        # T is linear in z, so that its Jacobian at 0 is that at every z.
        return jax.jacfwd(transported)(jnp.zeros(sizes[0]))

    steepest = partial(_steepest, params=params, sizes=sizes, box=box, starts=starts)
    low, high = (jnp.asarray(side, dtype=jnp.float32) for side in box)
    pairs = jax.random.uniform(
        transport_key, (PAIRS, 2, len(low)), minval=low, maxval=high
    )
    transports = jax.jit(jax.vmap(transport_jacobian, in_axes=(None, 0)))(params, pairs)
    jacobians = steepest(outputs, key=output_key, iterations=60)
    reached = _norms_of_outputs(jacobians, model.frame)
    reached["transport"] = _largest_norm(np.asarray(transports, dtype=np.float64))
    reached["step"] = _largest_norm(steepest(step, key=step_key, iterations=120))
    return reached


def _norms_of_outputs(jacobians: list[Matrix], frame: Frame) -> dict[str, float]:
    """Return the largest norms of the slopes of outputs, by name.

    These are exact norms. An ascent itself knows a slope along one direction alone.

    Args:
        jacobians: at the end of each ascent. Rows 0 to 2 are the pose after a step,
            rows 3 to 5 that of decoding, which is constant unless the pose is part of
            z. The rows after them decode the body.
        frame: of the model.
    """
    states = []
    for jacobian in jacobians:
        # Decoded, and with the pose after a step in place of the decoded one.
        decoded = jacobian[3:]
        states += [decoded, np.concatenate([jacobian[:3], decoded[BODY]])]
    norms = {name: _largest_norm(states, frame.entries(name)) for name in frame.outputs}
    if frame.has_pose:
        norms["decoder"] = _largest_norm(states, POSE)
    return norms


def _largest_norm(jacobians: Any, rows: Any = slice(None)) -> float:
    """Return the largest 2-norm of these rows of the matrices."""
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
    """Return ∂/∂z of `function(params, z, u, e, e')` at the end of each ascent.

    An ascent maximises |J v|²/|v|² over z, u, e, e' and the direction v.

    Args:
        function: of params, z, u, e and e'.
        params: of the model.
        sizes: of z and of u.
        box: of e and e'.
        key: of the starting points; consumed.
        starts: number of ascents.
        iterations: of an ascent.
    """
    rank, controls = sizes
    low, high = (np.asarray(side, dtype=np.float64) for side in box)
    # A point of the ascent is (z, u, e, e', v).
    inputs = rank + controls + 2 * len(low)
    value_and_gradient, jacobian_at = _differentiated(
        function, rank, controls, len(low)
    )

    def objective(flat: Vector) -> tuple[float, Vector]:
        value, gradient = value_and_gradient(params, jnp.asarray(flat, jnp.float32))
        # scipy works in float64. A NaN in the gradient would end the whole search; a
        # zero ends this ascent.
        return float(value), np.nan_to_num(np.asarray(gradient, dtype=np.float64))

    limits = [(None, None)] * (inputs + rank)
    # Only e and e' have a box. z and u are free, as in the certificate.
    limits[rank + controls : inputs] = 2 * list(zip(low, high, strict=True))
    jacobians = []
    for number, start_key in enumerate(jax.random.split(key, starts)):
        draw = jax.random.normal(start_key, (inputs + rank,))
        start = np.asarray(draw, dtype=np.float64)
        end = scipy.optimize.minimize(
            objective,
            _scaled_start(start, number, rank + controls, low, high),
            method="L-BFGS-B",
            jac=True,
            bounds=limits,
            options={"maxiter": iterations},
        ).x
        jacobian = jacobian_at(params, jnp.asarray(end, jnp.float32))
        jacobians.append(np.asarray(jacobian, dtype=np.float64))
    return jacobians


def _differentiated(
    function: Callable[..., Any], rank: int, controls: int, entries: int
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return the objective of `_steepest` with its gradient, and the Jacobian.

    Both are functions of the parameters and a point, compiled.

    Args:
        function: of params, z, u, e and e'.
        rank: size of z.
        controls: size of u.
        entries: size of e.
    """
    inputs = rank + controls + 2 * entries

    def value_at(params: Params, z: Any, rest: Any) -> Any:
        return function(params, z, *jnp.split(rest, [controls, controls + entries]))

    # The direction is a variable too. Singular vectors are therefore not needed, and
    # the objective is smooth.
    def objective(params: Params, point: Any) -> Any:
        z = point[:rank]
        rest = point[rank:inputs]
        direction = point[inputs:]
        _, gain = jax.jvp(lambda z: value_at(params, z, rest), (z,), (direction,))
        # The logarithm is maximised, because far from the maximum slopes differ by
        # orders of magnitude.
        return 0.5 * (
            jnp.log(jnp.sum(direction**2)) - jnp.log(jnp.sum(gain**2) + 1e-30)
        )

    def jacobian_at(params: Params, point: Any) -> Any:
        jacobian = jax.jacfwd(value_at, argnums=1)
        return jacobian(params, point[:rank], point[rank:inputs])

    return jax.jit(jax.value_and_grad(objective, argnums=1)), jax.jit(jacobian_at)


def _scaled_start(
    start: Vector, number: int, free: int, low: Vector, high: Vector
) -> Vector:
    """Return a starting point of `_steepest` from normal random numbers.

    Args:
        start: the random numbers.
        number: of the start.
        free: number of entries of z and u together.
        low: lower corner of the environments.
        high: upper corner of the environments.
    """
    scaled = start.copy()
    # Slopes are steep at small z and saturated at large ones: both are tried.
    scaled[:free] *= 10.0 ** (number % 4 - 2)
    # arctan maps a normal number into (0, 1), so that e and e' are inside of the box.
    envs = slice(free, free + 2 * len(low))
    share = np.arctan(scaled[envs]) / np.pi + 0.5
    scaled[envs] = np.tile(low, 2) + share * np.tile(high - low, 2)
    return scaled


def _coordinates(
    model: Model, params: Params, entries: int
) -> tuple[Callable[[Any], Any], int, int]:
    """Return the map from z to a latent, the size of z and that of u.

    Args:
        model: whose latent it is.
        params: of the model.
        entries: number of entries of e.
    """
    assert model.structure.explicit is not None
    # `eval_shape` computes no weights; only their sizes are needed.
    weights = jax.eval_shape(model.structure.explicit, params)
    state = jnp.zeros(3 + weights.readout.shape[0])
    env = jnp.zeros(entries)
    shapes = jax.eval_shape(lambda: model.encode(model.fiber(params, env), state))
    origin = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    # `vector` reads z from a latent and is linear. Its transpose therefore writes z
    # into a latent, and leaves the pose at 0.
    z, transpose = jax.vjp(model.vector, origin)

    def inject(z: Any) -> Any:
        return jax.tree.map(jnp.add, origin, transpose(z)[0])

    return inject, z.shape[0], weights.declared.controls
