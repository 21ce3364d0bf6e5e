"""The certificate as a document: what it states, what it refuses, and that attacks stay below it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import HARD, SHARES, VARIANTS, dataset, explicit, jit, model_and_params, steepest_pattern, tiny

from sfkd_jax.certification import CertificationRefused, certify, contraction
from sfkd_jax.se2 import between
from sfkd_jax.types import POSE

RHO, BETA = 0.895, 0.1
BOXES = {"state": [[4.0], [16.0]], "control": [[-0.5, -6.0], [0.5, 3.0]], "env": [[0.3, -8.0], [0.9, 8.0]]}


def with_networks(params, **changes):
    return params | {"networks": params["networks"] | changes}


@pytest.mark.parametrize("name", [*HARD, "no_residual"])
def test_alpha_is_recomputed_and_lies_below_and_close_to_what_was_requested(name):
    proved = contraction(*model_and_params(name))
    assert 0.97 * RHO < proved["rho"] <= RHO
    assert proved["alpha"] == proved["rho"] + proved["beta"] < 1
    if name == "no_residual":
        assert proved["beta"] == 0.0
    else:
        assert 0.9 * BETA < proved["beta"] <= BETA


@pytest.mark.parametrize("name", ["sfkd", "segment"])
@pytest.mark.parametrize("scale", [3.0, 30.0])
def test_other_weights_do_not_get_past_the_requested_bounds(name, scale):
    proved = contraction(*model_and_params(name, scale))
    assert proved["rho"] <= RHO
    assert proved["beta"] <= BETA


def test_the_constants_are_those_of_the_exported_weights():
    weights, proved = explicit("sfkd"), contraction(*model_and_params("sfkd"))
    exact = np.max(np.linalg.norm(weights.vertices, 2, axis=(1, 2)))
    assert exact <= proved["rho"] <= exact * (1 + 1.1e-6)
    readout = np.linalg.norm(weights.readout, 2)
    assert readout * (1 - 1e-14) <= proved["body"] <= readout * (1 + 1e-9)


@pytest.mark.parametrize("name", ["sfkd", "segment"])
@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_the_decoders_constants_bound_it_under_attack(name, scale):
    weights, proved = explicit(name, scale), contraction(*model_and_params(name, scale))
    for part, rows in (("position", slice(0, 2)), ("yaw", slice(2, 3)), ("decoder", slice(0, 3))):
        attack = steepest_pattern((*weights.decoder[:-1], weights.decoder[-1][rows]))
        assert attack <= proved[part] * (1 + 1e-12)
        if scale == 1.0:
            assert proved[part] < 1.5 * attack
    assert max(proved["position"], proved["yaw"]) <= 1.05 * proved["decoder"]
    assert proved["decoder"] <= 1.05 * np.hypot(proved["position"], proved["yaw"])


def test_the_decoders_constants_bound_what_a_step_emits():
    """Pairs of latents under the same u and e: pose increments in metres and radians, body state in m/s."""
    model, params = model_and_params("sfkd")
    proved = contraction(model, params)
    random = np.random.default_rng(0)
    z = random.standard_normal((2, 400, 8)) * 10.0 ** random.uniform(-2, 1, (1, 400, 1))
    envs = random.uniform([0.3, -8.0], [0.9, 8.0], (400, 2)).astype(np.float32)
    controls = random.uniform([-0.5, -6.0], [0.5, 3.0], (400, 2)).astype(np.float32)

    def emitted(z, env, control):
        fiber = model.fiber(params, env)
        latent = model.encode(fiber, jnp.asarray([0.0, 0.0, 0.0, 10.0]))._replace(z=z)
        after = model.step(fiber, latent, control)
        return between(latent.pose, model.decode(fiber, after)[POSE]), model.decode(fiber, latent)[3:]

    both = [jit(jax.vmap(emitted))(side.astype(np.float32), envs, controls) for side in z]
    motion, body = (np.asarray(a, np.float64) - np.asarray(b) for a, b in zip(*both, strict=True))
    apart = np.linalg.norm(z[0] - z[1], axis=1)
    rounding = 3e-6 * (1 + np.linalg.norm(z, axis=2).max(axis=0))
    assert np.all(np.linalg.norm(motion[:, :2], axis=1) <= proved["position"] * apart + rounding)
    assert np.all(np.abs(motion[:, 2]) <= proved["yaw"] * apart + rounding)
    assert np.all(np.linalg.norm(body, axis=1) <= proved["body"] * apart + rounding)


def test_models_without_explicit_weights_are_refused():
    with pytest.raises(CertificationRefused, match="no explicit weights"):
        contraction(*model_and_params("oracle"))


@pytest.mark.parametrize("name", ["no_contraction", "soft"])
def test_a_free_residual_is_refused(name):
    with pytest.raises(CertificationRefused, match="no multipliers"):
        contraction(*model_and_params(name))


@pytest.mark.parametrize("leaf", ["operators", "readout", "log_decoder_bound"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_weights_that_are_not_numbers_are_refused(leaf, value):
    model, params = model_and_params("sfkd")
    spoiled = np.array(params["networks"][leaf])
    spoiled.flat[0] = value
    with pytest.raises(CertificationRefused, match=r"not finite|no multipliers"):
        contraction(model, with_networks(params, **{leaf: spoiled}))


@pytest.mark.parametrize("part", ["residual_weights", "decoder_weights"])
def test_a_nan_anywhere_in_a_bounded_network_is_refused(part):
    model, params = model_and_params("sfkd")
    for leaf, value in params["networks"][part].items():
        spoiled = np.array(value)
        spoiled.flat[-1] = np.nan
        network = params["networks"][part] | {leaf: spoiled}
        with pytest.raises(CertificationRefused, match="not finite"):
            contraction(model, with_networks(params, **{part: network}))


def test_a_rate_that_does_not_contract_is_refused_with_the_rate():
    _, params = model_and_params("sfkd")
    with pytest.raises(CertificationRefused, match=r"alpha = 1\.0.* is not below 1"):
        contraction(tiny(rho=0.95, beta=0.1), params)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_decoder_that_emits_a_constant_has_constant_zero():
    model, params = model_and_params("sfkd")
    network = params["networks"]["decoder_weights"]
    silent = network | {"tall_1": np.zeros_like(network["tall_1"])}
    proved = contraction(model, with_networks(params, decoder_weights=silent))
    assert proved["position"] == proved["yaw"] == proved["decoder"] == 0.0


@pytest.fixture(scope="module")
def certificate():
    return issue("sfkd")


def issue(name, **settings):
    model, params = model_and_params(name)
    data = dataset()
    splits = {"validation": data.validation, "calibration": data.calibration, "held_out": data.test}
    return certify(model, params, **splits, boxes=BOXES, **{"level": 0.9, "horizon": 10, **settings})


def test_a_certificate_has_the_documented_keys(certificate):
    assert set(certificate) >= {
        *("valid", "mode", "scope", "alpha", "alpha_separate", "rho", "beta", "kappa", "decoder_lipschitz"),
        *("transport_lipschitz", "d_bar", "tube", "boxes", "attack", "tightness", "seconds"),
    }
    assert set(certificate["d_bar"]) >= {"value", "level", "trajectories", "coverage", "coverage_ci95"}
    assert set(certificate["tube"]) >= {"latent", "physical", "ultimate"}
    assert set(certificate["boxes"]) == {"state", "control", "env"}
    assert certificate["valid"] is True


def test_a_certificate_states_what_was_proved_and_measured(certificate):
    proved = contraction(*model_and_params("sfkd"))
    for ours, theirs in (("alpha", "alpha"), ("rho", "rho"), ("beta", "beta"), ("decoder_lipschitz", "decoder")):
        assert certificate[ours] == proved[theirs]
    assert certificate["d_bar"]["trajectories"] == round(SHARES[2] * 120)
    assert certificate["d_bar"]["level"] == 0.9
    low, high = certificate["d_bar"]["coverage_ci95"]
    assert 0.0 <= low <= certificate["d_bar"]["coverage"] <= high <= 1.0


def test_the_tubes_of_a_certificate_grow_to_the_ultimate_bound(certificate):
    tube, d_bar = certificate["tube"], certificate["d_bar"]["value"]
    assert d_bar > 0
    assert len(tube["latent"]) == 10
    np.testing.assert_allclose(tube["latent"][0], d_bar)
    np.testing.assert_allclose(tube["ultimate"], d_bar / (1 - certificate["alpha"]))
    assert tube["latent"][-1] < tube["ultimate"]
    for radii in (tube["latent"], *tube["physical"].values()):
        assert len(radii) == 10
        assert np.all(np.diff(radii) > 0)
        assert np.all(np.isfinite(radii))


def test_a_higher_level_gives_a_wider_tube(certificate):
    wider = issue("sfkd", level=0.96)
    assert wider["d_bar"]["value"] > certificate["d_bar"]["value"]
    assert wider["d_bar"]["coverage"] >= certificate["d_bar"]["coverage"]
    assert wider["alpha"] == certificate["alpha"]  # proved, not measured


def test_too_few_calibration_trajectories_are_refused():
    with pytest.raises(CertificationRefused, match=r"24 calibration trajectories are too few for level 0\.99"):
        issue("sfkd", level=0.99)


def test_a_rate_within_the_margin_of_one_is_refused():
    with pytest.raises(CertificationRefused, match="leaves less than the margin"):
        issue("sfkd", separate_margin=0.2)


@pytest.mark.parametrize("name", ["no_contraction", "soft", "oracle"])
def test_what_cannot_be_proved_is_not_certified_however_well_it_predicts(name):
    assert name in (*VARIANTS, "oracle")
    with pytest.raises(CertificationRefused):
        issue(name)
