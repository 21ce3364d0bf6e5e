"""Models that must not be certified are refused, with the reason."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ENV_HIGH,
    ENV_LOW,
    TINY,
    certified,
    jit,
    model_and_params,
    path_space,
    space,
)

import sfkd_jax
from sfkd_jax import models, policy
from sfkd_jax.certification import (
    CertificateContradicted,
    CertificationRefused,
    _verification,
    prove,
)
from sfkd_jax.certification._weights import exported
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.types import BODY_FRAME, Samples

BOX = (ENV_LOW, ENV_HIGH)


def declaring(model, **changes):
    """The same model with another declaration."""

    def explicit(params):
        weights = model.structure.explicit(params)
        words = {name: changes[name] for name in changes if name != "operators"}
        declared = dataclasses.replace(weights.declared, **words)
        operators = changes.get("operators", weights.operators)
        return weights._replace(declared=declared, operators=operators)

    return model._replace(structure=model.structure._replace(explicit=explicit))


@pytest.mark.parametrize("activation", ["gelu", ""])
def test_an_activation_whose_slopes_are_not_known_is_refused(activation):
    model, params = model_and_params("sfkd")
    with pytest.raises(CertificationRefused, match="slopes of the activation"):
        prove(declaring(model, activation=activation), params, BOX)


def test_evidence_on_a_grid_is_refused_by_name():
    model, params = model_and_params("sfkd")
    operators = Samples(jnp.tile(0.5 * jnp.eye(8), (49, 1, 1)))
    with pytest.raises(
        CertificationRefused, match="grid-only evidence: 49 sampled environments"
    ):
        prove(declaring(model, operators=operators), params, BOX)


def in_frame(frame, outputs):
    """Export a tiny model in such a frame, with other outputs."""
    spaces = {PATH_FRAME: path_space(), BODY_FRAME: space()}
    model = models.sfkd(spaces[frame], **TINY, frame=frame)
    other = dataclasses.replace(
        frame, name="mine", outputs=outputs, units=dict.fromkeys(outputs, "m")
    )
    exported(model._replace(frame=other), model.init(jax.random.key(0)))


@pytest.mark.parametrize(
    "outputs",
    [
        {"position": slice(0, 2), "yaw": slice(2, 3)},
        {"yaw": slice(2, 3), "position": slice(0, 2), "body": slice(3, None)},
        {"position": slice(0, 2), "roll": slice(2, 3), "body": slice(3, None)},
    ],
)
def test_with_a_pose_the_outputs_are_those_of_its_decoder(outputs):
    in_frame(BODY_FRAME, BODY_FRAME.outputs)
    with pytest.raises(CertificationRefused, match="the frame 'mine' states"):
        in_frame(BODY_FRAME, outputs)


@pytest.mark.parametrize(
    ("outputs", "reason"),
    [
        ({}, "states no outputs"),
        ({"height": (6,)}, "must be entries 3 to 5 of a state"),
        ({"height": (-7,)}, "must be entries 3 to 5 of a state"),
        ({"height": (2, 3)}, "must be entries 3 to 5 of a state"),
        ({"height": ()}, "must be entries 3 to 5 of a state"),
        ({"height": slice(6, None)}, "must be entries 3 to 5 of a state"),
        ({"latent": (3,)}, "'latent', a name that has another meaning"),
        ({"step": (3,)}, "'step', a name that has another meaning"),
    ],
)
def test_without_a_pose_the_outputs_are_entries_that_a_state_has(outputs, reason):
    in_frame(PATH_FRAME, {"height": (5,), "swing": (3, 4)})
    with pytest.raises(CertificationRefused) as refused:
        in_frame(PATH_FRAME, outputs)
    assert "the frame 'mine' states" in str(refused.value)
    assert reason in str(refused.value)


def test_a_decoder_of_the_pose_belongs_to_a_frame_with_one():
    model, params = model_and_params("sfkd")
    with pytest.raises(CertificationRefused, match="a pose exactly if"):
        exported(model._replace(frame=PATH_FRAME), params)


def test_a_transport_that_stretches_is_found_out():
    model, params = model_and_params("sfkd")

    def stretched(fiber, fiber_next, latent):
        moved = model.transport(fiber, fiber_next, latent)
        return moved._replace(z=1.001 * moved.z)

    with pytest.raises(
        CertificateContradicted,
        match=r"INTERNAL ERROR: the attack on the transport reaches 1\.001",
    ):
        prove(model._replace(transport=stretched), params, BOX, attack_starts=1)


def at_the_limit(name):
    """Equal vertices, multiples of the identity: every environment and direction uses
    the whole of ρ.
    """
    model, params = model_and_params(name)
    limit = 10.0 * np.tile(np.eye(8, dtype=np.float32), (3, 1, 1))
    return model, params | {
        "networks": params["networks"] | {"operators": jnp.asarray(limit)}
    }


def modulated(model):
    """FiLM: the environment scales what residual and operator emit, as no bias does."""

    def step(fiber, latent, control):
        after = model.step(fiber, latent, control)
        return after._replace(z=(1.0 + jnp.tanh(control[0]) ** 2) * after.z)

    return model._replace(step=step)


def test_a_step_that_is_not_what_it_declares_is_contradicted_by_the_attack():
    model, params = at_the_limit("sfkd")
    with pytest.raises(CertificateContradicted, match="the attack on the step reaches"):
        prove(modulated(model), params, BOX, attack_starts=1)


@pytest.mark.parametrize("car", ["dynamic", "kinematic"])
def test_certificates_that_ship_survive_other_roundings(car, monkeypatch):
    random = np.random.default_rng(0)

    def rounded(leaf):
        drawn = 1.0 + 1e-6 * random.uniform(-1.0, 1.0, np.shape(leaf))
        return leaf * drawn if isinstance(leaf, np.ndarray) else leaf

    def served(*about):
        return jax.tree.map(rounded, exported(*about))

    monkeypatch.setattr(_verification, "exported", served)
    assert sfkd_jax.load(policy.SHIPPED / f"{car}_path").certificate


# --- attacks --------------------------------------------------------------------------


def test_the_attack_comes_close_to_the_certificate_and_stays_below():
    proved = prove(*at_the_limit("sfkd"), BOX, attack_starts=4)
    assert 1.0 <= proved.tightness <= 1.04
    assert proved.attacks["residual_slopes"] > proved.beta / 1.15
    # An isometry, as served.
    assert proved.attacks["transport"] == pytest.approx(1.0, abs=1e-6)


def test_no_pair_of_latents_ever_moves_apart_faster_than_certified():
    """Latents of any size and distance under shared controls and environments, after
    step and transport.
    """
    model, params = model_and_params("sfkd")
    random, count = np.random.default_rng(0), 1280
    sizes = 10.0 ** random.uniform([-2, -4, -1], [2, 1, 2], (count, 3)).T[..., None]
    z = sizes[0] * random.standard_normal((count, 8))
    other = z + sizes[1] * random.standard_normal((count, 8))
    controls = sizes[2] * random.standard_normal((count, 2))
    envs = random.uniform(ENV_LOW, ENV_HIGH, (2, count, 2))

    def moved(z, control, env, env_next):
        fiber, fiber_next = model.fiber(params, env), model.fiber(params, env_next)
        latent = model.encode(fiber, jnp.asarray([0.0, 0.0, 0.0, 10.0]))._replace(z=z)
        after = model.step(fiber, latent, control)
        return model.vector(model.transport(fiber, fiber_next, after))

    each = jit(jax.vmap(moved))
    z, other, *inputs = (np.float32(part) for part in (z, other, controls, *envs))
    after = np.asarray(each(z, *inputs) - each(other, *inputs), dtype=np.float64)
    start = np.linalg.norm(np.float64(z) - other, axis=1)
    rounding = 2e-6 * (1 + np.abs(z).max(axis=1))
    bound = certified("sfkd").alpha * start + rounding
    assert np.all(np.linalg.norm(after, axis=1) <= bound)
