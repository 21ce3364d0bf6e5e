"""Noise: its correlation over the horizon, and equal variance at every step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax import control

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


def drawn(kind, seed=0, samples=SAMPLES, **settings):
    draw = control.noise_sampler(kind, horizon=HORIZON, **{**KINDS[kind], **settings})
    return np.asarray(draw(jax.random.key(seed), samples, STD))


def correlations(noise):
    """Correlations between all pairs of steps, of the first control."""
    return np.corrcoef(noise[:, :, 0])


@every
@pytest.mark.parametrize("halton", [False, True])
def test_every_step_of_every_control_has_the_spread_that_was_asked_for(kind, halton):
    noise = drawn(kind, halton=halton)
    assert noise.shape == (HORIZON, SAMPLES, 2)
    np.testing.assert_allclose(noise.std(axis=1), np.tile(STD, (HORIZON, 1)), rtol=0.06)
    np.testing.assert_allclose(noise.mean(axis=1) / STD, 0.0, atol=0.06)


@every
def test_controls_are_perturbed_independently(kind):
    noise = drawn(kind)
    across = np.corrcoef(noise.reshape(-1, 2).T)[0, 1]
    assert abs(across) < 0.03


def test_autoregressive_noise_forgets_at_its_rate():
    lag = np.abs(np.subtract.outer(np.arange(HORIZON), np.arange(HORIZON)))
    np.testing.assert_allclose(correlations(drawn("ar1")), 0.8**lag, atol=0.07)


def test_white_noise_has_no_memory():
    np.testing.assert_allclose(correlations(drawn("white")), np.eye(HORIZON), atol=0.07)


def test_autoregressive_noise_from_independent_and_from_halton_numbers_has_one_law():
    np.testing.assert_allclose(
        correlations(drawn("ar1", halton=True)), correlations(drawn("ar1")), atol=0.1
    )


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
def test_the_spectrum_of_coloured_noise_falls_as_asked(exponent):
    """Slope of the log spectrum of tapered windows, in the band that 20 steps resolve."""
    horizon = 64
    draw = control.noise_sampler("coloured", horizon=horizon, exponent=exponent)
    noise = np.asarray(draw(jax.random.key(0), 2000, STD))[:, :, 0]
    power = np.mean(
        np.abs(np.fft.rfft(noise * np.hanning(horizon)[:, None], axis=0)) ** 2, axis=1
    )
    inside = slice(3, 24)
    frequency = np.arange(len(power))[inside]
    slope = np.polyfit(np.log(frequency), np.log(power[inside]), 1)[0]
    assert abs(slope + exponent) < 0.25


@pytest.mark.parametrize("knots", [2, 3, 4, 7])
def test_a_spline_through_knots_is_exact_for_the_polynomials_it_can_hold(knots):
    """Before scaling, the weights of the knots sum to one in every row, and a cubic is
    reproduced.
    """
    from sfkd_jax.control.planners._noise import _spline

    spacing = (HORIZON - 1) / (knots - 1)
    places, steps = spacing * np.arange(knots), np.arange(HORIZON)
    weights = _spline(steps / spacing, knots)
    for order in range(min(4, knots)):
        np.testing.assert_allclose(
            weights @ (places / 10) ** order, (steps / 10) ** order, atol=2e-5
        )


def test_halton_points_fill_their_space_more_evenly_than_independent_ones():
    """For the mean of a smooth function of four numbers, the error is far smaller."""
    misses = {halton: [] for halton in (True, False)}
    for halton, errors in misses.items():
        draw = control.noise_sampler("spline", horizon=HORIZON, knots=2, halton=halton)
        for seed in range(12):
            noise = np.asarray(draw(jax.random.key(seed), 512, jnp.ones(2)))
            errors.append(
                np.mean(np.cos(noise[0]).prod(axis=1) * np.cos(noise[-1]).prod(axis=1))
                - np.exp(-2.0)
            )
    assert np.std(misses[True]) < 0.4 * np.std(misses[False])


@every
def test_another_key_makes_other_noise_and_the_same_the_same(kind):
    np.testing.assert_array_equal(drawn(kind, 1, 8), drawn(kind, 1, 8))
    assert np.all(drawn(kind, 1, 8) != drawn(kind, 2, 8))


# ---- weights -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("wanted", [2.0, 30.0, 400.0])
@pytest.mark.parametrize("law", ["uniform", "exponential", "one far off"])
def test_as_many_samples_count_as_are_wanted_whatever_the_scale_of_the_cost(
    scale, wanted, law
):
    costs = {
        "uniform": jax.random.uniform(jax.random.key(0), (1500,)),
        "exponential": jax.random.exponential(jax.random.key(1), (1500,)),
        "one far off": jax.random.uniform(jax.random.key(2), (1500,)).at[7].set(1e4),
    }[law]
    temperature = control.temperature_for_sample_size(
        scale * costs, jnp.asarray(wanted)
    )
    weights, usable = control.softmin(scale * costs, temperature)
    assert bool(usable)
    np.testing.assert_allclose(
        control.effective_sample_size(weights), wanted, rtol=0.05
    )


def test_more_than_there_are_gives_all_and_bad_ones_never_count():
    costs = jnp.asarray([1.0, 2.0, jnp.nan, jnp.inf, 3.0])
    weights, _ = control.softmin(
        costs, control.temperature_for_sample_size(costs, jnp.asarray(5.0))
    )
    np.testing.assert_allclose(weights, [1 / 3, 1 / 3, 0.0, 0.0, 1 / 3], atol=1e-4)


@pytest.mark.parametrize(
    "costs", [[2.0, 2.0, 2.0], [jnp.nan] * 3, [1.0, jnp.inf, jnp.inf]]
)
def test_costs_without_a_spread_give_a_finite_temperature(costs):
    temperature = control.temperature_for_sample_size(
        jnp.asarray(costs), jnp.asarray(2.0)
    )
    assert bool(jnp.isfinite(temperature))
    assert float(temperature) > 0
