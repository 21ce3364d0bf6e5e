"""Signatures of certificates: who vouches for the measured numbers."""

import json
from dataclasses import replace

import pytest
from composing import run
from documents import hashed, policy_copy
from helpers import put, refusal_of

import sfkd_jax
from sfkd_jax import certificate, policy, store
from sfkd_jax.certificate import read, write
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.experiment import stages


def new_key(folder, name):
    """Write a private and a public key, and return their paths."""
    ed25519 = pytest.importorskip(
        "cryptography.hazmat.primitives.asymmetric.ed25519", exc_type=ImportError
    )
    from cryptography.hazmat.primitives import serialization as form

    key = ed25519.Ed25519PrivateKey.generate()
    private = key.private_bytes(
        form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption()
    )
    public = key.public_key().public_bytes(
        form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo
    )
    (folder / f"{name}.pem").write_bytes(private)
    (folder / f"{name}.public.pem").write_bytes(public)
    return folder / f"{name}.pem", folder / f"{name}.public.pem"


@pytest.fixture
def keys(tmp_path):
    return new_key(tmp_path, "mine")


@pytest.fixture
def signed(tmp_path, keys):
    """A run directory whose certificate is signed with `keys`."""
    run = policy_copy(tmp_path, "dynamic_path")
    path = run / "certificate.json"
    write(path, read(path, DrivingCertificate), signing_key=str(keys[0]))
    return run


def test_a_signed_certificate_loads_with_its_key_and_says_who_signed(signed, keys):
    loaded = sfkd_jax.load(signed, signed_by=keys[1])
    key = certificate.public_key_of(keys[1])
    assert loaded.signature == f"signed by {key}"
    assert f"measured, signed by {key}: d_bar" in repr(loaded)
    assert sfkd_jax.load(signed, signed_by=key.upper()).signature == loaded.signature
    assert sfkd_jax.load(signed).signature == loaded.signature


def test_a_signature_stays_with_what_it_is_about_alone(signed, keys):
    path = signed / "certificate.json"
    original = read(path, DrivingCertificate)
    write(path, original)
    assert read(path, DrivingCertificate) == original
    narrow = replace(original.corridor, seconds=0.0)
    write(path, replace(original, corridor=narrow))
    assert read(path, DrivingCertificate).signature is None


def forge(run):
    """Claim a corridor of a micrometre, with the hash that belongs to it."""
    path = run / "certificate.json"
    forged = store.read_json(path)
    bounds = forged["corridor"]["bounds"]
    bounds |= {"nominal": 5e-7, "vehicle_to_nominal_position": 5e-7}
    forged["corridor"]["corridor_m"] = 1e-6
    path.write_text(json.dumps(hashed(forged)))


def test_a_forged_corridor_loads_unsigned_and_with_no_key(tmp_path, keys):
    run = policy_copy(tmp_path, "dynamic_path")
    forge(run)
    loaded = sfkd_jax.load(run)
    assert loaded.certificate.corridor.corridor_m == 1e-6
    assert loaded.signature == "unsigned"
    assert "measured, unsigned: d_bar" in repr(loaded)
    line = refusal_of(lambda: sfkd_jax.load(run, signed_by=keys[1]))
    assert "is not signed, and was to be signed by" in line


def test_what_was_signed_and_changed_is_refused_with_and_without_a_key(signed, keys):
    forge(signed)
    for key in (keys[1], None):
        line = refusal_of(lambda key=key: sfkd_jax.load(signed, signed_by=key))
        assert "the signature is not that of" in line


def test_another_signer_is_refused(signed, tmp_path):
    _, other = new_key(tmp_path, "other")
    line = refusal_of(lambda: sfkd_jax.load(signed, signed_by=other))
    assert "is signed by" in line
    assert f"not by {certificate.public_key_of(other)}" in line


def test_a_policy_that_a_signature_is_not_about_is_refused(signed, keys):
    (signed / "policy.safetensors").write_bytes(
        (policy.SHIPPED / "kinematic_path" / "policy.safetensors").read_bytes()
    )
    line = refusal_of(lambda: sfkd_jax.load(signed, signed_by=keys[1]))
    assert "about other weights or settings" in line
    (signed / "certificate.json").unlink()
    line = refusal_of(lambda: sfkd_jax.load(signed, signed_by=keys[1]))
    assert "is missing, and was to be signed" in line


@pytest.mark.parametrize("value", ["", "00", "zz", "0" * 128])
def test_a_damaged_signature_is_refused_in_one_line(signed, keys, value):
    path = signed / "certificate.json"
    path.write_text(json.dumps(put(store.read_json(path), "signature.value", value)))
    line = refusal_of(lambda: sfkd_jax.load(signed, signed_by=keys[1]))
    assert "the signature is not that of" in line


def test_files_that_are_no_keys_are_refused_in_one_line(keys, tmp_path):
    private, public = keys
    honest = read(policy.SHIPPED / "kinematic" / "certificate.json", DrivingCertificate)
    for file in (public, tmp_path / "missing.pem"):
        line = refusal_of(
            lambda file=file: write(tmp_path / "c.json", honest, signing_key=str(file))
        )
        assert file.name in line
    assert private.name in refusal_of(lambda: certificate.public_key_of(private))
    assert not (tmp_path / "c.json").exists()


def test_without_cryptography_a_signature_is_not_believed(monkeypatch):
    monkeypatch.setattr(certificate._signature, "can_check", lambda: False)
    name = certificate.Signature(public_key="ab" * 32, value="00")
    assert "which is not checked" in certificate.describe_signature("00", name)
    with pytest.raises(ValueError, match=r"sfkd-jax\[sign\]"):
        sfkd_jax.load("kinematic", signed_by="ab" * 32)
    assert isinstance(sfkd_jax.load("kinematic").certificate, DrivingCertificate)


def test_a_key_that_is_none_stops_the_command_before_it_trains(tmp_path):
    asked = run(f"root={tmp_path}", f"certification.signing_key={tmp_path}/none")
    assert refusal_of(lambda: stages.certify_policy(asked))
    assert not asked.directory.exists()
