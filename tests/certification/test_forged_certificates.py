"""Certificates of tiny networks: honest ones verify, forged ones are refused.

`benchmarks/robustness/mutants.py` runs these tests against mutants of `_certificate`.
"""

import dataclasses
import inspect
import json
from types import SimpleNamespace

import numpy as np
import pytest
from networks import (
    BOX,
    FIRST,
    KINDS,
    LAST,
    NETWORK,
    POLYTOPE,
    consistent,
    honest,
    proved_once,
)

from sfkd_jax.certification import _certificate, _proofs
from sfkd_jax.certification._attack_all import FLOAT32
from sfkd_jax.certification._certificate import Certificate, CertificateStale
from sfkd_jax.certification._claims import Claims
from sfkd_jax.certification._exported import (
    CertificationRefused,
    fingerprint,
    one_thread,
)
from sfkd_jax.types import Polytope


@pytest.fixture(autouse=True)
def on_one_thread():
    with one_thread():
        yield


PARAMS = {"networks": {"w": np.ones(3, np.float32)}}
MODEL = SimpleNamespace()


@pytest.fixture
def kind(monkeypatch):
    """Which network the model serves, and what attacks on it find."""
    monkeypatch.setattr(_certificate, "prove", proved_once)
    chosen = SimpleNamespace(
        name="joint", weights=None, attacks={"step": 0.2, "transport": 1.0}
    )
    served = lambda model, params: (
        KINDS[chosen.name][0] if chosen.weights is None else chosen.weights
    )
    monkeypatch.setattr(_certificate, "exported", served)
    monkeypatch.setattr(_certificate, "attack_all", lambda *args: dict(chosen.attacks))
    return chosen


def certified(name="joint", **settings):
    given = {
        "mode": "joint" if KINDS[name][1] else "separate",
        "metric": KINDS[name][2],
    } | settings
    return bare(_certificate.certify)(MODEL, PARAMS, BOX, **given)


def bare(function):
    """Without the check of types: the model here is none."""
    return inspect.unwrap(function)


def verified(certificate, params=PARAMS):
    bare(_certificate.verify)(certificate, params, model=MODEL)


def test_a_certificate_is_frozen(kind):
    with pytest.raises(dataclasses.FrozenInstanceError):
        certified().alpha = 0.1


def test_the_attack_is_told_what_was_asked_for(kind, monkeypatch):
    calls = []
    monkeypatch.setattr(
        _certificate, "attack_all", lambda *args: calls.append(args) or {}
    )
    proof = certified()
    certified(attack_starts=3, seed=5)
    assert [args[-2:] for args in calls] == [(6, 0), (3, 5)]
    assert (proof.attack, proof.tightness) == (None, None)
    verified(proof)


def test_the_default_is_a_joint_proof(kind):
    assert (
        bare(_certificate.certify)(MODEL, PARAMS, BOX).alpha_joint
        == honest("joint").alpha_joint
    )


def test_a_margin_decides_how_close_to_one_is_certified(kind):
    alpha = honest("joint").alpha
    certified(margin=1.0 - alpha - 1e-9)
    shown = rf"alpha = {alpha:.6f} \(rho 0\.500\d+, beta 0\.\d+, kappa 1\) is not below 1 by the margin 0\.9"
    with pytest.raises(CertificationRefused, match=shown):
        certified(margin=0.9)
    exact = 1.0 - (1.0 - alpha)
    if exact >= alpha:
        certified(margin=1.0 - alpha)
    for margin, length, holds in (
        (None, 0.99985, True),
        (None, 0.99995, False),
        (0.0, 1.1, False),
    ):
        kind.weights = KINDS["bare"][0]._replace(
            operators=Polytope(length * POLYTOPE.vertices[1:2] / 0.5)
        )
        settings = {} if margin is None else {"margin": margin}
        if holds:
            certified(**settings)
            continue
        with pytest.raises(CertificationRefused, match="is not below 1 by the margin"):
            certified(**settings)


def test_a_rate_that_is_no_number_is_refused(kind, monkeypatch):
    monkeypatch.setattr(
        _certificate,
        "prove",
        lambda *args, **kwargs: honest("joint")._replace(alpha=float("nan")),
    )
    with pytest.raises(CertificationRefused, match="alpha = nan"):
        certified()


@pytest.mark.parametrize(
    "box",
    [
        ((1.0,), (0.0,)),
        ((0.0, 1.0), (1.0, 0.0)),
        ((0.0,),),
        ((0.0,), (0.5,), (1.0,)),
        (0.0, 1.0),
        (((0.0,),), ((1.0,),)),
        ((np.nan,), (1.0,)),
    ],
)
def test_certify_takes_no_box_that_is_none(kind, box):
    with pytest.raises(ValueError, match="env_box must be a lower and an upper corner"):
        bare(_certificate.certify)(MODEL, PARAMS, box)


def test_certify_takes_a_box_of_a_point(kind):
    assert bare(_certificate.certify)(MODEL, PARAMS, ((0.1,), (0.1,))).env_box == [
        [0.1],
        [0.1],
    ]


@pytest.mark.parametrize(
    ("mode", "metric"), [("grid", None), ("joint", np.eye(3)), ("grid", np.eye(3))]
)
def test_a_mode_that_there_is_not_is_an_error(kind, mode, metric):
    with pytest.raises(
        ValueError, match=f"mode must be one of joint, separate, .*; got '{mode}'"
    ):
        certified(mode=mode, metric=metric)


def test_what_cannot_be_proved_is_refused_with_the_reason(kind):
    with pytest.raises(CertificationRefused, match="a metric needs a polytope"):
        certified(mode="separate", metric=np.eye(3))


def test_a_document_that_lacks_a_key_is_none(kind):
    document = certified().document()
    for name in document:
        lacking = {key: value for key, value in document.items() if key != name}
        with pytest.raises(
            CertificationRefused, match=f"not a certificate: {name} missing"
        ):
            Certificate.from_document(lacking)
    with pytest.raises(
        CertificationRefused, match="not a certificate: mode, scope, alpha missing"
    ):
        Certificate.from_document({})


def test_other_weights_are_not_covered(kind):
    proof = certified()
    for other in (
        {"networks": {"w": np.ones(3)}},
        {"networks": {"w": np.full(3, 1.0000001, np.float32)}},
    ):
        with pytest.raises(CertificateStale, match="about other weights"):
            verified(proof, other)
    with pytest.raises(CertificateStale):
        verified(dataclasses.replace(proof, params_sha256="0" * 64))
    with pytest.raises(CertificateStale):
        verified(dataclasses.replace(proof, params_sha256="f" * 64))


def test_a_model_that_serves_something_else_is_noticed(kind):
    proof = certified()
    kind.weights = NETWORK._replace(residual=(FIRST, 2 * LAST))
    with pytest.raises(CertificationRefused, match="beta does not follow"):
        verified(proof)


def test_weights_that_are_at_hand_are_not_served_again(kind, monkeypatch):
    proof = certified()
    monkeypatch.setattr(
        _certificate, "exported", lambda model, params: pytest.fail("served again")
    )
    bare(_certificate.verify)(proof, PARAMS, model=MODEL, weights=NETWORK)
    other = NETWORK._replace(residual=(FIRST, 2 * LAST))
    with pytest.raises(CertificationRefused, match="beta does not follow"):
        bare(_certificate.verify)(proof, PARAMS, model=MODEL, weights=other)


def forged(message, name="joint", **changes):
    """A certificate with some parts replaced is refused, and why."""
    with pytest.raises(CertificationRefused, match=message):
        verified(dataclasses.replace(certified(name), **changes))


@pytest.mark.parametrize("length", [1.0, 1.5])
def test_a_proved_rate_that_does_not_contract_is_no_certificate(kind, length):
    """All of its claims hold."""
    proof = certified("bare")
    kind.weights = KINDS["bare"][0]._replace(
        operators=Polytope(length * POLYTOPE.vertices[1:2] / 0.5)
    )
    claims = _proofs.prove(kind.weights, BOX, joint=False)
    claims = consistent(
        claims._replace(rho=max(length, claims.rho) if length > 1 else claims.rho)
    )
    with pytest.raises(
        CertificationRefused,
        match="is not below 1, or the transport is not nonexpansive",
    ):
        verified(dataclasses.replace(proof, mode="separate", **claims._asdict()))
    kind.weights = KINDS["bare"][0]._replace(
        operators=Polytope((1 - 1e-9) * POLYTOPE.vertices[1:2])
    )
    claims = consistent(_proofs.prove(kind.weights, BOX, joint=False)._replace(rho=1.0))
    with pytest.raises(CertificationRefused, match=r"alpha = 1\.0 is not below 1"):
        verified(dataclasses.replace(proof, mode="separate", **claims._asdict()))


@pytest.mark.parametrize("value", [0.0, 0.999, 1.0000001, 2.0, np.nan])
def test_a_transport_that_is_not_an_isometry_is_refused(kind, value):
    forged("transport is not nonexpansive", transport_lipschitz=value)


def test_the_mode_and_the_joint_claim_go_together(kind):
    forged("mode 'separate' does not fit", mode="separate")
    forged("mode 'grid' does not fit", mode="grid")
    kind.name = "separate"
    forged("mode 'joint' does not fit", "separate", mode="joint")
    forged("mode 'grid' does not fit", "separate", mode="grid")
    forged("mode 'inner' does not fit", "separate", mode="inner")
    forged("mode '~' does not fit", "separate", mode="~")


def test_what_precision_is_covered_cannot_be_reworded(kind):
    for text in ("", "exact", "zzz", _certificate.PRECISION + " "):
        forged("precision is not what is covered", precision=text)


@pytest.mark.parametrize(
    "name",
    [
        "residual_slopes",
        "transport",
        "body",
        "position",
        "yaw_slopes",
        "step",
        "step_slopes",
    ],
)
def test_an_attack_may_reach_its_bound_and_no_more(kind, name):
    honest_proof = certified()
    claims = Claims(**{field: getattr(honest_proof, field) for field in Claims._fields})
    limits = _certificate.limits_of(claims, NETWORK)
    for value, holds in (
        (0.0, name != "step"),
        (0.5 * limits[name], True),
        (limits[name], True),
        (limits[name] * (1 + FLOAT32), True),
        (limits[name] * (1 + 1.1 * FLOAT32), False),
        (limits[name] * 3, False),
        (-1e-300, False),
        (-1.0, False),
        (np.nan, False),
        (np.inf, False),
    ):
        attacks = {"step": 0.2} | {name: value}
        step = attacks["step"]
        tightness = honest_proof.alpha / step if step else None
        proof = dataclasses.replace(
            honest_proof, attacks=attacks, attack=step, tightness=tightness
        )
        if holds or (name == "step" and value == 0.0):
            verified(proof)
            continue
        with pytest.raises(
            CertificationRefused, match=f"the attack {name} = .* contradicts the bound"
        ):
            verified(proof)


def test_an_attack_on_nothing_is_refused(kind):
    forged(
        "the attack flattery = 0.0 contradicts the bound None",
        attacks={"flattery": 0.0},
    )


def test_attack_and_tightness_are_of_the_attacks(kind):
    alpha = certified().alpha
    message = "attack or tightness does not follow from the attacks"
    for attack in (0.3, 0.5, None, np.nan):
        forged(message, attack=attack)
    for tightness in (alpha / 0.21, alpha / 0.19, None, 1.0, np.nan):
        forged(message, tightness=tightness)
    forged(message, attacks={"step": 0.3})
    forged(message, attacks={})
    forged(message, attacks={}, attack=None)
    verified(dataclasses.replace(certified(), attacks={}, attack=None, tightness=None))


@pytest.mark.parametrize(
    "changes",
    [
        {"witnesses": {}},
        {"witnesses": {"residual": 3, "metric": None, "joint": None}},
    ],
)
def test_what_is_malformed_is_refused_in_one_line(kind, changes):
    with pytest.raises(
        CertificationRefused, match=r"^the certificate is malformed: \S[^\n]*$"
    ):
        verified(dataclasses.replace(certified(), **changes))


def test_a_certificate_of_each_kind_verifies_and_survives_json(kind):
    for kind.name in KINDS:
        kind.attacks = {"transport": 1.0} | (
            {} if kind.name == "metric" else {"step": 0.2}
        )
        proof = certified(kind.name)
        again = Certificate.from_document(
            json.loads(json.dumps(proof.document())) | {"other": 1}
        )
        assert again == proof
        verified(again)
        assert proof.mode == ("joint" if KINDS[kind.name][1] else "separate")
        assert (proof.alpha, proof.scope) == (
            honest(kind.name).alpha,
            honest(kind.name).scope,
        )
        assert proof.transport_lipschitz == 1.0
        assert proof.env_box == BOX
        assert proof.params_sha256 == fingerprint(PARAMS)
        expected = (None, None) if kind.name == "metric" else (0.2, proof.alpha / 0.2)
        assert (proof.attack, proof.tightness) == expected
        assert 0 <= proof.seconds < 100
        assert set(proof.versions) == {"jax", "numpy", "scipy"}
        assert proof.precision.startswith(
            "bounds on the float32 weights as real numbers"
        )
