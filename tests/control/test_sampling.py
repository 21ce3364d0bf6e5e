"""What MPPI is made of: noise over the horizon, weights of samples, smoothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import savgol_filter

from sfkd_jax.control import noise_sampler
from sfkd_jax.control.planners._noise import _spline
from sfkd_jax.control.planners._smoothing import plan_smoother
from sfkd_jax.control.planners._weights import (
    effective_sample_size,
    softmin,
    temperature_for_sample_size,
)

HORIZON, SAMPLES = 20, 4000
STD = jnp.asarray([0.5, 2.0])
KINDS = {
    "ar1": {"correlation": 0.8},
    "white": {},
    "coloured": {"exponent": 1.5},
    "rbf": {"knots": 5},
    "spline": {"knots": 6},
}
every = pytest.mark.parametrize("kind", KINDS)


def drawn(kind, seed=0, samples=SAMPLES):
    draw = noise_sampler(kind, horizon=HORIZON, **KINDS[kind])
    return np.asarray(draw(jax.random.key(seed), samples, STD))


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


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_the_spectrum_of_coloured_noise_falls_as_asked(exponent):
    """Slope of the log spectrum of tapered windows, in the band that 64 steps resolve."""
    draw = noise_sampler("coloured", horizon=64, exponent=exponent)
    noise = np.asarray(draw(jax.random.key(0), 2000, STD))[:, :, 0]
    tapered = np.fft.rfft(noise * np.hanning(64)[:, None], axis=0)
    power = np.mean(np.abs(tapered) ** 2, axis=1)[3:24]
    slope = np.polyfit(np.log(np.arange(3, 24)), np.log(power), 1)[0]
    assert abs(slope + exponent) < 0.25


@pytest.mark.parametrize("knots", [2, 3, 4, 7])
def test_a_spline_through_knots_is_exact_for_the_polynomials_it_can_hold(knots):
    places = (HORIZON - 1) / (knots - 1) * np.arange(knots)
    for order in range(min(4, knots)):
        reached = _spline(HORIZON, knots) @ (places / 10) ** order
        expected = (np.arange(HORIZON) / 10) ** order
        np.testing.assert_allclose(reached, expected, atol=1e-9)


# ---- weights


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("wanted", [2.0, 30.0, 400.0])
@pytest.mark.parametrize("law", ["uniform", "exponential", "one far off"])
def test_as_many_samples_count_as_are_wanted_whatever_the_scale_of_the_cost(
    scale, wanted, law
):
    costs = (
        scale
        * {
            "uniform": jax.random.uniform(jax.random.key(0), (1500,)),
            "exponential": jax.random.exponential(jax.random.key(1), (1500,)),
            "one far off": jax.random.uniform(jax.random.key(2), (1500,))
            .at[7]
            .set(1e4),
        }[law]
    )
    temperature = temperature_for_sample_size(costs, jnp.asarray(wanted))
    weights, usable = softmin(costs, temperature)
    assert bool(usable)
    np.testing.assert_allclose(effective_sample_size(weights), wanted, rtol=0.05)


def test_more_than_there_are_gives_all_and_bad_ones_never_count():
    costs = jnp.asarray([1.0, 2.0, jnp.nan, jnp.inf, 3.0])
    temperature = temperature_for_sample_size(costs, jnp.asarray(5.0))
    weights, _ = softmin(costs, temperature)
    np.testing.assert_allclose(weights, [1 / 3, 1 / 3, 0.0, 0.0, 1 / 3], atol=1e-4)


@pytest.mark.parametrize(
    "costs", [[2.0] * 3, [jnp.nan] * 3, [1.0, jnp.inf, jnp.inf], [1e-45, 0.0, 0.0]]
)
def test_costs_without_a_spread_give_a_finite_temperature(costs):
    temperature = temperature_for_sample_size(jnp.asarray(costs), jnp.asarray(2.0))
    assert bool(jnp.isfinite(temperature) & (temperature > 0))


@pytest.mark.parametrize("broken", [None, jnp.inf, jnp.nan])
def test_the_temperature_has_the_derivative_of_the_implicit_equation(broken):
    """Against central differences; a cost that is not finite changes nothing."""
    with jax.enable_x64(True):
        costs = jnp.asarray(np.random.default_rng(0).gamma(2.0, 3.0, 40))
        costs = costs if broken is None else costs.at[3].set(broken)
        wanted = jnp.asarray(12.0)
        by_costs, by_size = jax.grad(temperature_for_sample_size, (0, 1))(costs, wanted)

        def difference(towards, size):
            ahead, behind = (
                temperature_for_sample_size(costs + t * towards, wanted + t * size)
                for t in (0.05, -0.05)
            )
            return (ahead - behind) / 0.1

        for entry in (0, 7, 20):
            unit = jnp.zeros(40).at[entry].set(1.0)
            np.testing.assert_allclose(
                by_costs[entry], difference(unit, 0.0), rtol=0.05
            )
        np.testing.assert_allclose(by_size, difference(jnp.zeros(40), 1.0), rtol=0.05)
        assert bool(jnp.isfinite(by_costs).all())
        assert float(jnp.sum(by_costs)) == pytest.approx(0.0, abs=1e-6)


# ---- smoothing


@pytest.mark.parametrize(
    ("window", "order"), [(5, 2), (5, 0), (7, 3), (3, 1), (9, 4), (31, 6)]
)
def test_a_plan_is_smoothed_as_the_record_that_it_continues(window, order):
    """Against scipy, whose mode "interp" makes the same one-sided fit at the end."""
    half = window // 2
    record = np.random.default_rng(0).standard_normal((half + 40, 2))
    smooth = plan_smoother(horizon=40, window=window, order=order)
    expected = savgol_filter(record, window, order, axis=0, mode="interp")[half:]
    smoothed = smooth(jnp.asarray(record[:half]), jnp.asarray(record[half:]))
    np.testing.assert_allclose(smoothed, expected, atol=2e-6)


@pytest.mark.parametrize(("window", "horizon"), [(5, 3), (9, 20)])
@pytest.mark.parametrize("order", [0, 1, 2])
def test_only_a_polynomial_that_continues_the_past_stays_what_it_is(
    window, horizon, order
):
    half = window // 2
    smooth = plan_smoother(horizon=horizon, window=window, order=order)
    times = np.linspace(-1.0, 1.0, half + horizon)[:, None]

    def change(record, past):
        smoothed = smooth(jnp.asarray(past), jnp.asarray(record[half:]))
        return np.max(np.abs(smoothed - record[half:]))

    kept = np.polynomial.polynomial.polyval(times, np.arange(1.0, order + 2))
    bent = kept + times ** (order + 1)
    assert change(kept, kept[:half]) < 1e-5
    assert change(bent, bent[:half]) > 1e-3
    assert change(kept, np.zeros((half, 1))) > 1e-2
