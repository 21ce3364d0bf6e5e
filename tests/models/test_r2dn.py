"""R2DN: a hard contraction factor of the whole interconnection."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, jit, space

from sfkd_jax import certification, models
from sfkd_jax.models._r2dn import contracting

ALPHA, RANK = 0.97, 6
SETTINGS = {
    "rank": RANK,
    "hidden": (RANK,),
    "decoder_hidden": (8,),
    "encoder_hidden": 8,
    "alpha": ALPHA,
}
BOX = (ENV_LOW, ENV_HIGH)
MODEL = models.r2dn(space(), **SETTINGS)
INIT = jit(MODEL.init)(jax.random.key(0))
CONTRACTING = jit(jax.vmap(lambda A, B1, C1: contracting(A, B1, C1, ALPHA)))


def drawn(scale, seed=0):
    """Random parameters with the model's shapes, except for the decoder's bound."""
    random = np.random.default_rng(seed)
    params = jax.tree.map(
        lambda leaf: jnp.asarray(
            scale * random.standard_normal(leaf.shape), jnp.float32
        ),
        INIT,
    )
    return params | {
        "networks": params["networks"]
        | {"log_decoder_bound": INIT["networks"]["log_decoder_bound"]}
    }


def steepest():
    """Parameters for which the constraint is active along the first axis.

    The step is α z₁ near 0.

    There A = α/2, B₁ = C₁/α = 1/√2 and φ'(0) = 1: X = 0, Y = √2 − 1 make the Cayley
    block A = −B = 1/√2, and Y = 1 makes it A = 0, B = −1, so that V₂ V₁ = 2 B₂ A₁' B₁ =
    1. The block [1/2 1/√2; 1/√2 0] has the norm 1.
    """
    zeros, axis = (
        jax.tree.map(jnp.zeros_like, INIT["networks"]),
        jnp.diag(jnp.eye(RANK)[0]),
    )
    phi = zeros["phi"] | {
        "tall_0": (2.0**0.5 - 1.0) * jnp.eye(RANK),
        "tall_1": jnp.eye(RANK),
    }
    blocks = {"A": 0.5 * axis, "B1": 0.5**0.5 * axis, "C1": 0.5**0.5 * axis, "phi": phi}
    return INIT | {
        "networks": INIT["networks"]
        | {"feedback_gain": zeros["feedback_gain"]}
        | blocks
    }


def certified(params):
    return certification.certify(MODEL, params, BOX, attack_starts=0)


def proved_by_construction(params):
    """The factor that the model's own multipliers prove, with no search."""
    weights = jax.tree.map(
        lambda leaf: np.asarray(leaf, np.float64), jit(MODEL.structure.explicit)(params)
    )
    return certification.lipschitz_upper(
        weights.residual, weights.residual_multipliers, weights.operators.vertices[0]
    )[0]


def slope_at_rest(params):
    """∂z⁺/∂z of the running model at z = 0 and u at the middle of its range."""

    def step(z):
        fiber = MODEL.fiber(params, jnp.asarray([0.6, 0.0]))
        latent = MODEL.encode(fiber, jnp.zeros(4))._replace(z=z)
        return MODEL.vector(MODEL.step(fiber, latent, space().control_mean))

    slope = jit(jax.jacobian(step))(jnp.zeros(RANK))
    return np.linalg.norm(np.asarray(slope, np.float64), 2)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 0.03, 0.3, 1.0, 30.0, 1e6])
def test_the_constraint_holds_in_float64_and_its_bound_wastes_little(scale):
    random = np.random.default_rng(0)
    free = [
        (scale * random.standard_normal((200, *size))).astype(np.float32)
        for size in ((6, 6), (6, 5), (4, 6))
    ]
    A, B1, C1 = (np.asarray(part, np.float64) for part in CONTRACTING(*free))
    increments = np.block([[A / ALPHA, B1], [C1 / ALPHA, np.zeros((200, 4, 5))]])
    norms = np.linalg.norm(increments, 2, axis=(1, 2))
    assert np.all(norms <= 1.0)
    given = np.linalg.norm(
        np.block([[free[0], free[1]], [free[2], np.zeros((200, 4, 5))]]), 2, axis=(1, 2)
    )
    assert np.all(
        norms >= 0.96 * np.minimum(given, 1.0)
    )  # and what is short stays as it is


@pytest.mark.parametrize("scale", [0.1, 10.0])
def test_any_parameters_have_a_certificate_and_need_no_search_for_it(scale):
    params = drawn(scale)
    certificate = certified(params)
    assert certificate.alpha <= ALPHA
    assert proved_by_construction(params) <= ALPHA
    certification.verify(certificate, params, model=MODEL)


def test_where_the_factor_is_known_the_certificate_finds_it():
    params = steepest()
    np.testing.assert_allclose(slope_at_rest(params), ALPHA, rtol=1e-4)
    assert ALPHA * (1 - 1e-4) < certified(params).alpha <= ALPHA
    assert ALPHA * (1 - 1e-4) < proved_by_construction(params) <= ALPHA
