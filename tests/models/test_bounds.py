"""Hard bounds of SFKD: they hold for every weight, environment, control and latent,
also under attack; the joint budget; transport.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, certified, explicit, jit, model_and_params

from sfkd_jax.certification import lipschitz_upper
from sfkd_jax.certification._attack import attack_slopes
from sfkd_jax.models._networks import Sandwich, Weights, bounded, gram_bound
from sfkd_jax.models.sfkd._latent_model import rotate_planes
from sfkd_jax.models.sfkd._residual import share_budget
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


@pytest.mark.parametrize(
    "function", [gram_bound, lambda matrix: jnp.sum(bounded(matrix, 0.9) ** 2)]
)
def test_gradients_are_finite_where_singular_values_coincide(function):
    eye = np.eye(6)
    corners = np.stack([eye, np.outer(eye[0], eye[1]), np.ones((6, 6)), eye[::-1]])
    gradient = jit(jax.vmap(jax.grad(function)))
    for scale in (0.0, 1e-20, 1e-6, 1.0, 3.0, 1e6):
        assert np.all(np.isfinite(gradient((scale * corners).astype(np.float32))))


def environments(count=200):
    """Environments inside the box, outside it, and very far outside it."""
    random = np.random.default_rng(0)
    near = random.uniform([0.3, -8.0], [0.9, 8.0], (count, 2))
    return np.concatenate(
        [near, 100.0 * random.standard_normal((count, 2)), [[1e6, -1e6], [0.0, 0.0]]]
    ).astype(np.float32)


@pytest.mark.parametrize("name", ["sfkd", "no_residual"])
def test_the_operator_is_bounded_for_every_environment_and_every_weight(name):
    model, _ = model_and_params(name)

    @jit
    def operators(params):
        folded = fold(model, params)
        return jax.vmap(lambda env: model.fiber(folded, env).A)(environments())

    for scale in (1.0, 100.0):
        params = model_and_params(name, scale)[1]
        assert np.all(spectral(operators(params)) <= RHO)
        # And the bound is used, not wasted.
        vertices = explicit(name, scale).operators.vertices
        assert np.all(spectral(vertices) > 0.97 * RHO)


@pytest.mark.parametrize("scale", [1.0, 30.0])
def test_no_pattern_of_slopes_breaks_the_residual_and_its_multipliers_prove_it(scale):
    weights = explicit("sfkd", scale)
    upper = lipschitz_upper(weights.residual, weights.residual_multipliers)[0]
    lower = attack_slopes(weights.residual)
    assert lower <= upper <= BETA
    if scale == 1.0:
        assert lower > 0.5 * BETA  # the budget can be used


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
        worst = max(worst, attack_slopes(made, starts=2))
    assert worst <= BETA


ALPHA, RANK = 0.9, 6
IDENTITY = Weights((jnp.eye(RANK), jnp.eye(RANK)), (jnp.ones(RANK),))


def shared(operator_scale, coupling_scale, seed=0):
    """A_j, G and H in float64, G and H read off a residual whose network is the
    identity.
    """
    random = np.random.default_rng(seed)
    operators = operator_scale * random.standard_normal((3, RANK, RANK))
    couplings = coupling_scale * random.standard_normal((2, RANK, RANK))
    arrays = [jnp.asarray(part, dtype=jnp.float32) for part in (operators, couplings)]
    vertices, residual = share_budget(*arrays, IDENTITY, ALPHA)
    first, last = residual.matrices
    return tuple(np.asarray(part, dtype=np.float64) for part in (vertices, last, first))


@pytest.mark.parametrize("operator_scale", [1e-3, 0.3, 3.0, 1e4])
@pytest.mark.parametrize("coupling_scale", [1e-3, 0.1, 1.0, 1e4])
def test_the_block_matrix_of_every_vertex_has_norm_at_most_one(
    operator_scale, coupling_scale
):
    vertices, out, into = shared(operator_scale, coupling_scale)
    for vertex in vertices:
        block = np.block(
            [[vertex / ALPHA, out], [into / ALPHA, np.zeros((RANK, RANK))]]
        )
        assert np.linalg.norm(block, 2) <= 1.0 + 1e-6


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_the_certificate_proves_the_budget_from_the_networks_own_multipliers(scale):
    proved = certified("joint", scale)
    assert proved.alpha <= 0.995 * (1 + 2e-6)
    assert proved.alpha_separate > proved.alpha


RANDOM = np.random.default_rng(0)
ENVS = RANDOM.uniform(ENV_LOW, ENV_HIGH, (60, 3, 2)).astype(np.float32)
LATENTS = (5.0 * RANDOM.standard_normal((60, 8))).astype(np.float32)


def test_transport_is_an_isometry_with_inverse_and_a_cocycle():
    """T(e1 → e2), T(e2 → e3) T(e1 → e2), T(e1 → e3), there and back, and T(e1 → e1),
    all applied to z.
    """
    model, _ = model_and_params("sfkd")

    def one(params, envs, z):
        a, b, c = (model.fiber(params, env) for env in envs)
        latent = model.encode(a, jnp.asarray([1.0, 2.0, 3.0, 10.0]))._replace(z=z)
        there = model.transport(a, b, latent)
        moved = (
            there,
            model.transport(b, c, there),
            model.transport(a, c, latent),
            model.transport(b, a, there),
            model.transport(a, a, latent),
        )
        assert all(part.pose is latent.pose for part in moved)
        return tuple(part.z for part in moved)

    run = jit(jax.vmap(one, in_axes=(None, 0, 0)))
    close = {"rtol": 0, "atol": 2e-5}
    for scale in (1.0, 30.0):
        moved = run(model_and_params("sfkd", scale)[1], ENVS, LATENTS)
        there, on, direct, back, home = (np.asarray(z, np.float64) for z in moved)
        lengths = [np.linalg.norm(z, axis=1) for z in (there, LATENTS)]
        np.testing.assert_allclose(*lengths, rtol=1e-6)
        np.testing.assert_allclose(home, LATENTS, **close)
        np.testing.assert_allclose(back, LATENTS, **close)
        np.testing.assert_allclose(on, direct, **close)
        assert np.abs(there - LATENTS).max() > 1e-3  # and it does turn something


def test_rotation_keeps_length_however_large_its_tangents():
    turn, directions = jit(jax.vmap(rotate_planes)), RANDOM.standard_normal((60, 4))
    for size in (0.0, 1e-3, 1e3, 1e15):
        turned = turn((size * directions).astype(np.float32), LATENTS)
        lengths = np.linalg.norm(np.asarray(turned, np.float64), axis=1)
        expected = np.linalg.norm(LATENTS, axis=1)
        np.testing.assert_allclose(lengths, expected, rtol=1e-6)
