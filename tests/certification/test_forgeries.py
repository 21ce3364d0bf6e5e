"""Claims of tiny networks: honest ones hold, forged ones are refused by name.

`benchmarks/robustness/mutants.py` runs these tests against mutants of `_claims`.
"""

import json

import numpy as np
import pytest
from networks import (
    BOX,
    FIRST,
    HYPERNETWORK,
    KINDS,
    LAST,
    NETWORK,
    POLYTOPE,
    ROOT,
    TURNED,
    consistent,
    honest,
)

from sfkd_jax.certification import _claims, _proofs
from sfkd_jax.certification._claims import Refuted, require_claims
from sfkd_jax.certification._exported import one_thread
from sfkd_jax.types import Declared, Polytope

every_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(autouse=True)
def on_one_thread():
    with one_thread():
        yield


def refuted(claims, weights, named, box=BOX):
    with pytest.raises(Refuted) as reason:
        require_claims(claims, weights, box)
    assert named in str(reason.value)


def witness(claims, **changes):
    return claims._replace(witnesses=claims.witnesses | changes)


@every_kind
def test_what_was_proved_holds(kind):
    require_claims(honest(kind), KINDS[kind][0], BOX)
    assert json.loads(json.dumps(honest(kind).witnesses)) == honest(kind).witnesses


def test_the_constants_are_those_of_the_matrices():
    claims = honest("joint")
    assert claims.rho == pytest.approx(0.5, rel=2e-6)
    assert 0.06 < claims.beta <= 0.12 * (1 + 2e-6)
    assert claims.alpha_separate == claims.rho + claims.beta
    assert 0.5 < claims.alpha_joint <= claims.alpha_separate * (1 + 1e-6)
    assert claims.kappa == 1.0
    assert claims.lipschitz["body"] == pytest.approx(np.hypot(0.7, 0.1), rel=2e-6)
    assert set(claims.lipschitz) == {"body", "position", "yaw", "decoder"}
    turned = honest("metric")
    assert turned.rho == pytest.approx(0.5, rel=1e-5)
    assert turned.kappa == pytest.approx(9.0, rel=1e-5)
    assert turned.alpha == pytest.approx(0.5 + 3 * turned.beta, rel=1e-5)
    still = honest("bare")
    assert (still.beta, set(still.lipschitz)) == (
        0.0,
        {"position", "yaw", "body"},
    )  # along a path
    assert honest("linear").beta == pytest.approx(
        np.linalg.norm(FIRST.T @ FIRST, 2), rel=2e-6
    )
    assert honest("silent").beta == 0.0
    assert "hull of 3 vertices; all u, all z" in claims.scope
    assert "branch and bound over" in honest("hypernetwork").scope


def test_the_parts_of_the_decoder_are_its_rows():
    parts = _claims.decoders(NETWORK)
    last = NETWORK.decoder[-1]
    for name, rows in (("position", last[:2]), ("yaw", last[2:]), ("decoder", last)):
        np.testing.assert_array_equal(parts[name][-1], rows)
        assert parts[name][0] is NETWORK.decoder[0]
    assert _claims.decoders(KINDS["bare"][0]) == {}


def test_the_parts_of_a_read_out_are_its_rows_along_a_path_and_all_of_it_beside_a_decoder():
    rows = np.arange(15.0).reshape(5, 3)
    parts = _claims.readouts(KINDS["bare"][0]._replace(readout=rows))
    assert list(parts) == ["position", "yaw", "body"]
    for part, expected in zip(
        parts.values(), (rows[:1], rows[1:2], rows[2:]), strict=True
    ):
        np.testing.assert_array_equal(part, expected)
    ((name, whole),) = _claims.readouts(NETWORK._replace(readout=rows)).items()
    assert name == "body"
    np.testing.assert_array_equal(whole, rows)


def test_operators_are_served_with_a_margin():
    """Another compilation may round the same weights differently, by 1.5e-7."""
    norm = np.linalg.norm(POLYTOPE.vertices[1], 2)
    rho, scope = _claims.operator_norms(NETWORK, BOX)
    assert norm * (1 + 0.9e-6) < rho < norm * (1 + 1.1e-6)
    assert (
        scope
        == _claims.hull_scope(NETWORK)
        == "all e: A(e) lies in the hull of 3 vertices; all u, all z"
    )
    actual = _claims.bound_over_box(HYPERNETWORK, BOX, _claims.norm_upper)
    rho, scope = _claims.operator_norms(KINDS["hypernetwork"][0], BOX)
    assert rho == _claims.COMPILATION_SLACK * actual.upper
    assert 1 + 0.9e-6 < _claims.COMPILATION_SLACK < 1 + 1.1e-6
    assert (
        scope
        == f"all e in the box, branch and bound over {actual.cells} cells; all u, all z"
    )


CONSTANTS = ("alpha", "alpha_separate", "alpha_joint", "rho", "beta", "kappa")


def replaced(claims, name, value):
    if name in CONSTANTS:
        return claims._replace(**{name: value})
    return claims._replace(lipschitz=claims.lipschitz | {name: value})


@pytest.mark.parametrize("name", [*CONSTANTS, "body", "position", "yaw", "decoder"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -4.1, -5e-324])
def test_what_is_no_bound_is_none(name, value):
    refuted(
        replaced(honest("joint"), name, value),
        NETWORK,
        f"{name} is not a bound: {value!r}",
    )


@pytest.mark.parametrize("value", ["0.5", None, [0.5], 0.5j])
def test_what_is_no_number_is_no_bound(value):
    """Assigned past the types, which test runs check."""
    claims = honest("joint")._replace(
        lipschitz=honest("joint").lipschitz | {"body": value}
    )
    assert ("body", value) in _claims._constants(claims)
    with pytest.raises(Refuted, match="body is not a bound"):
        getattr(require_claims, "__wrapped__", require_claims)(claims, NETWORK, BOX)


def test_zero_is_a_bound_of_what_does_not_move():
    still = KINDS["bare"][0]._replace(readout=np.zeros((1, 3)))
    require_claims(replaced(honest("bare"), "position", 0.0), still, BOX)
    refuted(
        replaced(honest("bare"), "position", 0.0),
        KINDS["bare"][0],
        "position does not follow",
    )


SMALLER = {
    "joint": ("rho", "beta", "alpha_joint", "body", "position", "yaw", "decoder"),
    "separate": ("rho", "beta", "body", "position", "yaw", "decoder"),
    "bare": ("rho", "alpha_joint", "position"),
    "linear": ("rho", "beta", "alpha_joint", "body", "decoder"),
    "silent": ("rho", "yaw"),
    "metric": ("rho", "beta", "kappa", "body", "position", "yaw", "decoder"),
    "hypernetwork": (
        "rho",
        "beta",
        "alpha_joint",
        "body",
        "position",
        "yaw",
        "decoder",
    ),
    "bare hypernetwork": ("rho", "alpha_joint", "body"),
}


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in SMALLER for name in SMALLER[kind]]
)
def test_a_smaller_constant_does_not_follow_and_a_larger_one_does(kind, name):
    """Also where all that is computed from it fits."""
    weights, claims = KINDS[kind][0], honest(kind)
    value = replaced(claims, name, 0.0) and dict(_claims._constants(claims))[name]
    named = {"kappa": "rho"}.get(name, name)
    for factor in (0.5, 0.99, 1 - 4e-6):
        refuted(
            consistent(replaced(claims, name, factor * value)),
            weights,
            f"{named} does not follow",
        )
    require_claims(consistent(replaced(claims, name, 1.001 * value)), weights, BOX)


@pytest.mark.parametrize("name", ["alpha", "alpha_separate"])
@pytest.mark.parametrize("kind", ["joint", "separate", "metric", "hypernetwork"])
def test_what_is_arithmetic_must_be_exact(kind, name):
    claims = honest(kind)
    value = getattr(claims, name)
    for other in (
        np.nextafter(value, 0.0),
        np.nextafter(value, 1.0),
        0.9 * value,
        1.1 * value,
    ):
        refuted(
            claims._replace(**{name: float(other)}),
            KINDS[kind][0],
            f"{name} does not follow",
        )


def test_alpha_is_the_smaller_of_both():
    """The joint one where it is smaller, the sum where that is."""
    claims = honest("joint")
    assert claims.alpha == claims.alpha_joint < claims.alpha_separate
    loose = claims._replace(alpha_joint=2.0)
    refuted(loose._replace(alpha=2.0), NETWORK, "alpha does not follow")
    refuted(loose, NETWORK, "alpha does not follow")
    require_claims(consistent(loose), NETWORK, BOX)


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
            refuted(
                consistent(claims._replace(rho=0.7)),
                changed,
                "alpha_joint does not follow",
            )
    longer = np.array(TURNED.vertices)
    longer[vertex % 2] *= 2.2
    refuted(
        honest("metric"),
        KINDS["metric"][0]._replace(operators=Polytope(longer)),
        "rho does not follow",
    )


def test_a_witness_is_needed_for_every_vertex():
    claims = honest("joint")
    for count in (0, 1, 2, 4):
        joint = (2 * claims.witnesses["joint"])[:count]
        with pytest.raises((Refuted, ValueError, IndexError)):
            require_claims(witness(claims, joint=joint), NETWORK, BOX)


@pytest.mark.parametrize("name", ["residual", "position", "yaw", "decoder", "joint"])
@pytest.mark.parametrize("factor", [0.0, -1.0, 1e6, np.nan])
def test_a_spoiled_witness_proves_nothing(name, factor):
    for kind in ("joint", "hypernetwork"):
        claims = honest(kind)

        def spoiled(part):
            return (
                [spoiled(entry) for entry in part]
                if isinstance(part, list)
                else factor * part
            )

        changed = witness(claims, **{name: spoiled(claims.witnesses[name])})
        refuted(changed, KINDS[kind][0], "does not follow from its witness")


def test_a_network_whose_last_layer_moved_is_another_one():
    claims = honest("joint")
    refuted(
        claims, NETWORK._replace(residual=(FIRST, 1.1 * LAST)), "beta does not follow"
    )
    refuted(honest("silent"), NETWORK, "beta does not follow")
    for row, name in ((0, "position"), (1, "position"), (2, "yaw")):
        last = np.array(NETWORK.decoder[-1])
        last[row] *= 3 if row else 9
        refuted(
            claims,
            NETWORK._replace(decoder=(NETWORK.decoder[0], last)),
            f"{name} does not follow",
        )


def test_constants_must_be_of_the_parts_that_there_are():
    claims, parts = honest("joint"), honest("joint").lipschitz
    message = "lipschitz must be of body, position, yaw, decoder, got "
    refuted(
        claims._replace(lipschitz=parts | {"height": 7.0}),
        NETWORK,
        f"{message}body, position, yaw, decoder, height",
    )
    less = {name: value for name, value in parts.items() if name != "yaw"}
    refuted(
        claims._replace(lipschitz=less), NETWORK, f"{message}body, position, decoder"
    )


def test_what_all_environments_rests_on_is_part_of_the_claim():
    for kind in KINDS:
        refuted(
            honest(kind)._replace(scope="all e in the universe"),
            KINDS[kind][0],
            "scope does not follow",
        )
        refuted(
            honest(kind)._replace(scope=""), KINDS[kind][0], "scope does not follow"
        )
    fewer = NETWORK._replace(operators=Polytope(POLYTOPE.vertices[:2]))
    refuted(honest("separate"), fewer, "scope does not follow")


def test_kappa_is_one_without_a_metric_and_proved_with_one():
    for kappa in (0.0, 0.5, 1.0001, 4.0):
        refuted(
            consistent(honest("joint")._replace(kappa=kappa)),
            NETWORK,
            "kappa does not follow",
        )
    claims, weights = honest("metric"), KINDS["metric"][0]
    for kappa in (0.0, 0.5, 1.0, 4.0, 8.99):
        refuted(
            consistent(claims._replace(kappa=kappa)), weights, "rho does not follow"
        )
    refuted(claims._replace(kappa=16.0), weights, "alpha_separate does not follow")


def test_a_metric_of_condition_one_is_one():
    weights = KINDS["metric"][0]._replace(operators=POLYTOPE)
    claims = _proofs.prove(weights, BOX, joint=False, metric=np.eye(3))
    require_claims(claims, weights, BOX)
    require_claims(consistent(claims._replace(kappa=1.5)), weights, BOX)


def test_a_metric_holds_only_without_transport_and_without_a_joint_claim():
    claims, weights = honest("metric"), KINDS["metric"][0]
    for transport in ("rotation", "reflection", "identical", ""):
        refuted(
            claims,
            weights._replace(declared=Declared("tanh", transport, 2)),
            "alpha_joint does not follow",
        )
    joint = consistent(claims._replace(alpha_joint=0.9))
    refuted(
        witness(joint, joint=honest("joint").witnesses["joint"]),
        weights,
        "alpha_joint does not follow",
    )
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
    refuted(
        honest(kind), KINDS[kind][0], "env_box must be a lower and an upper corner", box
    )


def test_a_box_of_a_point_is_one_and_a_box_of_other_environments_is_none():
    require_claims(honest("joint"), NETWORK, [[0.1, 0.1], [0.1, 0.1]])
    require_claims(
        honest("joint"), NETWORK, [[0.1], [0.2]]
    )  # the hull of vertices holds for any environment
    for box in ([[0.1], [0.2]], [[0.1] * 3, [0.2] * 3]):
        message = f"env_box has {len(box[0])} entries, the operators take 2"
        refuted(honest("hypernetwork"), KINDS["hypernetwork"][0], message, box)


@pytest.mark.parametrize("kind", ["hypernetwork", "bare hypernetwork"])
def test_the_joint_bound_of_a_box_can_be_claimed_to_the_last_bit(kind):
    weights, claims = KINDS[kind][0], honest(kind)
    multipliers = _claims._arrays(claims.witnesses["joint"])[0]
    upper = _claims.joint_bound_over_box(weights, BOX, multipliers).upper
    require_claims(consistent(claims._replace(alpha_joint=upper)), weights, BOX)
    smaller = float(np.nextafter(upper, 0.0))
    refuted(
        consistent(claims._replace(alpha_joint=smaller)),
        weights,
        "alpha_joint does not follow",
    )


def test_a_larger_box_of_environments_needs_another_proof():
    refuted(
        honest("hypernetwork"),
        KINDS["hypernetwork"][0],
        "does not follow",
        [[-3.0, -3.0], [3.0, 3.0]],
    )
