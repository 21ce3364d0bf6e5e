"""The paper's program: the answer of a solver is believed only as far as it is proved."""

import inspect
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from networks import NETWORK, TURNED, rotation

from sfkd_jax.certification import CertificationRefused, _metrics, check_metric
from sfkd_jax.certification._claims import rows
from sfkd_jax.certification._metric_claims import ROTATES, require_lyapunov
from sfkd_jax.certification._metrics import prove_lyapunov, solve_metric

SIZE = 6


def skewed(seed=0, rate=0.8, condition=20.0):
    """Operators that contract at `rate` in the norm of a P of this condition, but not
    in the 2-norm.
    """
    grading = np.diag(np.sqrt(np.geomspace(1.0, condition, SIZE)))
    root = rotation(SIZE, seed) @ grading @ rotation(SIZE, seed + 1)
    return [
        np.linalg.solve(root, rate * rotation(SIZE, k) @ root) for k in range(2, 6)
    ], root.T @ root


def test_a_common_lyapunov_matrix_is_accepted_at_its_rate_and_condition_only():
    operators, metric = skewed()
    assert max(np.linalg.norm(a, 2) for a in operators) > 1
    condition, more, less = np.linalg.cond(metric), 1 + 1e-6, 1 - 1e-6
    for scale in (1e-3, 1.0, 1e6):
        scaled = scale * metric
        assert check_metric(scaled, operators, 0.8 * more, condition * more)
        assert not check_metric(scaled, operators, 0.8 * less, condition * more)
        assert not check_metric(scaled, operators, 0.8 * more, condition * less)


def test_the_solver_finds_the_least_condition():
    operators, metric = skewed(condition=5.0)
    solution = solve_metric(operators, 0.8 * (1 + 1e-4))
    assert check_metric(
        solution, operators, 0.8 * (1 + 2e-4), np.linalg.cond(metric) * 1.01
    )
    looser = solve_metric(operators, 0.9)
    assert np.linalg.cond(looser) < np.linalg.cond(solution)


def test_operators_that_are_stable_one_by_one_have_no_common_lyapunov_matrix():
    switched = np.zeros((2, 3, 3))
    switched[0, 0, 1] = switched[1, 1, 0] = 2.0
    weights = TURNED._replace(operators=TURNED.operators._replace(vertices=switched))
    with pytest.raises(CertificationRefused, match="no common Lyapunov matrix"):
        prove_lyapunov(weights)


def test_a_step_that_expands_has_no_lyapunov_matrix_though_its_operators_have():
    *hidden, last = TURNED.residual
    louder = TURNED._replace(residual=(*hidden, 1e3 * last))
    with pytest.raises(CertificationRefused):
        prove_lyapunov(louder)


@pytest.fixture(scope="module")
def claim():
    return prove_lyapunov(TURNED)


def require(claim, weights=TURNED, refused=None):
    """As of a proof that claims it, also where a test run checks types."""
    proof = SimpleNamespace(lyapunov=claim, lyapunov_refused=refused)
    inspect.unwrap(require_lyapunov)(proof, weights)


def test_the_claim_is_proved_and_better_than_the_norm(claim):
    require(claim)
    norm = max(np.linalg.norm(vertex, 2) for vertex in TURNED.operators.vertices)
    assert 0.5 < claim.rho < norm
    assert 1.0 < claim.condition < 9.0
    assert claim.c_1 == claim.c_2 == np.sqrt(claim.condition)
    assert claim.rho < claim.alpha < 1.0


def test_errors_under_bounded_disturbances_keep_the_bound_of_the_theorem(claim):
    random, d_bar, steps = np.random.default_rng(0), 0.1, 60
    vertices, (first, last) = TURNED.operators.vertices, TURNED.residual
    c = np.sqrt(claim.condition)
    for episode in range(50):
        z, other = random.standard_normal((2, 3)) * 10.0 ** random.uniform(-2, 1)
        start = np.linalg.norm(z - other)
        for k in range(1, steps + 1):
            A, offset = vertices[random.integers(3)], random.standard_normal(4)
            z, other = (A @ x + last @ np.tanh(first @ x + offset) for x in (z, other))
            push = random.standard_normal(3) if episode % 2 else z - other + 1e-9
            z = z + d_bar * push / np.linalg.norm(push)
            bound = c * claim.alpha**k * start + c * d_bar / (1 - claim.alpha)
            assert np.linalg.norm(z - other) <= bound * (1 + 1e-9)


LIES = {
    "nothing": lambda P: None,
    "NaN": lambda P: np.full_like(P, np.nan),
    "infinite": lambda P: np.inf * np.ones_like(P),
    "of another size": lambda P: np.eye(2),
    "negative": lambda P: -P,
    "singular": lambda P: np.diag([1.0, 1.0, 0.0]),
    "indefinite": lambda P: P - 1.01 * np.linalg.eigvalsh(P)[0] * np.eye(3),
    "of another system": lambda P: np.diag([1e6, 1.0, 1e-6]),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_broken_answer_is_refused_whatever_the_solver_calls_it(lie, monkeypatch):
    monkeypatch.setattr(
        _metrics, "solve_metric", lambda *_, lied=LIES[lie]: lied(TRUE_METRIC)
    )
    with pytest.raises(CertificationRefused, match="that the core accepts"):
        prove_lyapunov(TURNED)


TRUE_METRIC = np.diag([1.0, 4.0, 9.0])


@pytest.mark.parametrize("scale", [1e-8, 1e8])
@pytest.mark.parametrize("moved", [0.0, 1e-2])
def test_an_answer_slightly_off_or_of_any_scale_gets_the_constants_that_it_has(
    scale, moved, monkeypatch
):
    """Its own rate and condition are recomputed; what the solver says is not asked."""
    answer = scale * (TRUE_METRIC + moved * (np.ones((3, 3)) - np.eye(3)))
    monkeypatch.setattr(_metrics, "solve_metric", lambda *_: answer)
    found = prove_lyapunov(TURNED)
    assert found.condition >= np.linalg.cond(answer) * (1 - 1e-12)
    root = np.linalg.cholesky(answer).T
    exact = max(
        np.linalg.norm(root @ vertex @ np.linalg.inv(root), 2)
        for vertex in TURNED.operators.vertices
    )
    assert exact <= found.rho <= exact * (1 + 1e-5)
    require(found)


@np.errstate(over="ignore")
def scaled(claim, scale):
    return replace(claim, metric=rows(scale * np.asarray(claim.metric)))


FORGED = {
    "a denormal P": lambda c: scaled(c, 1e-312),
    "P of overflow": lambda c: scaled(c, 1e308),
    "P NaN": lambda c: scaled(c, np.nan),
    "P smaller": lambda c: replace(c, metric=rows(np.eye(2))),
    "P of another unit": lambda c: scaled(c, 2.0),
    "no multipliers": lambda c: replace(c, joint=()),
    "multipliers of no use": lambda c: replace(c, joint=(((1e-9,) * 4,),) * 3),
    "ρ smaller": lambda c: replace(c, rho=0.99 * c.rho),
    "κ smaller": lambda c: replace(c, condition=0.99 * c.condition),
    "α smaller": lambda c: replace(c, alpha=0.99 * c.alpha),
    "c_1 smaller": lambda c: replace(c, c_1=0.99 * c.c_1),
    "c_2 smaller": lambda c: replace(c, c_2=0.99 * c.c_2),
}


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_claim_is_refused(name, claim):
    with pytest.raises((CertificationRefused, ValueError)):
        require(FORGED[name](claim))


def test_a_claim_is_about_these_operators_and_latents_that_keep_their_metric(claim):
    longer = np.array(TURNED.operators.vertices)
    longer[1] *= 1.001
    other = TURNED._replace(operators=TURNED.operators._replace(vertices=longer))
    with pytest.raises(CertificationRefused, match="does not follow from its witness"):
        require(claim, other)
    turning = TURNED._replace(declared=NETWORK.declared)
    with pytest.raises(CertificationRefused, match="not a claim about these operators"):
        require(claim, turning)
    with pytest.raises(CertificationRefused, match="the transport keeps"):
        prove_lyapunov(turning)
    require(None, turning, ROTATES)
    require(None, refused="any reason")
    with pytest.raises(CertificationRefused, match="is not the reason"):
        require(None, turning, "any reason")
    with pytest.raises(CertificationRefused, match="claimed and refused"):
        require(claim, refused="any reason")


def test_without_a_solver_the_reason_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(CertificationRefused, match=r"^[^\n]*cvxpy[^\n]*$"):
        prove_lyapunov(TURNED)


def test_a_residual_of_a_single_layer_and_none_have_claims_too():
    for residual in ((0.1 * rotation(3, 3),), ()):
        weights = TURNED._replace(residual=residual, residual_multipliers=())
        found = prove_lyapunov(weights)
        require(found, weights)
        assert found.alpha <= 1.0
