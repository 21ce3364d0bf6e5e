"""Every term of the core's rounding bounds, made visible by large rounding units.

`benchmarks/robustness/mutants.py` runs these tests against mutants of `_core`.
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


@pytest.mark.parametrize(
    ("size", "entry", "error"),
    [(1, 0.5, 0.0), (1, 0.75, 0.1), (2, 0.5, 0.0), (3, 0.75, 0.05)],
)
def test_a_factor_may_be_wrong_by_as_much_as_the_shift_covers(
    coarse, monkeypatch, size, entry, error
):
    """L = sqrt(1 − w) I for M = m I: what is left over is known, and so is what it may
    be at most.
    """
    lost = 4 * size**2 * TINY
    shift = 4 * (size + 2) * UNIT * size * entry + error * (1 + 4 * MARGIN) + 4 * lost
    calls = []

    def factor(shifted, wrong):
        calls.append(shifted)
        return np.sqrt(entry - shift + wrong) * np.eye(size)

    def rest(wrong):
        squared = entry - shift + wrong
        rounding = (size + 2) * UNIT * size * squared * (1 + MARGIN) + size**3 * TINY
        return (
            (abs(wrong) * size**0.5 + rounding) * (1 + MARGIN)
            + error
            + lost
            - shift * (1 - MARGIN)
        )

    low, high = -shift, 0.0
    assert rest(high) < 0 < rest(low)
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if rest(middle) < 0 else (middle, high)
    for wrong, holds in (
        (0.0, True),
        (high * (1 - 1e-6), True),
        (low * (1 + 1e-6), False),
        (-shift, False),
    ):
        monkeypatch.setattr(
            np.linalg, "cholesky", lambda shifted, wrong=wrong: factor(shifted, wrong)
        )
        for scale in (1.0, 2.0**-60, 2.0**90):
            assert (
                _core.is_positive_definite(scale * entry * np.eye(size), scale * error)
                == holds
            )
            np.testing.assert_allclose(
                calls[-1], (entry - shift) * np.eye(size), rtol=1e-12
            )


def test_a_refused_factorisation_is_a_refusal_and_another_failure_is_none(monkeypatch):
    def fails(shifted, reason):
        raise reason

    monkeypatch.setattr(
        np.linalg, "cholesky", lambda shifted: fails(shifted, np.linalg.LinAlgError())
    )
    assert not _core.is_positive_definite(np.eye(2))
    monkeypatch.setattr(
        np.linalg, "cholesky", lambda shifted: fails(shifted, MemoryError())
    )
    with pytest.raises(MemoryError):
        _core.is_positive_definite(np.eye(2))


@pytest.mark.parametrize("error", [-1.0, -5e-324, np.inf, np.nan])
def test_an_error_that_is_none_is_refused_before_anything_is_computed(
    error, monkeypatch
):
    monkeypatch.setattr(np.linalg, "cholesky", lambda shifted: pytest.fail("computed"))
    assert not _core.is_positive_definite(np.eye(2), error)


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


@pytest.mark.parametrize(
    "scale", [1e-310, 1e-200, 1e-140, 1e-139, 1.0, 1e139, 1e141, 1e200, 1e300]
)
def test_a_norm_is_that_of_the_scaled_matrix(scale):
    assert _core.frobenius(
        scale * np.asarray([[3.0, 4.0], [0.0, 12.0]])
    ) == pytest.approx(13.0 * scale, rel=1e-12, abs=0)
    assert _core.frobenius(-scale * np.ones((1, 4))) == pytest.approx(
        2.0 * scale, rel=1e-12, abs=0
    )


def test_of_matrices_that_are_not_finite_no_norm_is():
    assert _core.frobenius(np.asarray([[np.inf, 0.0]])) == np.inf or np.isnan(
        _core.frobenius(np.asarray([[np.inf, 0.0]]))
    )
    assert _core.frobenius(np.zeros((0, 3))) == 0.0


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


def test_a_norm_is_tried_from_the_tightest_to_the_sum_of_entries(monkeypatch):
    tried = []

    def refuse(weights, multipliers, bound, linear):
        tried.append(bound)
        return len(tried) == accepted

    monkeypatch.setattr(_core, "check_witness", refuse)
    monkeypatch.setattr(_core, "MARGIN", MARGIN)
    matrix, slacks = np.diag([3.0, -5.0]), [1e-12, 1e-10, 1e-8, 1e-6, 1e-3, 1.0]
    accepted = 0
    assert _core.norm_upper(matrix) == pytest.approx(8 * (1 + MARGIN), rel=1e-12)
    np.testing.assert_allclose(np.asarray(tried) / 5 - 1, slacks, rtol=1e-3)
    for accepted in range(1, 7):
        tried.clear()
        assert _core.norm_upper(matrix) == tried[-1]
        assert len(tried) == accepted


def test_the_error_of_a_witness_matrix_counts(monkeypatch):
    """Also that of what is positive definite by less."""
    matrix = 0.5 * np.eye(2)
    assert _core.check_witness((), (), 0.6, matrix)
    for error, holds in ((0.1, True), (0.12, False)):  # 0.36 - 0.25 = 0.11 is left
        exact = _core.witness_matrix((), (), 0.6, matrix)[0]
        monkeypatch.setattr(
            _core,
            "witness_matrix",
            lambda *given, exact=exact, error=error: (exact, error),
        )
        assert _core.check_witness((), (), 0.6, matrix) == holds
        monkeypatch.undo()


def test_the_condition_of_a_metric_is_shown_with_its_rounding(coarse, monkeypatch):
    calls = []
    monkeypatch.setattr(_core, "norm_upper", lambda matrix: 4.0)
    monkeypatch.setattr(
        _core, "is_positive_definite", lambda *given: bool(calls.append(given)) or True
    )
    monkeypatch.setattr(_core, "check_vertices", lambda *given: True)
    metric = np.diag([4.0, 3.0, 2.0])
    assert _core.check_metric(metric, [np.eye(3)], 0.5, 2.5)
    ((shifted, error),) = calls
    np.testing.assert_allclose(
        shifted, metric - 4.0 / 2.5 * (1 + 4 * UNIT) * np.eye(3), rtol=1e-13
    )
    assert error == pytest.approx(4 * UNIT * 3 * 4.0, rel=1e-13)
    for condition, largest, holds in (
        (1.0, 4.0, True),
        (1 - 1e-12, 4.0, False),
        (0.0, 4.0, False),
        (np.inf, 4.0, False),
        (np.nan, 4.0, False),
        (2.0, np.inf, False),
        (2.0, np.nan, False),
    ):
        monkeypatch.setattr(
            _core, "norm_upper", lambda matrix, largest=largest: largest
        )
        assert _core.check_metric(metric, [np.eye(3)], 0.5, condition) == holds


def test_every_operator_counts_in_a_metric():
    metric, short = np.diag([1.0, 4.0]), 0.5 * np.eye(2)
    assert _core.check_metric(metric, [short, short], 0.6, 5.0)
    for operators in (
        [2 * short, short],
        [short, 2 * short],
        [short, 2 * short, short],
    ):
        assert not _core.check_metric(metric, operators, 0.6, 5.0)
    assert not _core.check_metric(metric, [short], 0.6, 3.0)


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


def test_a_metric_is_proved_once_for_all_vertices(monkeypatch):
    calls, true = [], _core.is_positive_definite
    monkeypatch.setattr(
        _core,
        "is_positive_definite",
        lambda *given: bool(calls.append(given)) or true(*given),
    )
    assert _core.check_vertices((), [()] * 3, 0.8, VERTICES, np.eye(2))
    assert [len(given) for given in calls] == [1, 2, 2, 2]
    for metric in (-np.eye(2), np.zeros((2, 2)), np.diag([1.0, np.nan])):
        assert not _core.check_vertices(
            (), [()] * 3, 0.8, [0 * vertex for vertex in VERTICES], metric
        )


def test_bounds_are_positive_and_finite_and_multipliers_are_as_many_as_hidden_layers(
    monkeypatch,
):
    monkeypatch.setattr(_core, "is_positive_definite", lambda *given: True)
    monkeypatch.setattr(_core, "witness_matrix", lambda *given: (np.eye(1), 0.0))
    weights, ones = [np.eye(2)] * 3, np.ones(2)
    for count in range(5):
        assert _core.check_witness(weights, [ones] * count, 1.0) == (count == 2)
        assert _core.check_witness([], [ones] * count, 1.0, np.eye(2)) == (count == 0)
        assert _core.check_witness(weights[:1], [ones] * count, 1.0) == (count == 0)
    for bound, holds in (
        (5e-324, True),
        (1.0, True),
        (1e308, True),
        (0.0, False),
        (-1.0, False),
    ):
        assert _core.check_witness(weights, [ones] * 2, bound) == holds
    assert not _core.check_witness(weights, [ones] * 2, np.inf)
    assert not _core.check_witness(weights, [ones] * 2, np.nan)
    for value, holds in ((5e-324, True), (0.0, False), (-1.0, False), (np.nan, False)):
        assert (
            _core.check_witness(weights, [ones, np.asarray([1.0, value])], 1.0) == holds
        )
    monkeypatch.setattr(
        _core, "is_positive_definite", lambda matrix, error=0.0: len(matrix) == 1
    )
    assert _core.check_witness([], [], 1.0, np.eye(2))
    assert not _core.check_witness([], [], 1.0, np.eye(2), metric=np.eye(2))
