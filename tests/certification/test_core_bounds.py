"""Every term of the core's rounding bounds, made visible by large rounding units.

`test_core.py` checks with exact arithmetic that the bounds suffice.
"""

import numpy as np
import pytest

from sfkd_jax.certification import _core

UNIT, TINY, MARGIN = 2.0**-12, 2.0**-20, 0.25
norm = np.linalg.norm


@pytest.fixture
def coarse(monkeypatch):
    """Arithmetic as coarse as this would lose so much."""
    for name, value in (("UNIT", UNIT), ("TINY", TINY), ("MARGIN", MARGIN)):
        monkeypatch.setattr(_core, name, value)


def test_units_are_those_of_float64():
    assert (_core.UNIT, _core.TINY, _core.SMALLEST) == (
        2.0**-53,
        2.0**-1022,
        2.0**-1074,
    )
    assert 1e-7 < _core.MARGIN < 1e-5


def test_nothing_is_warned_of(recwarn):
    """Overflow and NaN are refused by comparisons."""
    assert not _core.is_positive_definite(np.full((2, 2), 1e308), error=1e308)
    assert not _core.is_positive_definite(1e-300 * np.eye(2), error=1e300)
    assert not _core.check_witness(
        [np.full((2, 2), 1e200)] * 2, [np.full(2, 1e200)], 1e200
    )
    assert not _core.check_witness(
        [np.full((2, 2), np.inf)] * 2, [np.zeros(2) + 1], 1.0
    )
    assert len(recwarn) == 0


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 4), (4, 2, 1)])
def test_a_product_loses_so_much(coarse, shape):
    rows, inner, columns = shape
    random = np.random.default_rng(0)
    left, right = (
        random.standard_normal((rows, inner)),
        random.standard_normal((inner, columns)),
    )
    value, error = _core.product(left.astype(np.float32), right)
    left = left.astype(np.float32).astype(np.float64)
    np.testing.assert_array_equal(value, left @ right)
    expected = (inner + 2) * UNIT * norm(left) * norm(right) * (
        1 + MARGIN
    ) + rows * inner * columns * TINY
    assert error == pytest.approx(expected, rel=1e-12)


NETWORKS = {
    "three layers": ([(3, 2), (4, 3), (2, 4)], False),
    "two layers and A": ([(4, 3), (3, 4)], True),
    "one layer and A": ([(3, 3)], True),
    "one layer": ([(2, 3)], False),
    "A": ([], True),
}


@pytest.mark.parametrize("metric", [False, True])
@pytest.mark.parametrize("kind", NETWORKS)
def test_a_witness_matrix_is_what_it_should_be_and_loses_so_much(coarse, kind, metric):
    shapes, linear = NETWORKS[kind]
    random = np.random.default_rng(1)
    weights = [random.standard_normal(shape) for shape in shapes]
    inputs, outputs = (shapes[0][1], shapes[-1][0]) if shapes else (3, 3)
    if metric and inputs != outputs:
        return
    given = random.standard_normal((outputs, inputs)) if linear else None
    multipliers = [random.uniform(0.5, 2.0, shape[0]) for shape in shapes[:-1]]
    half = random.standard_normal((inputs, inputs))
    form = half.T @ half if metric else None
    actual, error = _core.witness_matrix(weights, multipliers, 1.7, given, form)
    start = 1.7**2 * (np.eye(inputs) if form is None else form)
    edges = np.cumsum([0, inputs, *(len(part) for part in multipliers)])
    expected, output = np.zeros((edges[-1], edges[-1])), np.zeros((outputs, edges[-1]))
    expected[:inputs, :inputs], lost = start, 0.0
    for k, part in enumerate(multipliers):
        here, before = slice(edges[k + 1], edges[k + 2]), slice(edges[k], edges[k + 1])
        coupling = np.diag(part) @ weights[k]
        expected[here, before] -= coupling
        expected[before, here] -= coupling.T
        expected[here, here] += 2 * np.diag(part)
        lost += 4 * UNIT * norm(coupling)
    if weights:
        output[:, len(output.T) - weights[-1].shape[1] :] += weights[-1]
    if linear:
        output[:, :inputs] += given
    weighted, before = (output, 0.0) if form is None else _core.product(form, output)
    squared, rounding = _core.product(output.T, weighted)
    expected -= 0.5 * (squared + squared.T)
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(actual, actual.T)
    lost += (
        norm(output) * 2 * before
        + norm(output) * 4 * UNIT * norm(weighted)
        + 2 * rounding
    )
    lost += (
        4 * UNIT * norm(squared)
        + 4 * UNIT * norm(start)
        + 4 * UNIT * norm(expected)
        + expected.size * TINY
    )
    assert error == pytest.approx(lost, rel=1e-12)


VERTICES = [0.5 * np.eye(2), np.diag([0.3, -0.4]), np.asarray([[0.0, 0.5], [0.0, 0.0]])]
LAYERS = [0.2 * np.eye(2), 0.5 * np.eye(2)]


def test_every_vertex_is_checked_with_its_own_multipliers():
    """|A| + |W_2||W_1| = 0.6 at most; λ = 0.25 proves 0.8, and λ < |W_2|²/2 proves
    nothing.
    """
    good, bad = [np.full(2, 0.25)], [np.full(2, 0.12)]
    assert _core.check_vertices(LAYERS, [good] * 3, 0.8, VERTICES)
    for k in range(3):
        assert not _core.check_vertices(
            LAYERS, [*[good] * k, bad, *[good] * (2 - k)], 0.8, VERTICES
        )
        longer = [vertex * (2 if j == k else 1) for j, vertex in enumerate(VERTICES)]
        assert not _core.check_vertices(LAYERS, [good] * 3, 0.8, longer)
    assert not _core.check_vertices(LAYERS, [good] * 3, 0.5, VERTICES)


def test_there_are_as_many_witnesses_as_vertices_and_at_least_one():
    good = [np.full(2, 0.25)]
    assert not _core.check_vertices(LAYERS, [], 0.8, [])
    for count in (0, 1, 2, 4):
        assert not _core.check_vertices(LAYERS, [good] * count, 0.8, VERTICES)
        assert not _core.check_vertices((), [()] * count, 0.8, VERTICES)
    for few in ([], [*good, *good]):
        for k in range(3):
            assert not _core.check_vertices(
                LAYERS, [*[good] * k, few, *[good] * (2 - k)], 0.8, VERTICES
            )
