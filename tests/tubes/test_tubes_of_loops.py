"""Tubes of a closed loop hold on runs that they have not seen."""

from functools import cache
from itertools import product

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
from loops import DT, LIMIT, MASS, WIND, exact_model, loop

from sfkd_jax.certificate import OutputMetric
from sfkd_jax.systems import random_runs
from sfkd_jax.tubes import measure_tubes
from sfkd_jax.types import BODY

ALPHA = 0.9
SPREAD = jnp.asarray([0.05, 0.1])
DWELL = (1.0, 4.0)
SETTINGS = {"runs": 60, "duration": 4.0, "dwell": DWELL, "level": 0.9}


@cache
def claims():
    """A metric in which the loop itself contracts, at all masses and winds."""
    of = loop()
    P = cp.Variable((2, 2), symmetric=True)
    conditions = [P >> np.eye(2)]
    for acceleration, m, wind in product((-1.0, 1.0), MASS, WIND):
        at = of.law.at(jnp.asarray([acceleration]), jnp.asarray([m, wind]))
        A = np.asarray([[1.0, DT], [0.0, 1.0]])
        B = np.asarray([[0.5 * DT**2], [DT]]) / m
        M = A - B @ np.asarray(at.gain, np.float64)
        conditions.append(ALPHA**2 * P - M.T @ P @ M >> 0)
    cp.Problem(cp.Minimize(P[0, 0] + P[1, 1]), conditions).solve(solver=cp.CLARABEL)
    metric = np.asarray(P.value)
    lipschitz = float(np.sqrt(np.linalg.inv(metric)[0, 0]))
    claim = OutputMetric(
        alpha=ALPHA,
        lipschitz=lipschitz,
        metric=tuple(map(tuple, metric.tolist())),
        joint=(),
    )
    return {"position": claim}


def measured(key, **changed):
    of = loop()
    settings = {**SETTINGS, **changed}
    return measure_tubes(
        of, exact_model(of), {}, claims(), key, spread=SPREAD, **settings
    )


def test_the_bounds_hold_on_runs_that_are_simulated_beside_them(key):
    """The nominal model starts at a measurement, and no noise acts on it."""
    of = loop()
    measure_key, run_key, sensor_key = jax.random.split(key, 3)
    tubes = measured(measure_key)
    bounds = tubes.outputs["position"]
    count = 200
    runs = random_runs(
        of, run_key, count=count, steps=40, dwell=DWELL, spread=SPREAD, noisy=True
    )
    noise = jnp.asarray(of.tracked.system.sensor_noise)
    off = noise * jax.random.normal(sensor_key, (count, 2))

    def nominal(run, off):
        def step(state, given):
            after = of.step(state, *given)
            return after, after

        start = run.states[0].at[BODY].add(off)
        return jax.lax.scan(step, start, (run.controls, run.envs))[1]

    predicted = np.asarray(jax.jit(jax.vmap(nominal))(runs, off))[..., 3]
    true = np.asarray(runs.states)[:, 1:, 3]
    apart = np.abs(true - predicted).max(axis=1)
    assert np.mean(apart <= bounds.tube) >= 0.9
    assert apart.max() > 0.1 * bounds.tube
    kept = np.abs(predicted).max(axis=1) <= bounds.nominal
    assert np.mean(kept) >= 0.8
    assert np.mean(np.abs(true).max(axis=1) <= bounds.total) >= 0.9
    assert bounds.total == bounds.tube + bounds.nominal
    assert bounds.system <= bounds.total
    assert 0.75 <= tubes.coverage.share <= 1.0


def test_the_same_key_gives_the_same_tubes_and_conditions(key):
    first = measured(key)
    again = measured(key)
    assert first.outputs == again.outputs
    assert first.coverage == again.coverage
    conditions = first.conditions
    assert conditions.input_box == ((-1.0,), (1.0,))
    assert conditions.env_box == ((0.8, -0.5), (1.2, 0.5))
    assert conditions.env_dwell_s == DWELL
    assert conditions.duration_s == 4.0
    assert conditions.sensor_noise == (0.001, 0.002)
    np.testing.assert_allclose(conditions.perturbation, [0.05 * LIMIT], rtol=1e-6)


def test_a_higher_level_costs_wider_bounds(key):
    low = measured(key, level=0.8).outputs["position"]
    high = measured(key, level=0.95).outputs["position"]
    assert high.total > low.total
    assert high.system > low.system
