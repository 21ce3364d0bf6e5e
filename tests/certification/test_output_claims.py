"""Metrics of outputs of tiny networks: honest ones hold, forged ones are refused."""

import json

import numpy as np
import pytest
from networks import NETWORK, ROOT, TURNED

from sfkd_jax.certification import OutputMetric, _claims
from sfkd_jax.certification._claims import Refuted, readouts
from sfkd_jax.certification._metrics import _accepted
from sfkd_jax.types import Declared, Polytope

WEIGHTS = TURNED
VERTICES = TURNED.operators.vertices
JOINT = [[np.full(4, 1.2 + 0.1 * k)] for k in range(3)]
HONEST = {
    name: _accepted(WEIGHTS, readouts(WEIGHTS)[name], ROOT @ ROOT, JOINT)
    for name in _claims.OUTPUTS
}
"""Found before anything is changed, so that a changed check cannot agree with a changed
search.
"""
every_output = pytest.mark.parametrize("name", HONEST)


def require(name, claim, weights=WEIGHTS):
    """Past the types, which test runs check."""
    check = _claims.require_output_metric
    getattr(check, "__wrapped__", check)(name, claim, weights)


def refuted(name, claim, message, weights=WEIGHTS):
    with pytest.raises(Refuted) as reason:
        require(name, claim, weights)
    assert str(reason.value).startswith(f"outputs.{name}{message}")


@every_output
def test_what_was_found_is_proved_also_from_json(name):
    claim = HONEST[name]
    require(name, claim)
    again = OutputMetric.from_document(json.loads(json.dumps(claim.document())))
    require(name, again)
    assert again.document() == claim.document()
    assert 0.5 < claim.alpha < 1.0


@every_output
def test_the_constants_are_those_of_the_matrices(name):
    """|c|_{P⁻¹} of the row, and a rate above the longest vertex in the metric and below
    the sum with the residual.
    """
    claim, row = HONEST[name], readouts(WEIGHTS)[name][0]
    assert claim.lipschitz == pytest.approx(
        np.sqrt(row @ np.linalg.solve(ROOT @ ROOT, row)), rel=1e-5
    )
    require(name, claim._replace(lipschitz=1.001 * claim.lipschitz))
    require(name, claim._replace(alpha=1.001 * claim.alpha))
    for share in (0.5, 0.99, 1 - 4e-6):
        refuted(
            name,
            claim._replace(lipschitz=share * claim.lipschitz),
            ".lipschitz does not follow",
        )
        refuted(
            name, claim._replace(alpha=share * claim.alpha), ".alpha does not follow"
        )


@every_output
@pytest.mark.parametrize("constant", ["alpha", "lipschitz"])
@pytest.mark.parametrize(
    "value", [0.0, -0.5, -5e-324, np.inf, np.nan, 1, "0.5", None, True]
)
def test_what_is_no_bound_is_none(name, constant, value):
    refuted(
        name,
        HONEST[name]._replace(**{constant: value}),
        f".{constant} is not a bound: {value!r}",
    )


@every_output
@pytest.mark.parametrize("alpha", [1.0, 1.0 + 1e-12, 1.5, 7.0])
def test_a_rate_that_is_proved_and_no_contraction_is_refused(name, alpha):
    refuted(name, HONEST[name]._replace(alpha=alpha), ".alpha does not follow")


@pytest.mark.parametrize("vertex", range(3))
def test_every_vertex_counts(vertex):
    claim, longer = HONEST["position"], np.array(VERTICES)
    longer[vertex] *= 0.9 / (0.3, 0.5, 0.4)[vertex]
    refuted(
        "position",
        claim,
        ".alpha does not follow",
        WEIGHTS._replace(operators=Polytope(longer)),
    )
    for factor in (0.0, -1.0, 0.01, np.nan):
        joint = [
            [factor * part for part in each] if k == vertex else each
            for k, each in enumerate(claim.joint)
        ]
        refuted("position", claim._replace(joint=joint), ".alpha does not follow")


def test_a_rate_in_one_metric_is_none_in_another():
    claim = HONEST["position"]
    refuted("position", claim._replace(metric=np.eye(3)), ".alpha does not follow")
    for metric in (
        -claim.metric,
        0 * claim.metric,
        np.diag([1.0, 4.0, np.nan]),
        claim.metric + np.triu(ROOT + 1, 1),
    ):
        refuted("position", claim._replace(metric=metric), ".alpha does not follow")


@pytest.mark.parametrize("size", [2, 4])
def test_a_witness_of_another_size_is_named(size):
    claim = HONEST["position"]
    refuted(
        "position", claim._replace(metric=np.eye(size)), ".witness is of another size"
    )
    refuted(
        "position",
        claim._replace(joint=(2 * claim.joint)[:size]),
        ".witness is of another size",
    )


def test_what_may_have_a_metric_is_a_polytope_without_transport_and_decoder():
    claim = HONEST["position"]
    for transport in ("rotation", "identical", "", "identity "):
        refuted(
            "position",
            claim,
            ": this model has no",
            WEIGHTS._replace(declared=Declared("tanh", transport, 2)),
        )
    refuted(
        "position",
        claim,
        ": this model has no",
        WEIGHTS._replace(decoder=NETWORK.decoder),
    )
    refuted("body", claim, ": this model has no")
