"""Claims of networks small enough for numpy alone: honest ones hold, and every forgery is refused by its name.

`benchmarks/mutants.py` runs these against each change of `_claims` and `_certificate`.
"""

import dataclasses
import inspect
import json
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from sfkd_jax.certification import _certificate, _claims, _proofs
from sfkd_jax.certification._attack_all import FLOAT32
from sfkd_jax.certification._certificate import Certificate, CertificateStale
from sfkd_jax.certification._claims import Claims, Refuted, claims_hold
from sfkd_jax.certification._exported import CertificationRefused, fingerprint, one_thread
from sfkd_jax.types import Declared, Explicit, Hypernetwork, Polytope

BOX = [[-0.5, 0.0], [0.5, 0.2]]


def rotation(size, seed):
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((size, size)))[0]


ROOT = np.diag([1.0, 2.0, 3.0])
FIRST, LAST = 0.3 * rotation(4, 3)[:, :3], 0.4 * rotation(4, 4)[:3]
POLYTOPE = Polytope(np.stack([0.3 * rotation(3, 1), 0.5 * rotation(3, 2), 0.4 * rotation(3, 5)]))
NETWORK = Explicit(
    operators=POLYTOPE,
    residual=(FIRST, LAST),
    residual_multipliers=(np.full(4, 0.16),),
    decoder=(2 * FIRST, np.diag([1.0, 2.0, 0.3]) @ LAST),
    decoder_multipliers=(np.full(4, 0.5),),
    readout=np.asarray([[0.7, 0.1, 0.0]]),
    declared=Declared("tanh", "rotation", 2),
)
TURNED = Polytope(np.stack([np.linalg.solve(ROOT, r * rotation(3, k) @ ROOT) for k, r in enumerate((0.3, 0.5))]))
HYPERNETWORK = Hypernetwork(
    (0.5 * rotation(3, 6)[:, :2], 0.1 * rotation(9, 7)[:, :3]), (np.zeros(3), 0.3 * rotation(3, 8).ravel())
)
KINDS = {
    "joint": (NETWORK, True, None),
    "separate": (NETWORK, False, None),
    "bare": (NETWORK._replace(residual=(), residual_multipliers=(), decoder=(), decoder_multipliers=()), True, None),
    "linear": (NETWORK._replace(residual=(FIRST.T @ FIRST,), residual_multipliers=()), True, None),
    "silent": (NETWORK._replace(residual=(FIRST, 0 * LAST)), False, None),
    "metric": (NETWORK._replace(operators=TURNED, declared=Declared("tanh", "identity", 2)), False, ROOT @ ROOT),
    "hypernetwork": (NETWORK._replace(operators=HYPERNETWORK), True, None),
    "bare hypernetwork": (NETWORK._replace(operators=HYPERNETWORK, residual=(), residual_multipliers=()), True, None),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(autouse=True)
def on_one_thread():
    with one_thread():
        yield


@cache
def honest(kind):
    weights, joint, metric = KINDS[kind]
    return _proofs.prove(weights, BOX, joint=joint, metric=metric)


def refuted(claims, weights, named, box=BOX):
    with pytest.raises(Refuted) as told:
        claims_hold(claims, weights, box)
    assert named in str(told.value)


def witness(claims, **changes):
    return claims._replace(witnesses=claims.witnesses | changes)


@every_kind
def test_what_was_proved_holds(kind):
    claims_hold(honest(kind), KINDS[kind][0], BOX)
    assert json.loads(json.dumps(honest(kind).witnesses)) == honest(kind).witnesses


def test_the_constants_are_those_of_the_matrices():
    found = honest("joint")
    assert found.rho == pytest.approx(0.5, rel=2e-6)
    assert 0.06 < found.beta <= 0.12 * (1 + 2e-6)
    assert found.alpha_separate == found.rho + found.beta
    assert 0.5 < found.alpha_joint <= found.alpha_separate * (1 + 1e-6)
    assert found.kappa == 1.0
    assert found.lipschitz["body"] == pytest.approx(np.hypot(0.7, 0.1), rel=2e-6)
    assert set(found.lipschitz) == {"body", "position", "yaw", "decoder"}
    turned = honest("metric")
    assert turned.rho == pytest.approx(0.5, rel=1e-5)
    assert turned.kappa == pytest.approx(9.0, rel=1e-5)
    assert turned.alpha == pytest.approx(0.5 + 3 * turned.beta, rel=1e-5)
    still = honest("bare")
    assert (still.beta, set(still.lipschitz)) == (0.0, {"position", "yaw", "body"})  # along a path
    assert honest("linear").beta == pytest.approx(np.linalg.norm(FIRST.T @ FIRST, 2), rel=2e-6)
    assert honest("silent").beta == 0.0
    assert "hull of 3 vertices; all u, all z" in found.scope
    assert "branch and bound over" in honest("hypernetwork").scope


def test_the_parts_of_the_decoder_are_its_rows():
    parts = _claims.decoders(NETWORK)
    last = NETWORK.decoder[-1]
    for name, rows in (("position", last[:2]), ("yaw", last[2:]), ("decoder", last)):
        np.testing.assert_array_equal(parts[name][-1], rows)
        assert parts[name][0] is NETWORK.decoder[0]
    assert _claims.decoders(KINDS["bare"][0]) == {}


def test_operators_are_served_with_a_margin():
    """Another compilation may round the same weights differently, by 1.5e-7."""
    norm = np.linalg.norm(POLYTOPE.vertices[1], 2)
    rho, scope = _claims.operator_norms(NETWORK, BOX)
    assert norm * (1 + 0.9e-6) < rho < norm * (1 + 1.1e-6)
    assert scope == _claims.hull(NETWORK) == "all e: A(e) lies in the hull of 3 vertices; all u, all z"
    found = _claims.cover(HYPERNETWORK, BOX, _claims.norm_upper)
    rho, scope = _claims.operator_norms(KINDS["hypernetwork"][0], BOX)
    assert rho == _claims.SERVED * found.upper
    assert 1 + 0.9e-6 < _claims.SERVED < 1 + 1.1e-6
    assert scope == f"all e in the box, branch and bound over {found.cells} cells; all u, all z"


CONSTANTS = ("alpha", "alpha_separate", "alpha_joint", "rho", "beta", "kappa")


def replaced(claims, name, value):
    if name in CONSTANTS:
        return claims._replace(**{name: value})
    return claims._replace(lipschitz=claims.lipschitz | {name: value})


@pytest.mark.parametrize("name", [*CONSTANTS, "body", "position", "yaw", "decoder"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -4.1, -5e-324])
def test_what_is_no_bound_is_none(name, value):
    refuted(replaced(honest("joint"), name, value), NETWORK, f"{name} is no bound: {value!r}")


@pytest.mark.parametrize("value", ["0.5", None, [0.5], 0.5j])
def test_what_is_no_number_is_no_bound(value):
    """Assigned past the types, which test runs check."""
    claims = honest("joint")._replace(lipschitz=honest("joint").lipschitz | {"body": value})
    assert ("body", value) in _claims._constants(claims)
    with pytest.raises(Refuted, match="body is no bound"):
        getattr(claims_hold, "__wrapped__", claims_hold)(claims, NETWORK, BOX)


def test_zero_is_a_bound_of_what_does_not_move():
    still = KINDS["bare"][0]._replace(readout=np.zeros((1, 3)))
    claims_hold(replaced(honest("bare"), "position", 0.0), still, BOX)
    refuted(replaced(honest("bare"), "position", 0.0), KINDS["bare"][0], "position does not follow")


def consistent(claims):
    """With everything that is computed from other constants computed again."""
    separate = claims.rho + claims.beta * claims.kappa**0.5
    alpha = min([separate] + ([] if claims.alpha_joint is None else [claims.alpha_joint]))
    return claims._replace(alpha_separate=separate, alpha=alpha)


SMALLER = {
    "joint": ("rho", "beta", "alpha_joint", "body", "position", "yaw", "decoder"),
    "separate": ("rho", "beta", "body", "position", "yaw", "decoder"),
    "bare": ("rho", "alpha_joint", "position"),
    "linear": ("rho", "beta", "alpha_joint", "body", "decoder"),
    "silent": ("rho", "yaw"),
    "metric": ("rho", "beta", "kappa", "body", "position", "yaw", "decoder"),
    "hypernetwork": ("rho", "beta", "alpha_joint", "body", "position", "yaw", "decoder"),
    "bare hypernetwork": ("rho", "alpha_joint", "body"),
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind in SMALLER for name in SMALLER[kind]])
def test_a_smaller_constant_does_not_follow_and_a_larger_one_does(kind, name):
    """Also where all that is computed from it fits."""
    weights, claims = KINDS[kind][0], honest(kind)
    value = replaced(claims, name, 0.0) and dict(_claims._constants(claims))[name]
    named = {"kappa": "rho"}.get(name, name)
    for factor in (0.5, 0.99, 1 - 4e-6):
        refuted(consistent(replaced(claims, name, factor * value)), weights, f"{named} does not follow")
    claims_hold(consistent(replaced(claims, name, 1.001 * value)), weights, BOX)


@pytest.mark.parametrize("name", ["alpha", "alpha_separate"])
@pytest.mark.parametrize("kind", ["joint", "separate", "metric", "hypernetwork"])
def test_what_is_arithmetic_must_be_exact(kind, name):
    claims = honest(kind)
    value = getattr(claims, name)
    for other in (np.nextafter(value, 0.0), np.nextafter(value, 1.0), 0.9 * value, 1.1 * value):
        refuted(claims._replace(**{name: float(other)}), KINDS[kind][0], f"{name} does not follow")


def test_alpha_is_the_smaller_of_both():
    """The joint one where it is smaller, the sum where that is."""
    claims = honest("joint")
    assert claims.alpha == claims.alpha_joint < claims.alpha_separate
    loose = claims._replace(alpha_joint=2.0)
    refuted(loose._replace(alpha=2.0), NETWORK, "alpha does not follow")
    refuted(loose, NETWORK, "alpha does not follow")
    claims_hold(consistent(loose), NETWORK, BOX)


@pytest.mark.parametrize("vertex", range(3))
def test_every_vertex_counts(vertex):
    """The same certificate, and one vertex that is longer than the others were."""
    for kind in ("joint", "separate"):
        longer = np.array(POLYTOPE.vertices)
        longer[vertex] *= 0.6 / np.linalg.norm(longer[vertex], 2)
        claims = honest(kind)
        changed = NETWORK._replace(operators=Polytope(longer))
        refuted(claims, changed, "rho does not follow")
        if kind == "joint":
            refuted(consistent(claims._replace(rho=0.7)), changed, "alpha_joint does not follow")
    longer = np.array(TURNED.vertices)
    longer[vertex % 2] *= 2.2
    refuted(honest("metric"), KINDS["metric"][0]._replace(operators=Polytope(longer)), "rho does not follow")


def test_a_witness_is_needed_for_every_vertex():
    claims = honest("joint")
    for count in (0, 1, 2, 4):
        joint = (2 * claims.witnesses["joint"])[:count]
        with pytest.raises((Refuted, ValueError, IndexError)):
            claims_hold(witness(claims, joint=joint), NETWORK, BOX)


@pytest.mark.parametrize("name", ["residual", "position", "yaw", "decoder", "joint"])
@pytest.mark.parametrize("factor", [0.0, -1.0, 1e6, np.nan])
def test_a_spoiled_witness_proves_nothing(name, factor):
    for kind in ("joint", "hypernetwork"):
        claims = honest(kind)

        def spoiled(part):
            return [spoiled(entry) for entry in part] if isinstance(part, list) else factor * part

        changed = witness(claims, **{name: spoiled(claims.witnesses[name])})
        refuted(changed, KINDS[kind][0], "does not follow from its witness")


def test_a_network_whose_last_layer_moved_is_another_one():
    claims = honest("joint")
    refuted(claims, NETWORK._replace(residual=(FIRST, 1.1 * LAST)), "beta does not follow")
    refuted(honest("silent"), NETWORK, "beta does not follow")
    for row, name in ((0, "position"), (1, "position"), (2, "yaw")):
        last = np.array(NETWORK.decoder[-1])
        last[row] *= 3 if row else 9
        refuted(claims, NETWORK._replace(decoder=(NETWORK.decoder[0], last)), f"{name} does not follow")


def test_constants_must_be_of_the_parts_that_there_are():
    claims, parts = honest("joint"), honest("joint").lipschitz
    told = "lipschitz must be of body, position, yaw, decoder, got "
    refuted(claims._replace(lipschitz=parts | {"height": 7.0}), NETWORK, f"{told}body, position, yaw, decoder, height")
    less = {name: value for name, value in parts.items() if name != "yaw"}
    refuted(claims._replace(lipschitz=less), NETWORK, f"{told}body, position, decoder")


def test_what_all_environments_rests_on_is_part_of_the_claim():
    for kind in KINDS:
        refuted(honest(kind)._replace(scope="all e in the universe"), KINDS[kind][0], "scope does not follow")
        refuted(honest(kind)._replace(scope=""), KINDS[kind][0], "scope does not follow")
    fewer = NETWORK._replace(operators=Polytope(POLYTOPE.vertices[:2]))
    refuted(honest("separate"), fewer, "scope does not follow")


def test_kappa_is_one_without_a_metric_and_proved_with_one():
    for kappa in (0.0, 0.5, 1.0001, 4.0):
        refuted(consistent(honest("joint")._replace(kappa=kappa)), NETWORK, "kappa does not follow")
    claims, weights = honest("metric"), KINDS["metric"][0]
    for kappa in (0.0, 0.5, 1.0, 4.0, 8.99):
        refuted(consistent(claims._replace(kappa=kappa)), weights, "rho does not follow")
    refuted(claims._replace(kappa=16.0), weights, "alpha_separate does not follow")


def test_a_metric_of_condition_one_is_one():
    weights = KINDS["metric"][0]._replace(operators=POLYTOPE)
    claims = _proofs.prove(weights, BOX, joint=False, metric=np.eye(3))
    claims_hold(claims, weights, BOX)
    claims_hold(consistent(claims._replace(kappa=1.5)), weights, BOX)


def test_a_metric_holds_only_without_transport_and_without_a_joint_claim():
    claims, weights = honest("metric"), KINDS["metric"][0]
    refuted(claims, weights._replace(declared=NETWORK.declared), "alpha_joint does not follow")
    joint = consistent(claims._replace(alpha_joint=0.9))
    refuted(witness(joint, joint=honest("joint").witnesses["joint"]), weights, "alpha_joint does not follow")
    refuted(witness(claims, metric=(-ROOT).tolist()), weights, "rho does not follow")
    refuted(witness(claims, metric=None), weights, "does not follow")


@pytest.mark.parametrize(
    "box",
    [
        [[0.5, 0.2], [-0.5, 0.0]],
        [[-0.5, 0.3], [0.5, 0.2]],
        [[-0.5, np.nan], [0.5, 0.2]],
        [[-np.inf, 0.0], [0.5, 0.2]],
        [[-0.5, 0.0], [0.5, np.inf]],
        [[-0.5, 0.0]],
        [[-0.5, 0.0], [0.5, 0.2], [0.6, 0.3]],
        [-0.5, 0.5],
        [[[-0.5]], [[0.5]]],
    ],
)
@pytest.mark.parametrize("kind", ["joint", "hypernetwork"])
def test_a_box_that_is_none_is_refused(kind, box):
    refuted(honest(kind), KINDS[kind][0], "env_box must be a lower and an upper corner", box)


def test_a_box_of_a_point_is_one_and_a_box_of_other_environments_is_none():
    claims_hold(honest("joint"), NETWORK, [[0.1, 0.1], [0.1, 0.1]])
    claims_hold(honest("joint"), NETWORK, [[0.1], [0.2]])  # the hull of vertices holds for any environment
    for box in ([[0.1], [0.2]], [[0.1] * 3, [0.2] * 3]):
        told = f"env_box has {len(box[0])} entries, the operators take 2"
        refuted(honest("hypernetwork"), KINDS["hypernetwork"][0], told, box)


def test_a_larger_box_of_environments_needs_another_proof():
    refuted(honest("hypernetwork"), KINDS["hypernetwork"][0], "does not follow", [[-3.0, -3.0], [3.0, 3.0]])


# --- the certificate around the claims --------------------------------------------------------------------------------

PARAMS = {"networks": {"w": np.ones(3, np.float32)}}
MODEL = SimpleNamespace()


@pytest.fixture
def kind(monkeypatch):
    """Which network the model serves, and what attacks on it find."""
    chosen = SimpleNamespace(name="joint", weights=None, attacks={"step": 0.2, "transport": 1.0})
    served = lambda model, params: KINDS[chosen.name][0] if chosen.weights is None else chosen.weights  # noqa: E731
    monkeypatch.setattr(_certificate, "exported", served)
    monkeypatch.setattr(_certificate, "attack_all", lambda *args: dict(chosen.attacks))
    return chosen


def certified(name="joint", **settings):
    given = {"mode": "joint" if KINDS[name][1] else "separate", "metric": KINDS[name][2]} | settings
    return bare(_certificate.certify)(MODEL, PARAMS, BOX, **given)


def bare(function):
    """Without the check of types: the model here is none."""
    return inspect.unwrap(function)


def verified(certificate, params=PARAMS):
    bare(_certificate.verify)(certificate, params, model=MODEL)


def test_a_certificate_of_each_kind_verifies_and_survives_json(kind):
    for kind.name in KINDS:
        kind.attacks = {"transport": 1.0} | ({} if kind.name == "metric" else {"step": 0.2})
        proof = certified(kind.name)
        again = Certificate.from_document(json.loads(json.dumps(proof.document())) | {"other": 1})
        assert again == proof
        verified(again)
        assert proof.mode == ("joint" if KINDS[kind.name][1] else "separate")
        assert (proof.alpha, proof.scope) == (honest(kind.name).alpha, honest(kind.name).scope)
        assert proof.transport_lipschitz == 1.0
        assert proof.env_box == BOX
        assert proof.params_sha256 == fingerprint(PARAMS)
        found = (None, None) if kind.name == "metric" else (0.2, proof.alpha / 0.2)
        assert (proof.attack, proof.tightness) == found
        assert 0 <= proof.seconds < 100
        assert set(proof.versions) == {"jax", "numpy", "scipy"}
        assert proof.precision.startswith("bounds on the float32 weights as real numbers")


def test_a_certificate_is_frozen(kind):
    with pytest.raises(dataclasses.FrozenInstanceError):
        certified().alpha = 0.1


def test_the_attack_is_told_what_was_asked_for(kind, monkeypatch):
    told = []
    monkeypatch.setattr(_certificate, "attack_all", lambda *args: told.append(args) or {})
    proof = certified()
    certified(attack_starts=3, seed=5)
    assert [args[-2:] for args in told] == [(6, 0), (3, 5)]
    assert (proof.attack, proof.tightness) == (None, None)
    verified(proof)


def test_the_default_is_a_joint_proof(kind):
    assert bare(_certificate.certify)(MODEL, PARAMS, BOX).alpha_joint == honest("joint").alpha_joint


def test_a_margin_decides_how_close_to_one_is_certified(kind):
    alpha = honest("joint").alpha
    certified(margin=1.0 - alpha - 1e-9)
    shown = rf"alpha = {alpha:.6f} \(rho 0\.500\d+, beta 0\.\d+, kappa 1\) is not below 1 by the margin 0\.9"
    with pytest.raises(CertificationRefused, match=shown):
        certified(margin=0.9)
    exact = 1.0 - (1.0 - alpha)
    if exact >= alpha:
        certified(margin=1.0 - alpha)
    for margin, length, holds in ((None, 0.99985, True), (None, 0.99995, False), (0.0, 1.1, False)):
        kind.weights = KINDS["bare"][0]._replace(operators=Polytope(length * POLYTOPE.vertices[1:2] / 0.5))
        settings = {} if margin is None else {"margin": margin}
        if holds:
            certified(**settings)
            continue
        with pytest.raises(CertificationRefused, match="is not below 1 by the margin"):
            certified(**settings)


def test_a_rate_that_is_no_number_is_refused(kind, monkeypatch):
    monkeypatch.setattr(_certificate, "prove", lambda *args, **kwargs: honest("joint")._replace(alpha=float("nan")))
    with pytest.raises(CertificationRefused, match="alpha = nan"):
        certified()


@pytest.mark.parametrize(
    "box", [((1.0,), (0.0,)), ((0.0, 1.0), (1.0, 0.0)), ((0.0,),), (0.0, 1.0), ((np.nan,), (1.0,))]
)
def test_certify_takes_no_box_that_is_none(kind, box):
    with pytest.raises(ValueError, match="env_box must be a lower and an upper corner"):
        bare(_certificate.certify)(MODEL, PARAMS, box)


def test_certify_takes_a_box_of_a_point(kind):
    assert bare(_certificate.certify)(MODEL, PARAMS, ((0.1,), (0.1,))).env_box == [[0.1], [0.1]]


@pytest.mark.parametrize(("mode", "metric"), [("grid", None), ("joint", np.eye(3)), ("grid", np.eye(3))])
def test_a_mode_that_there_is_not_is_an_error(kind, mode, metric):
    with pytest.raises(ValueError, match=f"mode must be one of joint, separate, .*; got '{mode}'"):
        certified(mode=mode, metric=metric)


def test_what_cannot_be_proved_is_refused_with_the_reason(kind):
    with pytest.raises(CertificationRefused, match="a metric needs a polytope"):
        certified(mode="separate", metric=np.eye(3))


def test_a_document_that_lacks_a_key_is_none(kind):
    document = certified().document()
    for name in document:
        lacking = {key: value for key, value in document.items() if key != name}
        with pytest.raises(CertificationRefused, match=f"not a certificate: {name} missing"):
            Certificate.from_document(lacking)
    with pytest.raises(CertificationRefused, match="not a certificate: mode, scope, alpha missing"):
        Certificate.from_document({})


def test_other_weights_are_not_covered(kind):
    proof = certified()
    for other in ({"networks": {"w": np.ones(3)}}, {"networks": {"w": np.full(3, 1.0000001, np.float32)}}):
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


def forged(told, name="joint", **changes):
    """A certificate with some parts replaced is refused, and why."""
    with pytest.raises(CertificationRefused, match=told):
        verified(dataclasses.replace(certified(name), **changes))


@pytest.mark.parametrize("length", [1.0, 1.5])
def test_a_proved_rate_that_does_not_contract_is_no_certificate(kind, length):
    """All of its claims hold."""
    proof = certified("bare")
    kind.weights = KINDS["bare"][0]._replace(operators=Polytope(length * POLYTOPE.vertices[1:2] / 0.5))
    claims = _proofs.prove(kind.weights, BOX, joint=False)
    claims = consistent(claims._replace(rho=max(length, claims.rho) if length > 1 else claims.rho))
    with pytest.raises(CertificationRefused, match="is not below 1, or the transport is not nonexpansive"):
        verified(dataclasses.replace(proof, mode="separate", **claims._asdict()))
    kind.weights = KINDS["bare"][0]._replace(operators=Polytope((1 - 1e-9) * POLYTOPE.vertices[1:2]))
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
    "name", ["residual_slopes", "transport", "body", "position", "yaw_slopes", "step", "step_slopes"]
)
def test_an_attack_may_reach_its_bound_and_no_more(kind, name):
    limits = _certificate.limits_of(Claims(**{field: getattr(certified(), field) for field in Claims._fields}), NETWORK)
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
        proof = dataclasses.replace(
            certified(), attacks=attacks, attack=step, tightness=certified().alpha / step if step else None
        )
        if holds or (name == "step" and value == 0.0):
            verified(proof)
            continue
        with pytest.raises(CertificationRefused, match=f"the attack {name} = .* contradicts the bound"):
            verified(proof)


def test_an_attack_on_nothing_is_refused(kind):
    forged("the attack flattery = 0.0 contradicts the bound None", attacks={"flattery": 0.0})


def test_attack_and_tightness_are_of_the_attacks(kind):
    alpha = certified().alpha
    told = "attack or tightness is not what the attacks found"
    for attack in (0.3, 0.5, None, np.nan):
        forged(told, attack=attack)
    for tightness in (alpha / 0.21, alpha / 0.19, None, 1.0, np.nan):
        forged(told, tightness=tightness)
    forged(told, attacks={"step": 0.3})
    forged(told, attacks={})
    forged(told, attacks={}, attack=None)
    verified(dataclasses.replace(certified(), attacks={}, attack=None, tightness=None))


@pytest.mark.parametrize(
    "changes",
    [
        {"witnesses": {}},
        {"witnesses": {"residual": 3, "metric": None, "joint": None}},
    ],
)
def test_what_is_malformed_is_refused_in_one_line(kind, changes):
    with pytest.raises(CertificationRefused, match=r"^the certificate is malformed: \S[^\n]*$"):
        verified(dataclasses.replace(certified(), **changes))
