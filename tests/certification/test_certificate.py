"""Certificates of real weights: what is proved, and what is measured."""

import json
from dataclasses import asdict

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, certified, jit, model_and_params

from sfkd_jax.certificate import Proof
from sfkd_jax.certificate._reading import read_as
from sfkd_jax.certification import CertificationRefused, prove, verify_proof
from sfkd_jax.certification._attack import attack_slopes
from sfkd_jax.geometry import between
from sfkd_jax.types import POSE

RHO, BETA = 0.895, 0.1
BOX = (ENV_LOW, ENV_HIGH)


def with_networks(params, **changes):
    return params | {"networks": params["networks"] | changes}


@pytest.mark.parametrize("name", ["sfkd", "no_residual"])
def test_alpha_is_recomputed_and_lies_below_and_close_to_what_was_requested(name):
    proved = certified(name)
    assert 0.97 * RHO < proved.rho <= RHO
    assert proved.alpha_separate == proved.rho + proved.beta < 1
    assert proved.alpha == min(proved.alpha_separate, proved.alpha_joint)
    if name == "no_residual":
        assert proved.beta == 0.0
        assert proved.alpha_joint == pytest.approx(proved.rho, rel=1e-9)
    else:
        assert 0.5 * BETA < proved.beta <= BETA
    model, params = model_and_params(name)
    restored = read_as(Proof, json.loads(json.dumps(asdict(proved))))
    assert restored == proved
    verify_proof(restored, model, params)


def test_the_decoders_constants_bound_what_a_step_emits():
    """Pairs of latents under the same u and e: pose increments in metres and radians,
    body state in m/s.
    """
    model, params = model_and_params("sfkd")
    proved = certified("sfkd").lipschitz
    random = np.random.default_rng(0)
    z = random.standard_normal((2, 400, 8)) * 10.0 ** random.uniform(-2, 1, (1, 400, 1))
    envs = random.uniform([0.3, -8.0], [0.9, 8.0], (400, 2)).astype(np.float32)
    controls = random.uniform([-0.5, -6.0], [0.5, 3.0], (400, 2)).astype(np.float32)

    def emitted(z, env, control):
        fiber = model.fiber(params, env)
        latent = model.encode(fiber, jnp.asarray([0.0, 0.0, 0.0, 10.0]))._replace(z=z)
        after = model.step(fiber, latent, control)
        moved = between(latent.pose, model.decode(fiber, after)[POSE])
        return moved, model.decode(fiber, latent)[3:]

    each = jit(jax.vmap(emitted))
    both = [each(side.astype(np.float32), envs, controls) for side in z]
    motion, body = (
        np.asarray(a, np.float64) - np.asarray(b) for a, b in zip(*both, strict=True)
    )
    gap = np.linalg.norm(z[0] - z[1], axis=1)
    rounding = 3e-6 * (1 + np.linalg.norm(z, axis=2).max(axis=0))
    moved = np.linalg.norm(motion[:, :2], axis=1)
    assert np.all(moved <= proved["position"] * gap + rounding)
    assert np.all(np.abs(motion[:, 2]) <= proved["yaw"] * gap + rounding)
    assert np.all(np.linalg.norm(body, axis=1) <= proved["body"] * gap + rounding)


def test_models_without_explicit_weights_are_refused():
    with pytest.raises(CertificationRefused, match="no explicit weights"):
        prove(*model_and_params("oracle"), BOX)


def test_a_free_residual_that_does_not_contract_is_refused():
    with pytest.raises(CertificationRefused, match=r"alpha = 2\.\d+ .* is not below 1"):
        prove(*model_and_params("no_contraction"), BOX, attack_starts=0)


def test_a_free_residual_that_happens_to_be_small_is_certified_after_the_fact():
    """Nothing is proposed by the model; L-BFGS finds the multipliers."""
    model, params = model_and_params("no_contraction")
    network = params["networks"]["residual_weights"]
    small = network | {"kernel_2": 0.01 * network["kernel_2"]}
    proved = prove(
        model, with_networks(params, residual_weights=small), BOX, attack_starts=0
    )
    reached = attack_slopes([*map(np.float64, jax.tree.leaves(small))])
    assert reached <= proved.beta <= 1.15 * reached


@pytest.mark.parametrize(
    ("leaf", "value"), [("operators", np.nan), ("log_decoder_bound", np.inf)]
)
def test_weights_that_are_not_numbers_are_refused(leaf, value):
    model, params = model_and_params("sfkd")
    spoiled = np.array(params["networks"][leaf])
    spoiled.flat[0] = value
    with pytest.raises(CertificationRefused, match="not finite"):
        prove(model, with_networks(params, **{leaf: spoiled}), BOX)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_decoder_that_emits_a_constant_has_constant_zero():
    model, params = model_and_params("sfkd")
    network = params["networks"]["decoder_weights"]
    silent = network | {"tall_1": np.zeros_like(network["tall_1"])}
    proved = prove(
        model, with_networks(params, decoder_weights=silent), BOX, attack_starts=0
    )
    for output in ("position", "yaw", "decoder"):
        assert proved.lipschitz[output] == 0.0
    verify_proof(proved, model, with_networks(params, decoder_weights=silent))
