"""Forged or stale certificates of a policy are refused in one line."""

import math
import shutil
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import entry_at, put, refusal_of
from jaxtyping import TypeCheckError

from sfkd_jax import demo, policy, store
from sfkd_jax.certification import (
    CertificateStale,
    CertificationRefused,
    verify_document,
)


@cache
def shipped(plant="kinematic"):
    return policy.restore(demo.SHIPPED / plant)


@cache
def honest(plant="kinematic"):
    return store.read_json(demo.SHIPPED / plant / "certificate.json")


def check(document, plant="kinematic"):
    trained = shipped(plant)
    bound = {"model": trained.model, "policy_sha256": trained.sha256}
    try:
        verify_document(document, trained.params, **bound)
    # Under test, types are checked before anything is verified.
    except TypeCheckError as reason:
        raise CertificationRefused("of another type") from reason


@pytest.mark.parametrize(
    "plant", ["kinematic", "dynamic", "kinematic_path", "dynamic_path"]
)
def test_what_ships_verifies(plant):
    check(honest(plant), plant)


@pytest.mark.parametrize("claim", ["alpha", "rho", "beta", "lipschitz.position"])
def test_no_proved_constant_can_be_made_smaller(claim):
    for value in ((1 - 1e-5) * entry_at(honest(), claim), math.nan, 1e-320, None):
        with pytest.raises(CertificationRefused):
            check(put(honest(), claim, value))


DERIVED = {
    "kinematic": (
        "tube.latent.19",
        "tube.ultimate",
        "tube.physical.position_m.19",
        "tube.physical.yaw_rad.3",
        "tube.physical.body.7",
        "tube.largest_increment_m",
        "d_bar.value",
        "d_bar.one_step.yaw",
        "d_bar.coverage",
        "d_bar.by_scenario.s3.coverage_ci95.1",
        "decoder_lipschitz",
        "boxes.env.0.0",
        "tightness",
        "attacks.step",
    ),
    "dynamic_path": (
        "tube.asymptotic.position_m",
        "lyapunov.c_2",
        "outputs.position.coverage.asymptotic",
        "outputs.yaw.coverage_ci95.vehicle_to_nominal.1",
        "corridor.corridor_m",
        "corridor.bounds.nominal",
        "corridor.by_scenario.s3.coverage_ci95.0",
    ),
}


@pytest.mark.parametrize(
    ("plant", "number"),
    [(plant, number) for plant, numbers in DERIVED.items() for number in numbers],
)
def test_what_is_arithmetic_is_computed_again(plant, number):
    """To 1e-9: another order of summation moves it by less."""
    value = entry_at(honest(plant), number)
    for forged in ((1 + 3e-9) * value, math.nan):
        with pytest.raises(CertificationRefused):
            check(put(honest(plant), number, forged), plant)


def test_a_corridor_needs_the_metrics_of_its_outputs():
    document = honest("dynamic_path") | {"outputs": {}}
    with pytest.raises(CertificationRefused, match="needs a metric"):
        check(document, "dynamic_path")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("d_bar.level", 1.0),
        ("d_bar.level", 0.9999),  # of 600 trajectories none is high enough
        ("d_bar.level", math.nan),
        ("d_bar.trajectories", -600),
        ("d_bar.runs", 601),
        ("d_bar.coverage_runs", 0),
        ("boxes.state", [[20.0], [3.0]]),
        ("boxes.control", [[-0.5, -4.0], [math.nan, 3.0]]),
        ("boxes.env", [[0.9, 8.0], [0.3, -8.0]]),
        ("d_bar.one_step.body", -5e-324),
        ("lyapunov", {"rho": 0.5}),
        ("scope", "all e in the universe"),
        ("attacks.residual_slopes", 52.0),
        ("tube.physical.height", [0.0]),
    ],
)
def test_what_does_not_go_together_is_refused(path, value):
    with pytest.raises(CertificationRefused):
        check(put(honest(), path, value))


def test_a_sum_that_overflows_proves_no_width():
    bounds = {"nominal": 1.5e308, "vehicle_to_nominal_position": 1.5e308}
    document = honest("dynamic_path")
    for name, bound in bounds.items():
        document = put(document, f"corridor.bounds.{name}", bound)
    with pytest.raises(CertificationRefused, match="corridor_m must be finite"):
        check(document, "dynamic_path")


# --- bound to everything that model and controller compute with -----------------------


def leaves(value, path=()):
    """Where the numbers, words and switches of nested settings lie."""
    if isinstance(value, dict | list):
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        for key, entry in parts:
            yield from leaves(entry, (*path, str(key)))
    else:
        yield ".".join(path), value


def another(value):
    """A value of the same kind that is another one."""
    if isinstance(value, bool) or value is None:
        return not value
    return f"{value}_" if isinstance(value, str) else value * 1.01 + 1


@pytest.fixture
def copied(tmp_path):
    shutil.copytree(demo.SHIPPED / "kinematic", tmp_path / "run")
    return tmp_path / "run"


def test_the_hash_changes_with_every_single_setting():
    manifest = store.read_manifest(
        demo.SHIPPED / "kinematic" / "policy.safetensors", kind=policy.KIND
    )
    settings = dict(leaves(manifest["config"]))
    changed = {
        store.content_hash(
            manifest | {"config": put(manifest["config"], path, another(value))}
        )
        for path, value in settings.items()
    }
    assert len(settings) > 120
    assert len(changed) == len(settings)
    assert shipped().sha256 == store.content_hash(manifest) not in changed
    assert store.content_hash(manifest | {"sha256": "0" * 64}) not in {
        *changed,
        shipped().sha256,
    }


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("space.body_scale.0", 5.0),
        ("vehicle.dt", 0.05),
        ("controller.cost.lateral", 2.0),
        ("model.transport", False),
    ],
)
def test_a_setting_that_changed_leaves_nothing_certified_and_says_so(
    copied, path, value
):
    file = copied / "policy.safetensors"
    arrays, manifest = store.read_arrays(file, kind=policy.KIND)
    config = put(manifest["config"], path, value)
    store.write_arrays(file, arrays, kind=policy.KIND, config=config)
    with pytest.warns(
        UserWarning,
        match="nothing is certified; .* other weights or settings",
    ):
        loaded = policy.load(copied)
    assert loaded.certificate is None


def test_a_forged_certificate_is_an_error_that_names_the_file(copied):
    forged = put(honest(), "alpha", 0.5)
    store.write_json(copied / "certificate.json", forged)
    assert "certificate.json: " in refusal_of(lambda: policy.load(copied))


def test_the_reason_of_a_refusal_is_told_in_one_printable_line(copied):
    refused = {"valid": False, "reason": "no\nbound\x1b[31m"}
    store.write_json(copied / "certificate.json", refused)
    with pytest.warns(UserWarning, match=r"was refused: no bound\\x1b\[31m$"):
        policy.load(copied)


# --- weights --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda leaf: leaf.astype(np.float64), "are float64"),
        (lambda leaf: leaf[..., :-1], "weights networks/operators are"),
        (lambda leaf: np.full_like(leaf, np.nan), "are not finite"),
        (lambda leaf: None, "weights networks/operators are missing"),
    ],
)
def test_weights_that_do_not_fit_the_model_are_refused_in_one_line(
    copied, spoil, message
):
    file = copied / "policy.safetensors"
    arrays, manifest = store.read_arrays(file, kind=policy.KIND)
    changed = spoil(arrays.pop("networks/operators"))
    arrays |= {} if changed is None else {"networks/operators": changed}
    store.write_arrays(file, arrays, kind=policy.KIND, config=manifest["config"])
    line = refusal_of(lambda: policy.load(copied))
    assert message in line
    assert "policy.safetensors" in line


def test_a_certificate_of_one_policy_is_stale_beside_another():
    forged = honest("dynamic") | {"policy_sha256": shipped("kinematic").sha256}
    for other in (honest("dynamic"), forged):
        with pytest.raises(CertificateStale):
            check(other, "kinematic")


def test_one_weight_that_moved_by_the_smallest_step_is_noticed():
    trained = shipped()
    leaf = trained.params["networks"]["operators"]
    nudged = leaf.at[0, 0, 0].set(jnp.nextafter(leaf[0, 0, 0], jnp.inf))
    params = trained.params | {
        "networks": trained.params["networks"] | {"operators": nudged}
    }
    assert jax.tree.structure(params) == jax.tree.structure(trained.params)
    with pytest.raises(CertificateStale):
        verify_document(
            honest(), params, model=trained.model, policy_sha256=trained.sha256
        )
