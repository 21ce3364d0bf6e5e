"""Transport between fibers: an isometry, the identity for e = e', and a cocycle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, jit, model_and_params

from sfkd_jax.models.sfkd._model import rotate_planes

RANDOM = np.random.default_rng(0)
ENVS = RANDOM.uniform(ENV_LOW, ENV_HIGH, (60, 3, 2)).astype(np.float32)
LATENTS = (5.0 * RANDOM.standard_normal((60, 8))).astype(np.float32)


def transported(name, scale=1.0):
    """T(e1 → e2), T(e2 → e3) T(e1 → e2), T(e1 → e3), there and back, and T(e1 → e1),
    all applied to z.
    """
    model, params = model_and_params(name, scale)

    def one(envs, z):
        a, b, c = (model.fiber(params, env) for env in envs)
        latent = model.encode(a, jnp.asarray([1.0, 2.0, 3.0, 10.0]))._replace(z=z)
        there = model.transport(a, b, latent)
        outcome = {
            "there": there,
            "on": model.transport(b, c, there),
            "direct": model.transport(a, c, latent),
            "back": model.transport(b, a, there),
            "home": model.transport(a, a, latent),
        }
        assert all(part.pose is latent.pose for part in outcome.values())
        return {way: part.z for way, part in outcome.items()}

    results = jit(jax.vmap(one))(ENVS, LATENTS)
    return {way: np.asarray(z, dtype=np.float64) for way, z in results.items()}


@pytest.mark.parametrize("scale", [1.0, 30.0])
@pytest.mark.parametrize("name", ["sfkd", "segment"])
def test_transport_is_an_isometry_with_inverse_and_a_cocycle(name, scale):
    results = transported(name, scale)
    close = {"rtol": 0, "atol": 2e-5}
    np.testing.assert_allclose(
        np.linalg.norm(results["there"], axis=1),
        np.linalg.norm(LATENTS, axis=1),
        rtol=1e-6,
    )
    np.testing.assert_allclose(results["home"], LATENTS, **close)
    np.testing.assert_allclose(results["back"], LATENTS, **close)
    np.testing.assert_allclose(results["on"], results["direct"], **close)
    assert np.abs(results["there"] - LATENTS).max() > 1e-3  # and it does turn something


def test_rotation_is_the_cayley_transform_of_a_skew_matrix():
    tangents = RANDOM.standard_normal(4)
    skew = np.kron(np.asarray([[0.0, -1.0], [1.0, 0.0]]), np.diag(tangents))
    expected = np.linalg.solve(np.eye(8) - skew, np.eye(8) + skew)
    columns = jit(jax.vmap(rotate_planes, in_axes=(None, 1), out_axes=1))(
        tangents.astype(np.float32), np.eye(8, dtype=np.float32)
    )
    np.testing.assert_allclose(columns, expected, atol=1e-6)
    np.testing.assert_allclose(expected @ expected.T, np.eye(8), atol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-3, 1e3, 1e15])
def test_rotation_keeps_length_however_large_its_tangents(size):
    tangents = (size * RANDOM.standard_normal((60, 4))).astype(np.float32)
    turned = jit(jax.vmap(rotate_planes))(tangents, LATENTS)
    lengths = np.linalg.norm(np.asarray(turned, np.float64), axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(LATENTS, axis=1), rtol=1e-6)
