"""The document of a certificate: read, verified and forged."""

import copy
import json
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import pytest
from documents import document, hashed, policy_copy, refusal, shipped
from helpers import put, refusal_of

from sfkd_jax import certificate, policy, store
from sfkd_jax.certificate import Certificate, parse, read, write
from sfkd_jax.certification import CertificateStale, _verification, verify
from sfkd_jax.certification._weights import exported
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.corridor import verify_driving

POLICIES = ("kinematic", "dynamic", "kinematic_path", "dynamic_path")
FORGED = ("kinematic", "dynamic_path")
"""In the frame of the body with a decoder, and along a path with a corridor."""


def leaves(value, path=""):
    """(path, value) of every entry; of lists the last number alone."""
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from leaves(entry, f"{path}.{key}")
    elif isinstance(value, list) and value:
        yield from leaves(value[-1], f"{path}.{len(value) - 1}")
    else:
        yield path.removeprefix("."), value


@pytest.fixture
def few_weights(monkeypatch):
    """Explicit weights are computed once for all forgeries."""
    weights = cache(lambda name: exported(shipped(name).model, shipped(name).params))

    def of(model, params):
        return next(weights(name) for name in FORGED if shipped(name).params is params)

    monkeypatch.setattr(_verification, "exported", of)


@pytest.mark.parametrize("name", POLICIES)
def test_what_ships_is_verified_and_is_written_as_it_was_read(name, tmp_path):
    path = policy.SHIPPED / name / "certificate.json"
    honest = read(path, DrivingCertificate)
    verify_driving(honest, shipped(name))
    write(tmp_path / "again.json", honest)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()
    assert read(tmp_path / "again.json", DrivingCertificate) == honest


def test_what_could_not_be_read_again_is_not_written(tmp_path):
    path = policy.SHIPPED / "kinematic_path" / "certificate.json"
    certificate = read(path, DrivingCertificate)
    unusable = {
        "alpha": replace(certificate.proof, alpha=float("nan")),
        "lipschitz": replace(certificate.proof, lipschitz={"yaw": float("inf")}),
    }
    for name, proof in unusable.items():
        with pytest.raises(ValueError, match=name) as refused:
            write(tmp_path / "certificate.json", replace(certificate, proof=proof))
        assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())


def test_a_document_has_the_entries_of_the_class_that_it_is_read_as():
    driving = document("kinematic")
    general = hashed({name: driving[name] for name in driving if name != "corridor"})
    verify(parse(general, Certificate), shipped("kinematic"))
    with pytest.raises(ValueError, match="corridor is missing"):
        parse(general, DrivingCertificate)
    with pytest.raises(ValueError, match="'corridor' is not an entry"):
        parse(driving, Certificate)


# --- forgeries ------------------------------------------------------------------------

CLAIMED = ("rho", "beta", "alpha", "alpha_separate", "alpha_joint", "condition")
CLAIMED += ("c_1", "c_2", "position", "yaw", "body", "decoder", "lipschitz")
"""Bounds, which a forger makes smaller."""


def lie(path, value):
    """A value of the same type that claims more than is proved."""
    *_, key = path.split(".")
    if isinstance(value, str):
        return f"{value} for all cars"
    if value is None:
        return "there is none" if key == "lyapunov_refused" else 0.5
    if "attacks" in path or key == "tightness":
        return 1e3
    if "env_box" in path:
        return 2.0 * value
    # Else of a witness: a multiplier, or an entry of P.
    is_bound = key in CLAIMED or key == "transport_lipschitz"
    return 0.99 * value if is_bound else -value


@pytest.mark.parametrize("name", FORGED)
def test_the_core_refuses_every_changed_entry_of_a_proof(name, few_weights):
    """Although the forger computes the hash again."""
    honest = document(name)
    entries = [*leaves(honest["proof"], "proof")]
    accepted = [
        path
        for path, value in entries
        if refusal(hashed(put(honest, path, lie(path, value))), name) is None
    ]
    assert accepted == []
    assert len(entries) > 30


@pytest.mark.parametrize("name", FORGED)
def test_a_changed_entry_is_refused_while_the_hash_is_that_of_before(name):
    honest = document(name)
    parts = {k: honest[k] for k in ("measured", "corridor", "provenance") if honest[k]}
    tried = 0
    for path, value in leaves(parts):
        tried += 1
        changed = put(honest, path, f"{value}_" if isinstance(value, str) else -1.5)
        with pytest.raises(ValueError, match="changed since it was written"):
            parse(changed, DrivingCertificate)
    assert tried > 40


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        ("measured.tube.latent.3", 1e-6, "tube does not follow"),
        ("measured.tube.physical", {}, "tube does not follow"),
        ("measured.tube.largest_increment_m", 1.0, "tube does not follow"),
        ("measured.d_bar.one_step.latent", 1e-9, "tube does not follow"),
        ("measured.boxes.env.1.0", 2.0, "boxes.env is not proof.env_box"),
        ("measured.boxes.state.0", [], "not a lower and an upper corner"),
        ("measured.boxes.state", [[], []], "boxes.state is of another size"),
        ("measured.boxes.control", [[0.0], [1.0]], "boxes.control is of another size"),
        ("measured.outputs", {}, "outputs are not those of the proof"),
        ("proof.params_sha256", "0" * 64, "about other weights"),
        ("provenance.policy_sha256", "0" * 64, "about other weights or settings"),
        ("provenance.weights_sha256", "0" * 64, "about other weights or settings"),
    ],
)
def test_what_follows_or_would_break_a_reader_is_checked(path, value, reason):
    changed = hashed(put(document("dynamic_path"), path, value))
    assert reason in refusal(changed, "dynamic_path")


# --- hostile values -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        ("proof", None, "proof is not an object"),
        ("proof.alpha", True, "proof.alpha = True is not a finite number"),
        ("proof.alpha", "0.8", "proof.alpha = '0.8' is not a finite number"),
        ("proof.alpha", None, "proof.alpha = None is not a finite number"),
        ("proof.alpha", [0.8], "proof.alpha = [0.8] is not a finite number"),
        ("proof.alpha", 10**400, "is not a finite number"),
        ("proof.alpha", float("nan"), "is not a finite number"),
        ("proof.alpha", -float("inf"), "is not a finite number"),
        ("proof.extra", 1.0, "proof.'extra' is not an entry"),
        ("proof.\u0430lpha", 1.0, r"proof.'\u0430lpha' is not an entry"),
        ("proof.witnesses.joint", 3, "proof.witnesses.joint is not a list"),
        ("proof.witnesses.joint.0", {}, "proof.witnesses.joint.0 is not a list"),
        ("proof.witnesses.joint.0.0.0", None, "joint.0.0.0 = None is not a finite"),
        ("proof.witnesses.joint", [], "alpha_joint does not follow"),
        ("proof.lyapunov.metric", [[1.0], [2.0, 3.0]], "malformed"),
        ("proof.outputs.position.metric", [[1.0]], "metric is of another size"),
        ("proof.env_box", [[1.0, 8.0], [0.0, -8.0]], "env_box is not a lower"),
        ("measured.d_bar.runs", 2000.0, "runs = 2000.0 is no int"),
        ("measured.d_bar.runs", True, "runs = True is no int"),
        ("measured.d_bar.runs", 0, "runs = 0 is not in [1, inf)"),
        ("measured.d_bar.level", 1.0, "level = 1.0 is not in (0, 1)"),
        ("measured.d_bar.holds_for", 3, "holds_for = 3 is no str"),
        ("measured.d_bar.coverage.ci95", [0.9], "ci95 is not a list of 2"),
        ("provenance.versions", {"jax": 1}, "versions.jax = 1 is no str"),
        ("format", 1, "is of format 1, not 2: certify again"),
        ("valid", "true", "'proof' is not an entry"),
    ],
)
def test_a_value_of_another_kind_is_refused_in_one_line_that_names_it(
    path, value, reason
):
    changed = hashed(put(document("dynamic_path"), path, value))
    assert reason in refusal(changed, "dynamic_path")


def test_an_entry_that_is_missing_is_named():
    for path, _ in leaves(document("kinematic")["measured"]["d_bar"], "measured.d_bar"):
        changed = copy.deepcopy(document("kinematic"))
        *above, last = path.split(".")
        inner = changed
        for key in above:
            inner = inner[int(key) if isinstance(inner, list) else key]
        # Parts of the data and packages have any names, and lists any length.
        if isinstance(inner, dict) and above[-1] != "by_scenario":
            del inner[last]
            assert refusal(hashed(changed), "kinematic") == f"{path} is missing"


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{", '{"format": NaN}', '{"format": 1e400}', "{}", '{"a": ' * 10**5],
)
def test_a_file_that_is_no_certificate_is_refused_in_one_line(text, tmp_path):
    (tmp_path / "certificate.json").write_text(text)
    line = refusal_of(lambda: read(tmp_path / "certificate.json", DrivingCertificate))
    assert "certificate.json: " in line


def test_settings_nested_without_end_are_refused_in_one_line(tmp_path):
    nested = {}
    for _ in range(900):
        nested = {"a": nested}
    forged = hashed(put(document("kinematic"), "provenance.settings", nested))
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(forged))
    read(path, DrivingCertificate)
    path.write_text(json.dumps(forged).replace('{"a": {}}', '{"a": ' * 10**5))
    assert "certificate.json: " in refusal_of(lambda: read(path, DrivingCertificate))


# --- about one policy -----------------------------------------------------------------


@pytest.fixture
def copied(tmp_path):
    return policy_copy(tmp_path, "kinematic")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("vehicle.mass", 1600.0),
        ("controller.cost.lateral", 2.0),
    ],
)
def test_a_setting_that_changed_leaves_nothing_certified_and_says_so(
    copied, path, value
):
    """Beside weights that nobody has touched."""
    file = copied / "policy.safetensors"
    arrays, manifest = store.read_arrays(file, kind=policy.KIND)
    config = put(manifest["config"], path, value)
    store.write_arrays(file, arrays, kind=policy.KIND, config=config)
    with pytest.warns(
        UserWarning, match="nothing is certified; .* weights or settings"
    ):
        assert policy.load(copied).certificate is None


def test_a_certificate_of_one_policy_is_stale_beside_another():
    with pytest.raises(CertificateStale):
        verify_driving(
            parse(document("dynamic"), DrivingCertificate), shipped("kinematic")
        )
    about = {"policy_sha256": shipped("kinematic").sha256}
    about |= {"weights_sha256": shipped("kinematic").weights_sha256}
    provenance = document("dynamic")["provenance"] | about
    forged = hashed(document("dynamic") | {"provenance": provenance})
    assert "about other weights" in refusal(forged, "kinematic")


def test_one_weight_that_moved_by_the_smallest_step_is_noticed():
    trained = shipped("kinematic")
    leaf = trained.params["networks"]["operators"]
    nudged = leaf.at[0, 0, 0].set(jnp.nextafter(leaf[0, 0, 0], jnp.inf))
    params = trained.params | {
        "networks": trained.params["networks"] | {"operators": nudged}
    }
    assert jax.tree.structure(params) == jax.tree.structure(trained.params)
    with pytest.raises(CertificateStale, match="about other weights"):
        verify_driving(
            parse(document("kinematic"), DrivingCertificate),
            replace(trained, params=params),
        )


def test_a_forged_certificate_is_an_error_that_names_the_file(copied):
    forged = hashed(put(document("kinematic"), "proof.alpha", 0.5))
    (copied / "certificate.json").write_text(json.dumps(forged))
    line = refusal_of(lambda: policy.load(copied))
    assert "certificate.json: alpha does not follow from its witness" in line


def test_the_reason_of_a_refusal_is_told_in_one_printable_line(copied):
    provenance = read(copied / "certificate.json", DrivingCertificate).provenance
    refused = certificate.Refusal(reason="no\nbound\x1b[31m", provenance=provenance)
    write(copied / "certificate.json", refused)
    assert read(copied / "certificate.json", DrivingCertificate) == refused
    with pytest.warns(UserWarning, match=r"was refused: no bound\\x1b\[31m$"):
        policy.load(copied)
