"""A policy is pushed to the Hub and loaded from there as it was, or refused in a line."""

import json
import re
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from documents import hashed, policy_copy
from helpers import put, refusal_of, same, straight
from hub import served
from huggingface_hub import constants

import sfkd_jax
from sfkd_jax.policy import RECORDED, restore

NAME = "someone/car"
ADDRESS = f"hf://{NAME}"


@pytest.fixture
def hub(tmp_path):
    with served(tmp_path) as running:
        yield running


@pytest.fixture
def pushed(hub):
    """The policy, the hub that has it, and its address with the commit."""
    policy = sfkd_jax.load("kinematic")
    return policy, hub, policy.push(NAME)


def first_control(policy):
    state = policy.controller.init(jax.random.key(0))
    x = jnp.asarray([0.0, 0.3, 0.0, 10.0])
    e = jnp.asarray([0.6, 0.0])
    act = jax.jit(policy.controller.act)
    return act(policy.params, state, x, e, straight(20))[0]


def test_what_is_loaded_is_what_was_pushed(pushed):
    policy, hub, address = pushed
    files = {"policy.safetensors", "certificate.json", "README.md", ".gitattributes"}
    assert set(hub.files(NAME)) == files
    assert address == f"{ADDRESS}@{[*hub.repositories[NAME]][-1]}"
    again = sfkd_jax.load(ADDRESS)
    assert again.certificate == policy.certificate
    assert again.sha256 == restore("kinematic").sha256
    assert same(again.weights, policy.weights)
    np.testing.assert_array_equal(first_control(again), first_control(policy))
    # The card is for people: it is not downloaded.
    downloaded = {parts[-1] for parts in hub.asked if "resolve" in parts}
    assert downloaded == {"policy.safetensors", "certificate.json"}


def test_the_card_says_how_to_load_and_what_is_known(pushed):
    policy, hub, _ = pushed
    head, text = hub.files(NAME)["README.md"].decode().split("---\n", 2)[1:]
    assert "library_name: sfkd_jax" in head
    assert "license: apache-2.0" in head
    assert f'sfkd_jax.load("{ADDRESS}")' in text
    assert f"```text\n{policy!r}\n```" in text
    alpha = policy.certificate.proof.alpha
    (stated,) = re.findall(r"shrinks to ([\d.]+) of what it was", text)
    assert alpha <= float(stated) < alpha + 1e-4
    assert "certificate is unsigned" in text
    replace(policy, certificate=None).push(NAME, license="mit")
    card = hub.files(NAME)["README.md"].decode()
    assert "license: mit" in card
    assert "Nothing: this policy has no certificate" in card
    assert "of what it was" not in card


def test_a_version_is_asked_for_and_a_push_leaves_nothing_of_the_one_before(pushed):
    policy, hub, first = pushed
    # A corridor of recorded runs, which would be read first.
    hub.change(NAME, RECORDED, b"{}")
    without = replace(policy, certificate=None).push(NAME)
    assert not {RECORDED, "certificate.json"} & set(hub.files(NAME))
    assert without != first
    with pytest.warns(UserWarning, match=r"certificate\.json is missing"):
        assert sfkd_jax.load(ADDRESS).certificate is None
    assert sfkd_jax.load(first).certificate == policy.certificate


def test_without_a_network_the_cache_is_read(pushed, monkeypatch):
    policy, hub, _ = pushed
    sfkd_jax.load(ADDRESS)
    asked = len(hub.asked)
    # Nobody asks for the network, or nobody answers there.
    for name, value in (("HF_HUB_OFFLINE", True), ("ENDPOINT", "http://127.0.0.1:9")):
        with monkeypatch.context() as patch:
            patch.setattr(constants, name, value)
            assert sfkd_jax.load(ADDRESS).certificate == policy.certificate
            line = refusal_of(lambda: sfkd_jax.load("hf://someone/else"))
            assert line == (
                "hf://someone/else: the Hub cannot be reached, and it was not "
                "downloaded before"
            )
            line = refusal_of(lambda: policy.push(NAME))
            assert line is not None
            assert line.startswith(f"{ADDRESS}: ")
    assert len(hub.asked) == asked


def test_what_was_changed_on_the_hub_is_refused(pushed):
    _, hub, _ = pushed
    weights = hub.files(NAME)["policy.safetensors"]
    hub.change(NAME, "policy.safetensors", weights[:-1] + bytes([weights[-1] ^ 1]))
    line = refusal_of(lambda: sfkd_jax.load(ADDRESS))
    assert line is not None
    assert "arrays do not match the sha256" in line
    hub.change(NAME, "policy.safetensors", weights)
    document = json.loads(hub.files(NAME)["certificate.json"])
    forged = put(document, "proof.alpha", 0.5 * document["proof"]["alpha"])
    for changed, reason in (
        (forged, "changed since it was written"),
        # Who knows how the hash is computed cannot forge what is proved.
        (hashed(forged), "alpha"),
    ):
        hub.change(NAME, "certificate.json", json.dumps(changed).encode())
        line = refusal_of(lambda: sfkd_jax.load(ADDRESS))
        assert line is not None
        assert reason in line


def test_a_certificate_of_other_weights_is_not_taken(pushed):
    _, hub, _ = pushed
    other = sfkd_jax.policy.SHIPPED / "dynamic" / "certificate.json"
    hub.change(NAME, "certificate.json", other.read_bytes())
    with pytest.warns(UserWarning, match="nothing is certified"):
        assert sfkd_jax.load(ADDRESS).certificate is None


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("hf://someone/nothing", "no such repository, or a private one"),
        (f"{ADDRESS}@v2", "the repository has no such revision"),
        ("hf://someone/empty", "has no policy.safetensors and no system.safetensors"),
        ("hf://car", "a policy on the Hub is hf://owner/name"),
        ("hf://someone/car/policy", "a policy on the Hub is hf://owner/name"),
        (f"{ADDRESS}@", "a policy on the Hub is hf://owner/name"),
        ("hf://a..b/car", "Cannot have -- or .. in repo_id"),
    ],
)
def test_an_address_without_a_policy_is_refused_in_one_line(hub, address, reason):
    hub.commit("someone/empty", {"notes.txt": b"."})
    hub.commit(NAME, {"notes.txt": b"."})
    line = refusal_of(lambda: sfkd_jax.load(address))
    assert line is not None
    assert line.startswith(f"{address}: ")
    assert reason in line


def test_a_push_that_cannot_be_is_refused_in_one_line(hub):
    policy = sfkd_jax.load("kinematic")
    line = refusal_of(lambda: policy.push("car"))
    assert "a policy on the Hub is hf://owner/name" in line
    hub.locked = True
    line = refusal_of(lambda: policy.push(NAME))
    assert line.startswith(f"{ADDRESS}: ")
    assert "403" in line
    assert hub.repositories == {}


def test_without_the_extra_the_line_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    line = refusal_of(lambda: sfkd_jax.load(ADDRESS))
    assert line == (
        f'{ADDRESS}: this needs huggingface_hub: pip install "sfkd-jax[hub]"'
    )


def test_a_signature_is_kept_or_the_push_refused(hub, tmp_path):
    key = tmp_path / "key.pem"
    key.write_bytes(private_key_pem())
    run = policy_copy(tmp_path, "kinematic_path")
    unsigned = sfkd_jax.load(run)
    sfkd_jax.certificate.write(
        run / "certificate.json", unsigned.certificate, signing_key=str(key)
    )
    signed = sfkd_jax.load(run)
    public = signed.certificate.signature.public_key
    signed.push(NAME)
    assert sfkd_jax.load(ADDRESS, signed_by=public).signature.startswith("signed by")
    assert public in hub.files(NAME)["README.md"].decode()
    late = sfkd_jax.Latency(controls=(0.1,))
    changed = sfkd_jax.load(run, latency=late)
    line = refusal_of(lambda: changed.push(NAME))
    assert "signed for other settings" in line


def private_key_pem():
    from cryptography.hazmat.primitives.asymmetric import ed25519
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
    )

    return ed25519.Ed25519PrivateKey.generate().private_bytes(
        Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()
    )
