"""Metrics of outputs of tiny networks: honest ones hold, forged ones are refused."""

import inspect
import json

import numpy as np
import pytest
from networks import NETWORK, ROOT, TURNED

from sfkd_jax.certification import CertificationRefused, OutputMetric
from sfkd_jax.certification._claims import OUTPUTS, readouts, require_output_metric
from sfkd_jax.certification._metrics import accepted_metric
from sfkd_jax.types import Declared, Polytope

JOINT = [[np.full(4, 1.2 + 0.1 * k)] for k in range(3)]
HONEST = {
    name: accepted_metric(TURNED, readouts(TURNED)[name], ROOT @ ROOT, JOINT)
    for name in OUTPUTS
}
every_output = pytest.mark.parametrize("name", HONEST)
require = inspect.unwrap(require_output_metric)
"""Past the types, which test runs check."""


def refuted(name, claim, message, weights=TURNED):
    with pytest.raises(CertificationRefused) as reason:
        require(name, claim, weights)
    assert str(reason.value).startswith(f"outputs.{name}{message}")


@every_output
def test_what_was_found_is_proved_also_from_json(name):
    claim = HONEST[name]
    again = OutputMetric.from_document(json.loads(json.dumps(claim.document())))
    require(name, again, TURNED)
    assert again.document() == claim.document()
    assert 0.5 < claim.alpha < 1.0


@every_output
def test_the_constants_are_those_of_the_matrices(name):
    """|c|_{P⁻¹} of the row, and nothing smaller than what was found."""
    claim, row = HONEST[name], readouts(TURNED)[name][0]
    gain = np.sqrt(row @ np.linalg.solve(ROOT @ ROOT, row))
    assert claim.lipschitz == pytest.approx(gain, rel=1e-5)
    for constant in ("alpha", "lipschitz"):
        value = getattr(claim, constant)
        require(name, claim._replace(**{constant: 1.001 * value}), TURNED)
        for share in (0.5, 1 - 4e-6):
            smaller = claim._replace(**{constant: share * value})
            refuted(name, smaller, f".{constant} does not follow")


@pytest.mark.parametrize("constant", ["alpha", "lipschitz"])
@pytest.mark.parametrize("value", [0.0, -5e-324, np.inf, np.nan, 1, "0.5", None, True])
def test_what_is_no_bound_is_none(constant, value):
    claim = HONEST["position"]._replace(**{constant: value})
    refuted("position", claim, f".{constant} is not a bound: {value!r}")


@pytest.mark.parametrize("alpha", [1.0, 1.0 + 1e-12, 7.0])
def test_a_rate_that_is_proved_and_no_contraction_is_refused(alpha):
    claim = HONEST["position"]._replace(alpha=alpha)
    refuted("position", claim, ".alpha does not follow")


@pytest.mark.parametrize("vertex", range(3))
def test_every_vertex_counts(vertex):
    claim, longer = HONEST["position"], np.array(TURNED.operators.vertices)
    longer[vertex] *= 0.9 / (0.3, 0.5, 0.4)[vertex]
    changed = TURNED._replace(operators=Polytope(longer))
    refuted("position", claim, ".alpha does not follow", changed)
    for factor in (0.0, -1.0, 0.01, np.nan):
        joint = [*claim.joint]
        joint[vertex] = [factor * part for part in joint[vertex]]
        refuted("position", claim._replace(joint=joint), ".alpha does not follow")


def test_a_rate_in_one_metric_is_none_in_another():
    claim = HONEST["position"]
    for metric in (
        np.eye(3),
        -claim.metric,
        0 * claim.metric,
        np.diag([1.0, 4.0, np.nan]),
        claim.metric + np.triu(ROOT + 1, 1),
    ):
        refuted("position", claim._replace(metric=metric), ".alpha does not follow")


@pytest.mark.parametrize("size", [2, 4])
def test_a_witness_of_another_size_is_refused(size):
    claim = HONEST["position"]
    other = claim._replace(metric=np.eye(size))
    refuted("position", other, ".witness is of another size")
    other = claim._replace(joint=(2 * claim.joint)[:size])
    refuted("position", other, ".alpha does not follow")


def test_what_may_have_a_metric_is_a_polytope_without_transport_and_decoder():
    claim = HONEST["position"]
    for transport in ("rotation", "identity "):
        other = TURNED._replace(declared=Declared("tanh", transport, 2))
        refuted("position", claim, ": this model has no", other)
    other = TURNED._replace(decoder=NETWORK.decoder)
    refuted("position", claim, ": this model has no", other)
    refuted("body", claim, ": this model has no")
