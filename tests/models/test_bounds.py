"""Hard bounds of SFKD: they hold for every weight, environment, control and latent,
also under attack.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    HARD,
    at,
    driven,
    explicit,
    jit,
    model_and_params,
    steepest_pattern,
)

from sfkd_jax.certification import lipschitz_upper
from sfkd_jax.models._networks import Sandwich, bounded, cayley, gram_bound
from sfkd_jax.rollout import fold

RHO, BETA = 0.895, 0.1
MARGIN = 1e-5
GRAM = jit(jax.vmap(gram_bound))
BOUNDED = jit(jax.vmap(lambda matrix: bounded(matrix, 0.9)))


def spectral(matrices):
    return np.linalg.norm(np.asarray(matrices, dtype=np.float64), 2, axis=(-2, -1))


def family(kind, count=1500, size=8):
    random = np.random.default_rng(len(kind))
    free = random.standard_normal((count, size, size))
    if kind == "random":
        return free
    if kind == "rank 1":
        return random.standard_normal((count, size, 1)) @ random.standard_normal(
            (count, 1, size)
        )
    if kind == "orthogonal":
        return np.linalg.qr(free)[0]
    if kind == "nearly rank 1":
        return free[:, :, :1] @ free[:, :1] + 1e-4 * free
    if kind == "permutation":
        return np.eye(size)[
            random.permuted(np.tile(np.arange(size), (count, 1)), axis=1)
        ]
    return np.broadcast_to(np.diag(np.geomspace(1.0, 1e-6, size)), (count, size, size))


@pytest.mark.parametrize(
    "kind",
    ["random", "rank 1", "nearly rank 1", "orthogonal", "permutation", "geometric"],
)
@pytest.mark.parametrize("scale", [1e-18, 1e-6, 1.0, 1e6, 1e15])
def test_the_gram_bound_is_never_below_the_norm_and_bounded_never_above_the_bound(
    kind, scale
):
    matrices = (scale * family(kind)).astype(np.float32)
    norms = spectral(matrices)
    upper = np.asarray(GRAM(matrices), dtype=np.float64) * (1 + MARGIN)
    assert np.all(upper >= norms)
    assert np.all(
        upper <= norms * 8 ** (1 / 2**7) * (1 + 3 * MARGIN)
    )  # r^(1/2^(k+1)), k = 6
    assert np.all(spectral(BOUNDED(matrices)) <= 0.9)


@pytest.mark.parametrize("scale", [0.0, 1e-38, 1e-30, 1e25, 3e37])
def test_beyond_the_range_of_float32_squares_the_bounds_stay_sound(scale):
    matrices = (scale * family("orthogonal", 50)).astype(np.float32)
    assert np.all(
        np.asarray(GRAM(matrices), dtype=np.float64) * (1 + MARGIN)
        >= spectral(matrices)
    )
    assert np.all(spectral(BOUNDED(matrices)) <= 0.9)


@pytest.mark.parametrize("scale", [0.0, 1e-20, 1e-6, 1.0, 3.0, 1e6])
def test_gradients_are_finite_where_singular_values_coincide(scale):
    corners = np.stack(
        [
            np.eye(6),
            np.outer(np.eye(6)[0], np.eye(6)[1]),
            np.ones((6, 6)),
            np.eye(6)[::-1],
        ]
    )
    for function in (gram_bound, lambda matrix: jnp.sum(bounded(matrix, 0.9) ** 2)):
        gradients = jit(jax.vmap(jax.grad(function)))(
            (scale * corners).astype(np.float32)
        )
        assert np.all(np.isfinite(gradients))


def environments(count=200):
    """Environments inside the box, outside it, and very far outside it."""
    random = np.random.default_rng(0)
    near = random.uniform([0.3, -8.0], [0.9, 8.0], (count, 2))
    return np.concatenate(
        [near, 100.0 * random.standard_normal((count, 2)), [[1e6, -1e6], [0.0, 0.0]]]
    ).astype(np.float32)


@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize("name", ["sfkd", "no_residual", "segment"])
def test_the_operator_is_bounded_for_every_environment_and_every_weight(name, scale):
    model, params = model_and_params(name, scale)
    operators = jit(jax.vmap(lambda env: model.fiber(fold(model, params), env).A))(
        environments()
    )
    assert np.all(spectral(operators) <= RHO)
    assert np.all(
        spectral(explicit(name, scale).operators.vertices) > 0.97 * RHO
    )  # and the bound is used, not wasted


def residual(name, scale):
    """r(z; u, e) of a model, from its public step: z⁺ − A z − B u in scaled units of u."""
    model, params = model_and_params(name, scale)

    def value(z, control, env):
        fiber = model.fiber(params, env)
        latent = model.encode(fiber, jnp.asarray([0.0, 0.0, 0.0, 10.0]))._replace(z=z)
        return model.step(fiber, latent, control).z - fiber.A @ z

    return value


ATTACK_STARTS, ATTACK_STEPS = 8, 40


def attack(name, scale):
    """Gradient ascent over z, u, e and a direction v on |∂r/∂z v|: the largest value."""
    value = residual(name, scale)

    def gain(point):
        z, control, env, direction = point
        unit = direction / jnp.linalg.norm(direction)
        return jnp.sqrt(
            jnp.sum(jax.jvp(lambda z: value(z, control, env), (z,), (unit,))[1] ** 2)
            + 1e-20
        )

    def climb(key):
        keys = jax.random.split(key, 4)
        start = [
            jax.random.normal(key, (size,))
            for key, size in zip(keys, (8, 2, 2, 8), strict=True)
        ]

        def step(point, _):
            now, slope = jax.value_and_grad(gain)(point)
            moved = [
                x + 0.1 * g / (jnp.linalg.norm(g) + 1e-6)
                for x, g in zip(point, slope, strict=True)
            ]
            return moved, now

        return jnp.max(jax.lax.scan(step, start, length=ATTACK_STEPS)[1])

    return float(
        jnp.max(
            jit(jax.vmap(climb))(jax.random.split(jax.random.key(3), ATTACK_STARTS))
        )
    )


@pytest.mark.parametrize("scale", [1.0, 30.0])
def test_the_residual_keeps_its_lipschitz_bound_under_attack(scale):
    assert attack("sfkd", scale) <= BETA


@pytest.mark.parametrize("scale", [1.0, 30.0])
@pytest.mark.parametrize("name", ["sfkd", "segment"])
def test_no_pattern_of_slopes_breaks_the_residual_and_its_multipliers_prove_it(
    name, scale
):
    weights = explicit(name, scale)
    upper = lipschitz_upper(weights.residual, weights.residual_multipliers)
    lower = steepest_pattern(weights.residual)
    assert lower <= upper <= BETA
    if scale == 1.0:
        assert lower > 0.5 * BETA  # the budget can be used


@pytest.mark.parametrize("scale", [0.1, 5.0])
@pytest.mark.parametrize(("out", "inputs"), [(4, 9), (9, 4), (1, 3)])
def test_the_rows_of_a_cayley_block_are_orthonormal(out, inputs, scale):
    random = np.random.default_rng(0)
    square = scale / np.sqrt(out) * random.standard_normal((20, out, out))
    tall = scale / np.sqrt(inputs) * random.standard_normal((20, inputs, out))
    A, B = (
        np.asarray(part, np.float64)
        for part in jit(jax.vmap(cayley))(
            square.astype(np.float32), tall.astype(np.float32)
        )
    )
    gram = A @ A.swapaxes(1, 2) + B @ B.swapaxes(1, 2)
    np.testing.assert_allclose(
        gram, np.broadcast_to(np.eye(out), gram.shape), atol=MARGIN
    )


def test_the_sandwich_bound_survives_ill_conditioned_weights():
    """One singular value of Y is 2000, the others 1."""
    random = np.random.default_rng(0)
    network = Sandwich(8, (8,), 8)
    weights = jit(lambda params: network.apply({"params": params}, BETA))
    worst = 0.0
    for _ in range(40):
        turns = [np.linalg.qr(random.standard_normal((8, 8)))[0] for _ in range(2)]
        tall = turns[0] @ np.diag([2000.0] + 7 * [1.0]) @ turns[1]
        params = {
            "square_0": np.zeros((8, 8)),
            "square_1": np.zeros((8, 8)),
            "tall_0": tall,
            "tall_1": np.eye(8),
        }
        params = {name: value.astype(np.float32) for name, value in params.items()} | {
            "psi_0": np.zeros(8, np.float32)
        }
        made = [
            np.asarray(matrix, dtype=np.float64) for matrix in weights(params).matrices
        ]
        worst = max(worst, steepest_pattern(made, starts=2))
    assert worst <= BETA


@pytest.mark.parametrize("name", HARD)
@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_two_latents_under_the_same_inputs_approach_at_least_as_fast_as_alpha(
    name, scale
):
    """Switches of the environment at every step, transport included; α = ρ + β."""
    model, params = model_and_params(name, scale)
    data = at(driven(), 0)

    @jit
    def distances(params):
        fibers = jax.vmap(model.fiber, in_axes=(None, 0))(params, data.envs)
        later = jax.tree.map(lambda leaf: jnp.roll(leaf, -1, axis=0), fibers)
        start = model.encode(at(fibers, 0), data.states[0])
        pair = [
            start._replace(z=jax.random.normal(key, (8,)))
            for key in jax.random.split(jax.random.key(8))
        ]

        def step(pair, inputs):
            here, there, control = inputs
            pair = [
                model.transport(here, there, model.step(here, latent, control))
                for latent in pair
            ]
            return pair, jnp.linalg.norm(pair[0].z - pair[1].z)

        first = jnp.linalg.norm(pair[0].z - pair[1].z)
        return first, jax.lax.scan(step, pair, (fibers, later, data.controls))[1]

    first, rest = distances(params)
    scale_of_z = 1e-6 * (
        1 + scale
    )  # float32 rounding of latents that grow with the input gain
    allowed = float(first) * (RHO + BETA) ** np.arange(1, len(rest) + 1)
    assert np.all(np.asarray(rest) <= allowed + scale_of_z)
    assert float(rest[0]) > 0.05 * float(first)
