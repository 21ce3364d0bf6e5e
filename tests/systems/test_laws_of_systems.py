"""Steady states and laws: closed forms, one metric, and reasons where there is none."""

from itertools import product

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loops import FASTEST, MASS, WIND, frame, loop, mass, pushed, steady, tracked

from sfkd_jax.systems import (
    ClosedLoop,
    NoLaw,
    Tracked,
    _derivation,
    best_law,
    derive_law,
    regulation,
    steady_states,
)
from sfkd_jax.systems._runs import tried

DWELL = (1.0, 4.0)


def slopes_at(of, state, control, place):
    """[A B] of a step at a place (ρ, e)."""
    count = len(of.frame.input_names)

    def step(state, control):
        return of.step(state, control, place[:count], place[count:])

    return jax.jacfwd(step, (0, 1))(state, control)


def places_inside(law, count, key):
    """Places of a table, its corners first."""
    corners = jnp.asarray([*product(*zip(law.low, law.high, strict=True))])
    drawn = jax.random.uniform(
        key, (count, len(law.low)), minval=law.low, maxval=law.high
    )
    return jnp.concatenate([corners, drawn])


def closed_loops(of, law, places):
    """A − B K at these places."""

    def closed(place):
        inputs, env = jnp.split(place, [len(of.frame.input_names)])
        at = law.at(inputs, env)
        A, B = slopes_at(of, at.state, at.control, place)
        return A - B @ at.gain

    return np.asarray(jax.jit(jax.vmap(closed))(places), np.float64)


def contracts_in_one_metric(matrices, rate):
    """Whether some P makes all of these matrices contract at this rate."""
    size = matrices.shape[1]
    # Units in which the states are of the same size.
    scales = np.sqrt(np.diag(sum(M @ M.T for M in matrices)))
    P = cp.Variable((size, size), symmetric=True)
    scaled = matrices * scales / scales[:, None]
    conditions = [P >> np.eye(size)]
    conditions += [rate**2 * P - M.T @ P @ M >> 0 for M in scaled]
    problem = cp.Problem(cp.Minimize(cp.trace(P)), conditions)
    try:
        problem.solve(solver=cp.CLARABEL)
    except cp.SolverError:
        return False
    return problem.status == cp.OPTIMAL


def test_the_steady_control_of_a_mass_is_that_of_the_closed_form(key):
    law = loop().law
    places = places_inside(law, 20, key)
    for acceleration, m, wind in np.asarray(places):
        at = law.at(jnp.asarray([acceleration]), jnp.asarray([m, wind]))
        np.testing.assert_allclose(at.state, 0.0, atol=1e-6)
        # Linear interpolation of a product is not exact between the points.
        between = 0.1 * FASTEST * 0.25
        expected = m * acceleration - wind
        np.testing.assert_allclose(at.control, [expected], atol=between)
    for index, (acceleration, m, wind) in enumerate(
        product(
            *np.linspace((-FASTEST, MASS[0], WIND[0]), (FASTEST, MASS[1], WIND[1]), 3).T
        )
    ):
        expected = m * acceleration - wind
        np.testing.assert_allclose(steady().controls[index], [expected], atol=1e-9)


def test_a_steady_state_is_a_fixed_point_at_random_places(key):
    of = Tracked(
        mass(lambda x, u, e: pushed(x, u - 0.8 * x[1] - x[1] ** 3, e)),
        frame(ranges={"v": (-1.0, 1.0)}),
    )
    table = steady_states(of, points=5)
    law = derive_law(of, table, rate=0.9)
    for place in places_inside(law, 20, key)[-20:]:
        inputs, env = place[:2], place[2:]
        at = law.at(inputs, env)
        after = of.step(at.state, at.control, inputs, env)
        np.testing.assert_allclose(after, at.state, atol=0.03)
        exact = env[0] * inputs[0] + 0.8 * inputs[1] + inputs[1] ** 3 - env[1]
        np.testing.assert_allclose(at.control, [exact], atol=0.25)


def test_a_step_of_the_law_contracts_in_one_metric_at_all_corners(key):
    of = tracked()
    for rate in (0.8, 0.9):
        law = derive_law(of, steady(), rate=rate)
        matrices = closed_loops(of, law, places_inside(law, 50, key))
        assert contracts_in_one_metric(matrices[:8], rate + 1e-3)
        assert contracts_in_one_metric(matrices, rate + 5e-3)
        largest = np.abs(np.linalg.eigvals(matrices)).max(axis=1)
        assert largest.max() <= rate + 1e-3


def test_a_faster_law_costs_larger_gains():
    norms = [
        float(jnp.linalg.norm(derive_law(tracked(), steady(), rate=rate).gain))
        for rate in (0.75, 0.85, 0.95)
    ]
    assert norms[0] > 1.3 * norms[1] > 1.3 * norms[2]


def shared(lowest):
    """A mass on which only a share e of the control acts."""

    def step(state, control, env):
        return pushed(state, control * env[0], jnp.asarray([1.0, 0.0]))

    tables = {"environment": {"share": (lowest, 1.0)}, "controls": {"u": (-60.0, 60.0)}}
    return Tracked(mass(step, **tables), frame())


def test_a_law_contracts_between_the_corners_too(key):
    """The gains are about 1 / e at the ends, and between them far larger than that."""
    of = shared(0.1)
    law = derive_law(of, steady_states(of, points=5), rate=0.7)
    matrices = closed_loops(of, law, places_inside(law, 100, key))
    assert np.abs(np.linalg.eigvals(matrices)).max() < 0.8
    of = shared(0.04)
    with pytest.raises(NoLaw, match=r"no gains contract x, v at a rate of 0.7"):
        derive_law(of, steady_states(of, points=5), rate=0.7)


def test_the_best_law_does_not_saturate(key, monkeypatch):
    law, rate = best_law(tracked(), steady(), key, dwell=DWELL)
    assert rate <= 0.86
    matrices = closed_loops(tracked(), law, places_inside(law, 20, key))
    assert np.abs(np.linalg.eigvals(matrices)).max() <= rate + 1e-3
    monkeypatch.setattr(_derivation, "SATURATED", -1.0)
    monkeypatch.setattr(_derivation, "RATES", (0.8, 0.9))
    with pytest.raises(NoLaw, match=r"saturation: at a rate of 0.9 a control is at"):
        best_law(tracked(), steady(), key, dwell=DWELL)


def test_the_best_law_has_the_smallest_errors_of_all(key, monkeypatch):
    # A fast law answers to the noise of these sensors.
    noisy = Tracked(mass(states={"x [m]": 0.1, "v [m/s]": 0.1}), frame())
    table = steady_states(noisy, points=3)
    rates = (0.75, 0.9, 0.97)
    trials = {
        rate: tried(
            ClosedLoop(noisy, derive_law(noisy, table, rate=rate)),
            key,
            steps=300,
            dwell=DWELL,
        )
        for rate in rates
    }
    assert max(trial.saturated for trial in trials.values()) <= 0.01
    monkeypatch.setattr(_derivation, "RATES", rates)
    _, rate = best_law(noisy, table, key, dwell=DWELL)
    assert rate == min(rates, key=lambda rate: trials[rate].error)
    assert rate > rates[0]


def test_a_reference_that_asks_for_too_much_is_refused_where_it_does():
    weak = Tracked(mass(controls={"force [N]": (-1.5, 1.5)}), frame())
    with pytest.raises(
        NoLaw, match=r"saturation: at 2 of 27 places.*rate of v -1, "
    ) as it:
        steady_states(weak, points=3)
    assert "mass [kg] 1.2, wind [N] 0.5: force [N] -1.7 in [-1.5, 1.5]" in str(it.value)


def test_no_steady_state_is_said_with_its_place():
    def step(state, control, env):
        # The mass is pushed with at most 1 N, whatever the control is.
        return pushed(state, jnp.tanh(control), env)

    of = Tracked(mass(step), frame())
    with pytest.raises(
        NoLaw, match=r"with x held there is no steady state at .* places"
    ) as it:
        steady_states(of, points=3)
    assert "rate of v" in str(it.value)
    assert "mass" in str(it.value)


def test_a_state_that_no_control_reaches_is_named():
    def step(state, control, env):
        return jnp.append(pushed(state[:2], control, env), 1.05 * state[2])

    of = Tracked(mass(step, states={"x": 0.0, "v": 0.0, "drift": 0.001}), frame())
    with pytest.raises(NoLaw, match=r"no control acts on drift"):
        derive_law(of, steady_states(of, points=3), rate=0.9)


def test_a_set_point_is_reached_from_every_place_of_its_range():
    def step(state, control, env):
        return pushed(state, control - 2.0 * jnp.sin(state[0]), env)

    rests = regulation(
        {"position": ("x",)}, set_points={"x": (-0.5, 0.5)}, rates={"x": 0.5}
    )
    of = Tracked(mass(step), rests)
    law = derive_law(of, steady_states(of, points=5), rate=0.9)
    at = law.at(jnp.asarray([0.0, 0.25]), jnp.asarray([1.0, 0.0]))
    np.testing.assert_allclose(at.control, [2.0 * np.sin(0.25)], atol=1e-5)
    error = jnp.asarray([-0.5, 0.0])
    for _ in range(60):
        control = at.feedback(error)
        error = of.step(
            error, control, jnp.asarray([0.0, 0.25]), jnp.asarray([1.0, 0.0])
        )
    np.testing.assert_allclose(error, 0.0, atol=5e-3)
