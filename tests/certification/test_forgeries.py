"""Claims and certificates of tiny networks: honest ones hold, forged ones are refused."""

import inspect
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from networks import BOX, FIRST, KINDS, LAST, NETWORK, POLYTOPE, consistent, honest

from sfkd_jax.certification import (
    Certificate,
    CertificateStale,
    CertificationRefused,
    _certificate,
)
from sfkd_jax.certification._claims import (
    CONSTANTS,
    FLOAT32,
    attack_limits,
    require_claims,
)
from sfkd_jax.certification._search import prove
from sfkd_jax.certification._weights import one_thread
from sfkd_jax.types import Polytope

every_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(autouse=True)
def on_one_thread():
    with one_thread():
        yield


def refuted(claims, weights, named, box=BOX):
    with pytest.raises(CertificationRefused) as reason:
        require_claims(claims, weights, box)
    assert named in str(reason.value)


def witness(claims, **changes):
    return replace(claims, witnesses=claims.witnesses | changes)


@every_kind
def test_what_was_proved_holds(kind):
    require_claims(honest(kind), KINDS[kind], BOX)
    assert json.loads(json.dumps(honest(kind).witnesses)) == honest(kind).witnesses


def test_the_constants_are_those_of_the_matrices():
    claims = honest()
    assert claims.rho == pytest.approx(0.5, rel=2e-6)
    assert 0.06 < claims.beta <= 0.12 * (1 + 2e-6)
    assert 0.5 < claims.alpha_joint <= claims.alpha_separate * (1 + 1e-6)
    assert claims.lipschitz["body"] == pytest.approx(np.hypot(0.7, 0.1), rel=2e-6)
    assert set(claims.lipschitz) == {"body", "position", "yaw", "decoder"}
    assert set(honest("bare").lipschitz) == {"position", "yaw", "body"}
    assert honest("bare").beta == honest("silent").beta == 0.0
    residual = np.linalg.norm(FIRST.T @ FIRST, 2)
    assert honest("linear").beta == pytest.approx(residual, rel=2e-6)
    assert "hull of 3 vertices; all u, all z" in claims.scope


def replaced(claims, name, value):
    if name in CONSTANTS:
        return replace(claims, **{name: value})
    return replace(claims, lipschitz=claims.lipschitz | {name: value})


@pytest.mark.parametrize("name", [*CONSTANTS, "body", "position", "yaw", "decoder"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -5e-324])
def test_what_is_no_bound_is_none(name, value):
    message = f"{name} is not a bound: {value!r}"
    refuted(replaced(honest(), name, value), NETWORK, message)


SMALLER = {
    "network": ("rho", "beta", "alpha_joint", "body", "position", "yaw", "decoder"),
    "bare": ("rho", "alpha_joint", "position"),
    "linear": ("rho", "beta", "alpha_joint", "body", "decoder"),
    "silent": ("rho", "yaw"),
}


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in SMALLER for name in SMALLER[kind]]
)
def test_a_smaller_constant_does_not_follow_and_a_larger_one_does(kind, name):
    """Also where all that is computed from it fits."""
    weights, claims = KINDS[kind], honest(kind)
    value = (vars(claims) | claims.lipschitz)[name]
    for factor in (0.5, 1 - 4e-6):
        smaller = consistent(replaced(claims, name, factor * value))
        refuted(smaller, weights, f"{name} does not follow")
    require_claims(consistent(replaced(claims, name, 1.001 * value)), weights, BOX)


@pytest.mark.parametrize("name", ["alpha", "alpha_separate"])
def test_what_is_arithmetic_must_be_exact(name):
    value = getattr(honest(), name)
    for other in (np.nextafter(value, 0.0), np.nextafter(value, 1.0)):
        changed = replace(honest(), **{name: float(other)})
        refuted(changed, NETWORK, f"{name} does not follow")


def test_alpha_is_the_smaller_of_both():
    loose = replace(honest(), alpha_joint=2.0)
    refuted(replace(loose, alpha=2.0), NETWORK, "alpha does not follow")
    require_claims(consistent(loose), NETWORK, BOX)


@pytest.mark.parametrize("vertex", range(3))
def test_every_vertex_counts(vertex):
    """The same certificate, and one vertex that is longer than the others were."""
    longer = np.array(POLYTOPE.vertices)
    longer[vertex] *= 0.6 / np.linalg.norm(longer[vertex], 2)
    changed = NETWORK._replace(operators=Polytope(longer))
    refuted(honest(), changed, "rho does not follow")
    wider = consistent(replace(honest(), rho=0.7))
    refuted(wider, changed, "alpha_joint does not follow")
    fewer = NETWORK._replace(operators=Polytope(POLYTOPE.vertices[:2]))
    refuted(honest(), fewer, "scope does not follow")


@pytest.mark.parametrize("name", ["residual", "position", "yaw", "decoder", "joint"])
@pytest.mark.parametrize("factor", [0.0, 1e6, np.nan, 1e-320])
def test_a_spoiled_witness_proves_nothing(name, factor):
    def spoiled(part):
        if isinstance(part, list):
            return [spoiled(entry) for entry in part]
        return factor * part

    changed = witness(honest(), **{name: spoiled(honest().witnesses[name])})
    refuted(changed, NETWORK, "does not follow from its witness")


def test_weights_that_moved_are_others():
    moved = NETWORK._replace(residual=(FIRST, 1.1 * LAST))
    refuted(honest(), moved, "beta does not follow")
    refuted(honest("silent"), NETWORK, "beta does not follow")
    for row, name in ((0, "position"), (1, "position"), (2, "yaw")):
        last = np.array(NETWORK.decoder[-1])
        last[row] *= 3 if row else 9
        other = NETWORK._replace(decoder=(NETWORK.decoder[0], last))
        refuted(honest(), other, f"{name} does not follow")


def test_constants_are_of_the_parts_that_there_are():
    parts, message = honest().lipschitz, "lipschitz must be of body, position, yaw"
    more = replace(honest(), lipschitz=parts | {"height": 7.0})
    refuted(more, NETWORK, message)
    less = {name: value for name, value in parts.items() if name != "yaw"}
    refuted(replace(honest(), lipschitz=less), NETWORK, message)


@pytest.mark.parametrize(
    "box",
    [
        [[0.5, 0.2], [-0.5, 0.0]],
        [[-0.5, np.nan], [0.5, 0.2]],
        [[-np.inf, 0.0], [0.5, 0.2]],
        [[-0.5, 0.0]],
        [[-0.5, 0.0], [0.5, 0.2], [0.6, 0.3]],
        [-0.5, 0.5],
    ],
)
def test_a_box_that_is_none_is_refused(box):
    refuted(honest(), NETWORK, "env_box must be a lower and an upper corner", box)


# --- certificates ---------------------------------------------------------------------

PARAMS = {"networks": {"w": np.ones(3, np.float32)}}
MODEL = SimpleNamespace()


@pytest.fixture
def served(monkeypatch):
    """Which network the model serves, and what attacks on it find."""
    chosen = SimpleNamespace(weights=NETWORK, claims=None)
    attacks = {"step": 0.2, "transport": 1.0}
    proved = lambda weights: chosen.claims or honest()
    monkeypatch.setattr(_certificate, "prove", proved)
    monkeypatch.setattr(_certificate, "exported", lambda *_: chosen.weights)
    monkeypatch.setattr(_certificate, "attack_claims", lambda *_: dict(attacks))
    return chosen


def certified(**settings):
    return inspect.unwrap(_certificate.certify)(MODEL, PARAMS, BOX, **settings)


def verified(certificate, params=PARAMS):
    inspect.unwrap(_certificate.verify)(certificate, params, model=MODEL)


def test_a_certificate_verifies_and_survives_json(served):
    proof = certified()
    document = json.loads(json.dumps(proof.document())) | {"other": 1}
    again = Certificate.from_document(document)
    assert again == proof
    verified(again)
    assert (proof.attack, proof.tightness) == (0.2, proof.alpha / 0.2)
    for name in proof.document():
        lacking = {key: value for key, value in document.items() if key != name}
        with pytest.raises(CertificationRefused, match=f"{name} missing"):
            Certificate.from_document(lacking)


@pytest.mark.parametrize("alpha", [0.99995, 1.1, np.nan])
def test_a_rate_that_is_not_below_one_by_the_margin_is_refused(served, alpha):
    served.claims = replace(honest(), alpha=alpha)
    with pytest.raises(CertificationRefused, match="is not below 1 by the margin"):
        certified()


def test_a_proved_rate_that_does_not_contract_is_no_certificate(served):
    """All of its claims hold."""
    proof = certified()
    served.weights = KINDS["bare"]._replace(operators=Polytope(2 * POLYTOPE.vertices))
    expanding = vars(inspect.unwrap(prove)(served.weights))
    with pytest.raises(CertificationRefused, match="is not below 1"):
        verified(replace(proof, **expanding))


def test_other_weights_are_not_covered(served):
    proof = certified()
    for other in (np.ones(3), np.full(3, 1.0000001, np.float32)):
        with pytest.raises(CertificateStale, match="about other weights"):
            verified(proof, {"networks": {"w": other}})
    with pytest.raises(CertificateStale):
        verified(replace(proof, params_sha256="0" * 64))
    served.weights = NETWORK._replace(residual=(FIRST, 2 * LAST))
    with pytest.raises(CertificationRefused, match="beta does not follow"):
        verified(proof)


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        ("transport is not nonexpansive", {"transport_lipschitz": 0.999}),
        ("transport is not nonexpansive", {"transport_lipschitz": np.nan}),
        ("precision is not what is covered", {"precision": "exact"}),
        ("contradicts the bound None", {"attacks": {"flattery": 0.0}}),
        ("attack or tightness", {"attack": np.nan}),
        ("attack or tightness", {"tightness": 1.0}),
        ("attack or tightness", {"attacks": {}}),
        ("lacks 'residual'", {"witnesses": {}}),
        ("malformed", {"witnesses": {"residual": 3, "joint": None}}),
    ],
)
def test_parts_that_do_not_go_together_are_refused_in_one_line(
    served, message, changes
):
    with pytest.raises(CertificationRefused, match=message) as reason:
        verified(replace(certified(), **changes))
    assert "\n" not in str(reason.value)


@pytest.mark.parametrize("name", ["residual_slopes", "body", "yaw_slopes", "step"])
def test_an_attack_may_reach_its_bound_and_no_more(served, name):
    proof = certified()
    limit = attack_limits(proof, NETWORK)[name]
    for value, holds in (
        (0.5 * limit, True),
        (limit * (1 + FLOAT32), True),
        (limit * (1 + 1.1 * FLOAT32), False),
        (-1e-300, False),
        (np.nan, False),
    ):
        attacks = {"step": 0.2} | {name: value}
        tightness = proof.alpha / attacks["step"]
        changed = replace(
            proof, attacks=attacks, attack=attacks["step"], tightness=tightness
        )
        if holds:
            verified(changed)
            continue
        with pytest.raises(CertificationRefused, match=f"the attack {name} = "):
            verified(changed)
