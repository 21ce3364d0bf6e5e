"""Certificates in a frame that no car has: a height, and two angles that are one output."""

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from documents import hashed
from helpers import ENV_HIGH, ENV_LOW, path_space, put

from sfkd_jax import models, store
from sfkd_jax.certificate import Boxes, Certificate, Provenance, parse, read, write
from sfkd_jax.certification import (
    CertificateContradicted,
    CertificationRefused,
    _search,
    measure,
    prove,
    radii,
    residuals,
    verify,
    verify_proof,
)
from sfkd_jax.certification._claims import readouts
from sfkd_jax.rollout import fold, rollout
from sfkd_jax.types import Frame, Trajectory

FRAME = Frame(
    name="hanging",
    has_pose=False,
    outputs={"height": (3,), "swing": (4, 5)},
    units={"height": "m", "swing": "rad"},
    angles=(4, 5),
    lengths=(0.0, 0.0, 0.0, 1.0),
    length=0.1,
    distances=(3,),
)
OPTIONS = {
    "rho": 0.8,
    "vertices": 2,
    "residual_hidden": (6,),
    "embedding": 4,
    "lift": "state",
    "transport": False,
}
BOX = (ENV_LOW, ENV_HIGH)


@cache
def trained(frame=FRAME):
    """What a certificate is about, with weights of a generic size."""
    model = models.sfkd(path_space(), frame=frame, **OPTIONS)
    random = np.random.default_rng(1)
    params = jax.tree.map(
        lambda leaf: leaf + 0.3 * random.standard_normal(leaf.shape).astype("float32"),
        model.init(jax.random.key(0)),
    )
    sizes = {"body_mean": [0.0] * 3, "control_mean": [0.0] * 4, "env_mean": [0.0] * 2}
    return SimpleNamespace(
        model=model,
        params=params,
        sha256="0" * 64,
        weights_sha256="1" * 64,
        settings={
            "environment": {"low": [*ENV_LOW], "high": [*ENV_HIGH]},
            "space": sizes,
        },
    )


@cache
def runs(seed, count=24, steps=15):
    """What the model predicts from one true state to the next, and disturbances."""
    keys = jax.random.split(jax.random.key(seed), 4)
    policy = trained()
    spread = jnp.asarray([0.03, 1.0, 0.02, 1.0])
    controls = spread * jax.random.uniform(keys[0], (count, steps, 4), minval=-1.0)
    low, high = jnp.asarray(ENV_LOW), jnp.asarray(ENV_HIGH)
    envs = low + (high - low) * jax.random.uniform(keys[1], (count, steps, 2))
    noise = 0.01 * jax.random.normal(keys[2], (count, steps, 3))
    body = jax.random.normal(keys[3], (count, 3))
    start = jnp.concatenate([jnp.zeros((count, 3)), body], axis=1)

    def after(state, inputs):
        control, env, disturbance = inputs
        fiber = policy.model.fiber(policy.params, env)
        latent = policy.model.step(fiber, policy.model.encode(fiber, state), control)
        state = policy.model.decode(fiber, latent).at[3:].add(disturbance)
        return state, state

    simulate = jax.jit(jax.vmap(partial(jax.lax.scan, after)))
    _, states = simulate(start, (controls, envs, noise))
    states = jnp.concatenate([start[:, None], states], axis=1)
    return Trajectory(states, controls, envs)


@cache
def certified():
    policy = trained()
    proof = prove(policy.model, policy.params, BOX, validation=runs(0), attack_starts=1)
    boxes = Boxes(
        state=((-3.0,) * 3, (3.0,) * 3),
        control=((-1.0,) * 4, (1.0,) * 4),
        env=proof.env_box,
    )
    measured = measure(
        policy.model,
        policy.params,
        proof,
        validation=runs(0),
        calibration=runs(1),
        held_out={"test": runs(2)},
        boxes=boxes,
        horizon=5,
        level=0.9,
    )
    provenance = Provenance(
        policy_sha256=policy.sha256,
        weights_sha256=policy.weights_sha256,
        versions={},
        seconds=1.0,
    )
    return Certificate(proof=proof, measured=measured, provenance=provenance)


@cache
def folded():
    return jax.jit(partial(fold, trained().model))(trained().params)


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    """The file of the certificate."""
    path = tmp_path_factory.mktemp("frame") / "certificate.json"
    write(path, certified())
    return path


def test_what_is_certified_is_read_and_verified_again(document):
    again = read(document, Certificate)
    assert replace(again, sha256="") == certified()
    verify(again, trained())
    assert [*again.proof.lipschitz] == [*again.proof.outputs] == ["height", "swing"]
    assert [*again.measured.outputs] == ["height", "swing"]
    assert [*again.measured.d_bar.one_step] == ["latent", "height", "swing"]
    tube = again.measured.tube
    assert [*tube.physical] == [*tube.asymptotic] == ["height_m", "swing_rad"]
    assert tube.largest_increment_m is None


def test_the_attacks_reach_the_bounds_of_the_outputs_and_stay_below():
    """A linear read-out is as steep everywhere as its bound says."""
    proof = certified().proof
    for name, bound in proof.lipschitz.items():
        assert 0.999 * bound < proof.attacks[name] <= bound * (1 + 1e-5)
    assert 0.3 * proof.alpha < proof.attacks["step"] <= proof.alpha


def test_the_bounds_of_the_outputs_hold_for_pairs_of_states():
    """Of any distance, under the same controls and environments: where two states are,
    and where a step brings them.
    """
    model = trained().model
    weights = folded()
    random = np.random.default_rng(3)
    count = 2000
    states = np.zeros((2, count, 6), np.float32)
    states[..., 3:] = random.standard_normal((2, count, 3))
    states[1, :, 3:] *= 10.0 ** random.uniform(-2, 1, (count, 1))
    states[1] += states[0]
    controls = np.float32(random.standard_normal((count, 4)))
    envs = np.float32(random.uniform(*BOX, (count, 2)))

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, 0))
    def moved(state, control, env):
        fiber = model.fiber(weights, env)
        latent = model.encode(fiber, state)
        after = model.step(fiber, latent, control)
        return model.vector(latent), model.decode(fiber, after)

    (z, after), (other, after_other) = (moved(each, controls, envs) for each in states)
    gap = np.float64(z) - np.float64(other)
    distance = np.float64(states[0]) - np.float64(states[1])
    distance_after = np.float64(after) - np.float64(after_other)
    rounding = 1e-5 * (1 + np.abs(states).max(axis=(0, 2)))
    proof = certified().proof
    for name, rows in FRAME.outputs.items():
        here = np.linalg.norm(distance[:, rows], axis=1)
        later = np.linalg.norm(distance_after[:, rows], axis=1)
        claim = proof.outputs[name]
        factor = np.linalg.cholesky(np.asarray(claim.metric))
        bounds = {
            proof.alpha: proof.lipschitz[name] * np.linalg.norm(gap, axis=1),
            claim.alpha: claim.lipschitz * np.linalg.norm(gap @ factor, axis=1),
        }
        for alpha, bound in bounds.items():
            assert np.all(here <= bound + rounding)
            assert np.all(later <= alpha * bound + rounding)
            # No bound is so loose that it says nothing.
            assert np.max((here - rounding) / bound) > 0.9


def test_every_free_prediction_stays_within_the_radius_of_its_run():
    model = trained().model
    weights = folded()
    predict = jax.jit(jax.vmap(lambda run: rollout(model, weights, run).free))
    errors = np.asarray(predict(runs(2)) - runs(2).states[:, 1:], np.float64)
    measured = residuals(model, weights, runs(2))
    for name, rows in FRAME.outputs.items():
        farthest = np.linalg.norm(errors[..., rows], axis=-1).max(axis=1)
        bounds = radii(measured, name, certified().proof.outputs[name])
        assert np.all(farthest <= bounds["vehicle_to_nominal"] * (1 + 1e-4) + 1e-6)


def refusal(changed):
    """Why a document is refused, also where its forger computes the hash again."""
    with pytest.raises((ValueError, CertificationRefused)) as reason:
        verify(parse(hashed(changed), Certificate), trained())
    return str(reason.value)


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("proof.lipschitz", "lipschitz must be of height, swing, got"),
        ("proof.outputs", "outputs"),
        ("proof.attacks", "the attack sway"),
        ("measured.d_bar.one_step", "measured.d_bar.one_step"),
        ("measured.tube.physical", "tube does not follow"),
        ("measured.tube.asymptotic", "tube does not follow"),
        ("measured.outputs", "measured.outputs are not those of the proof"),
    ],
)
def test_an_output_that_is_renamed_missing_or_added_is_refused(path, reason, document):
    honest = store.read_json(document)
    part = honest
    for key in path.split("."):
        part = part[key]
    swing = "swing_rad" if "tube" in path else "swing"
    less = {name: value for name, value in part.items() if name != swing}
    added = part | {"sway": part[swing]}
    renamed = less | {"sway": part[swing]}
    # An attack that is left out is no claim.
    forged = [added, renamed] if path == "proof.attacks" else [added, renamed, less, {}]
    for changed in forged:
        if path == "proof.outputs" and not changed:
            # A proof may state no metrics, but then nothing is measured in them.
            reason = "measured.outputs are not those of the proof"
        assert reason in refusal(put(honest, path, changed))


@pytest.mark.parametrize(
    "path",
    [
        "proof.lipschitz.height",
        "proof.lipschitz.swing",
        "proof.outputs.swing.lipschitz",
        "proof.outputs.swing.alpha",
    ],
)
def test_a_smaller_bound_is_refused(path, document):
    honest = store.read_json(document)
    part = honest
    for key in path.split("."):
        part = part[key]
    reason = refusal(put(honest, path, 0.99 * part))
    assert reason == f"{path.removeprefix('proof.')} does not follow from its witness"


def test_what_is_measured_in_a_frame_is_no_certificate_in_another(document):
    """The same weights, and other entries or names of the outputs."""
    certificate = read(document, Certificate)
    for outputs in ({"height": (4,), "swing": (3, 5)}, {"rise": (3,), "swing": (4, 5)}):
        units = dict.fromkeys(outputs, "m")
        other = trained(replace(FRAME, outputs=outputs, units=units))
        with pytest.raises(CertificationRefused, match="lipschitz"):
            verify(certificate, other)


def test_a_certifier_that_forgets_an_entry_is_contradicted(monkeypatch):
    def forgetful(weights, frame):
        return readouts(weights, frame) | {"swing": weights.readout[1:2]}

    monkeypatch.setattr(_search, "readouts", forgetful)
    policy = trained()
    with pytest.raises(CertificateContradicted, match="attack on the swing reaches"):
        prove(policy.model, policy.params, BOX, attack_starts=1)


def test_an_output_with_the_name_of_a_constant_replaces_no_check():
    outputs = {"alpha": (3,), "beta": (4, 5)}
    units = dict.fromkeys(outputs, "m")
    policy = trained(replace(FRAME, outputs=outputs, units=units))
    proof = prove(policy.model, policy.params, BOX, attack_starts=0)
    verify_proof(proof, policy.model, policy.params)
    for name in ("alpha", "beta"):
        smaller = proof.lipschitz | {name: 0.9 * proof.lipschitz[name]}
        for forged, reason in (
            (replace(proof, **{name: 0.9 * getattr(proof, name)}), name),
            (replace(proof, lipschitz=smaller), f"lipschitz.{name}"),
        ):
            with pytest.raises(CertificationRefused, match=f"^{reason} does not"):
                verify_proof(forged, policy.model, policy.params)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"units": {"height": "m"}}, "units are of ['height'], outputs ['height', "),
        (
            {"outputs": {"a": (3,), "a_m": (4,)}, "units": {"a": "m", "a_m": ""}},
            "outputs with their units must differ, got ['a_m', 'a_m']",
        ),
        ({"lengths": (0.0, 0.0)}, "lengths must be of at least 3 entries, got 2"),
        ({"distances": (4,)}, "distances must be among the 4 entries with lengths"),
    ],
)
def test_a_frame_that_does_not_fit_together_is_refused(changed, reason):
    with pytest.raises(ValueError, match="frame 'hanging'") as refused:
        replace(FRAME, **changed)
    assert reason in str(refused.value)
