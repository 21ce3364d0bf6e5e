"""Claims about tiny networks: honest ones hold, forged ones are refused."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from networks import (
    FIRST,
    KINDS,
    LAST,
    NETWORK,
    POLYTOPE,
    consistent,
    frame_of,
    honest,
)

from sfkd_jax.certificate import Claims
from sfkd_jax.certificate._reading import read_as
from sfkd_jax.certification import CertificationRefused
from sfkd_jax.certification._claims import CONSTANTS, require_claims
from sfkd_jax.certification._weights import one_thread
from sfkd_jax.types import Polytope

every_kind = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(autouse=True)
def on_one_thread():
    with one_thread():
        yield


def refuted(claims, weights, named):
    with pytest.raises(CertificationRefused) as reason:
        require_claims(claims, weights, frame_of(weights))
    assert named in str(reason.value)


@every_kind
def test_what_was_proved_holds(kind):
    require_claims(honest(kind), KINDS[kind], frame_of(KINDS[kind]))
    read = read_as(Claims, json.loads(json.dumps(asdict(honest(kind)))))
    assert read == honest(kind)


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
    larger = consistent(replaced(claims, name, 1.001 * value))
    require_claims(larger, weights, frame_of(weights))


@pytest.mark.parametrize("name", ["alpha", "alpha_separate"])
def test_what_is_arithmetic_must_be_exact(name):
    value = getattr(honest(), name)
    for other in (np.nextafter(value, 0.0), np.nextafter(value, 1.0)):
        changed = replace(honest(), **{name: float(other)})
        refuted(changed, NETWORK, f"{name} does not follow")


def test_alpha_is_the_smaller_of_both():
    loose = replace(honest(), alpha_joint=2.0)
    refuted(replace(loose, alpha=2.0), NETWORK, "alpha does not follow")
    require_claims(consistent(loose), NETWORK, frame_of(NETWORK))


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


def spoiled(part, factor):
    if isinstance(part, tuple):
        return tuple(spoiled(entry, factor) for entry in part)
    return float(factor * part)


@pytest.mark.parametrize("name", ["residual", "position", "yaw", "decoder", "joint"])
@pytest.mark.parametrize("factor", [0.0, 1e6, np.nan, 1e-320])
def test_a_spoiled_witness_proves_nothing(name, factor):
    witnesses = honest().witnesses
    if name in witnesses.decoders:
        of_output = spoiled(witnesses.decoders[name], factor)
        changed = {"decoders": witnesses.decoders | {name: of_output}}
    else:
        changed = {name: spoiled(getattr(witnesses, name), factor)}
    claims = replace(honest(), witnesses=replace(witnesses, **changed))
    refuted(claims, NETWORK, "does not follow from its witness")


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
