"""What MPPI is made of: noise over the horizon, weights of samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax import control
from sfkd_jax.control.planners._mppi import (
    effective_sample_size,
    savitzky_golay,
    shrunk,
    softmin,
    temperature_for,
)
from sfkd_jax.control.planners._sampling import NOISE_KINDS, SamplingPlanner

HORIZON, SAMPLES = 20, 4000
STD = jnp.asarray([0.5, 2.0])
TASK = control.free_task(lambda *_: _, lambda *_: _)
every = pytest.mark.parametrize("kind", NOISE_KINDS)


def drawn(kind, seed=0, samples=SAMPLES):
    settings = {"noise_std": (1.0, 1.0), "noise_knots": 6, "noise": kind}
    planner = SamplingPlanner(TASK, num_samples=samples, horizon=HORIZON, **settings)
    return np.asarray(planner.draw(jax.random.key(seed), STD))


# ---- noise


@every
def test_every_step_of_every_control_has_its_spread_and_its_own_numbers(kind):
    noise = drawn(kind)
    assert noise.shape == (HORIZON, SAMPLES, 2)
    np.testing.assert_allclose(noise.std(axis=1), np.tile(STD, (HORIZON, 1)), rtol=0.06)
    np.testing.assert_allclose(noise.mean(axis=1) / STD, 0.0, atol=0.06)
    assert abs(np.corrcoef(noise.reshape(-1, 2).T)[0, 1]) < 0.03
    np.testing.assert_array_equal(drawn(kind, 1, 8), drawn(kind, 1, 8))
    assert np.all(drawn(kind, 1, 8) != drawn(kind, 2, 8))


@pytest.mark.parametrize(("kind", "rate"), [("ar1", 0.8), ("white", 0.0)])
def test_noise_forgets_at_its_rate(kind, rate):
    lag = np.abs(np.subtract.outer(np.arange(HORIZON), np.arange(HORIZON)))
    seen = np.corrcoef(drawn(kind)[:, :, 0])
    np.testing.assert_allclose(seen, np.where(lag == 0, 1.0, rate**lag), atol=0.07)


# ---- smoothing


def test_smoothing_has_the_published_weights_and_keeps_quadratics():
    table = savitzky_golay(HORIZON, 5)
    # Savitzky and Golay (1964), table I: five points, quadratic.
    published = np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35.0
    np.testing.assert_allclose(table[9, 7:12], published, atol=1e-12)
    np.testing.assert_allclose(np.delete(table[9], range(7, 12)), 0.0)
    quadratics = np.vander(np.arange(HORIZON), 3)
    np.testing.assert_allclose(table @ quadratics, quadratics, atol=1e-9)


# ---- weights


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("wanted", [2.0, 30.0, 400.0])
@pytest.mark.parametrize("law", ["uniform", "exponential", "one far off"])
def test_as_many_samples_count_as_are_wanted_whatever_the_scale_of_the_cost(
    scale, wanted, law
):
    key, shape = jax.random.key(0), (1500,)
    uniform = jax.random.uniform(key, shape)
    drawn_costs = {
        "uniform": uniform,
        "exponential": jax.random.exponential(key, shape),
        "one far off": uniform.at[7].set(1e4),
    }
    costs = scale * drawn_costs[law]
    temperature = temperature_for(costs, jnp.asarray(wanted))
    weights, usable = softmin(costs, temperature)
    assert bool(usable)
    np.testing.assert_allclose(effective_sample_size(weights), wanted, rtol=0.05)


def test_more_than_there_are_gives_all_and_bad_ones_never_count():
    costs = jnp.asarray([1.0, 2.0, jnp.nan, jnp.inf, 3.0])
    temperature = temperature_for(costs, jnp.asarray(5.0))
    weights, _ = softmin(costs, temperature)
    np.testing.assert_allclose(weights, [1 / 3, 1 / 3, 0.0, 0.0, 1 / 3], atol=1e-4)


@pytest.mark.parametrize(
    "costs", [[2.0] * 3, [jnp.nan] * 3, [1.0, jnp.inf, jnp.inf], [1e-45, 0.0, 0.0]]
)
def test_costs_without_a_spread_give_a_finite_temperature(costs):
    temperature = temperature_for(jnp.asarray(costs), jnp.asarray(2.0))
    assert bool(jnp.isfinite(temperature) & (temperature > 0))


def test_a_mean_of_noise_stays_at_the_plan_and_one_of_a_signal_moves_to_it():
    noise = jnp.asarray(drawn("white", samples=64))
    even = jnp.full(64, 1.0 / 64)
    plan = jnp.ones((HORIZON, 2))

    def moved(signal):
        samples = plan[:, None] + noise + signal
        mean = jnp.einsum("m,tmc->tc", even, samples)
        return shrunk(mean, plan, even, samples) - plan, mean - plan

    # Half the spread of the mean on average: most of the move is noise.
    nothing, whole = moved(0.0)
    assert np.sum(nothing**2) < 0.2 * np.sum(whole**2)
    far, whole = moved(10.0)
    np.testing.assert_allclose(far, whole, rtol=2e-3)
    # One sample, or samples that are all alike, say nothing about their variance.
    same, whole = shrunk(plan, plan, even, plan[:, None] + 0.0 * noise), plan
    np.testing.assert_array_equal(same, whole)


@pytest.mark.parametrize("samples", [1, 2, 16])
def test_few_samples_are_not_worse_than_the_law_alone(samples):
    """Around the optimum of a quadratic cost every move is one of noise."""
    task = control.free_task(
        lambda params, x, u, e: x + 0.1 * u,
        lambda weights, x, u, before, target: jnp.sum(x**2) + jnp.sum(u**2),
    )

    def energy(shrinkage):
        planner = control.mppi(
            task,
            num_samples=samples,
            horizon=5,
            noise_std=(0.3, 0.3),
            temperature=5.0,
            shrinkage=shrinkage,
        )
        state, used = planner.init(jax.random.key(0)), 0.0
        act = jax.jit(planner.act)
        for _ in range(20):
            u, state, _ = act({}, state, jnp.zeros(2), jnp.zeros(1), ())
            used += float(jnp.sum(u**2))
        return used

    assert energy(True) <= 0.3 * energy(False)
