"""Stability margins: exact where the margins of a loop are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import any_law

from sfkd_jax import assembly
from sfkd_jax.driving import plants
from sfkd_jax.driving.corridor import closed_loop
from sfkd_jax.driving.corridor._margins import (
    Linearisation,
    delay_margin,
    gain_margin,
    law_margins,
    noise_of,
    rate,
)


def integrator(gain):
    """ξ⁺ = ξ + u, u = −k ξ, whose other control does nothing."""
    return Linearisation(
        A=jnp.ones((1, 1)),
        B=jnp.asarray([[1.0, 0.0]]),
        K=jnp.asarray([[gain], [0.0]], dtype=float),
    )


@pytest.mark.parametrize("whole", [1, 2, 3])
def test_an_integrator_tolerates_the_delay_of_its_characteristic_equation(whole):
    """z^(d+1) − z^d + k = 0 is stable for k < 2 sin(π / (4 d + 2)) alone."""
    largest = 2.0 * np.sin(np.pi / (4 * whole + 2))
    margin = jax.jit(delay_margin)
    assert margin(integrator(0.99 * largest)) >= whole
    assert whole - 1 <= margin(integrator(1.01 * largest)) < whole


def test_an_unstable_loop_has_no_margin():
    unstable = integrator(2.1)
    assert delay_margin(unstable) == 0.0
    assert gain_margin(unstable) == (1.0, 1.0)


def test_the_gain_margin_of_an_integrator():
    """1 − γ k is inside the unit circle for 0 < γ k < 2."""
    low, high = gain_margin(integrator(0.55))
    assert low == pytest.approx(0.1)
    assert high == pytest.approx(1 / 0.3)


def test_the_noise_of_an_integrator():
    """σ² = k² s² / (1 − (1 − k)²)."""
    gain, spread = 0.4, 0.02
    position, command = noise_of(jnp.asarray([spread]), integrator(gain))
    variance = (gain * spread) ** 2 / (1.0 - (1.0 - gain) ** 2)
    np.testing.assert_allclose(position, np.sqrt(variance), rtol=1e-4)
    np.testing.assert_allclose(command, gain * np.hypot(position, spread), rtol=1e-4)


def test_the_rate_is_the_spectral_radius_whatever_the_scale():
    random = np.random.default_rng(0)
    for scale in (1e-12, 1.0, 1e9):
        matrix = scale * random.normal(size=(6, 6))
        radius = np.abs(np.linalg.eigvals(matrix)).max()
        found = rate(jnp.asarray(matrix, jnp.float32))
        np.testing.assert_allclose(found, radius, rtol=0.02)


def test_twice_the_gain_halves_what_a_law_tolerates():
    """On the true car, at every speed of the grid."""
    law = any_law()
    plant = plants.kinematic()
    model = assembly.reference_systems(plant, law)["oracle"].model
    data = {
        "lateral_acceleration": 1.0,
        "peak_curvature": 0.05,
        "speed": (8.0, 10.5),
        "env_low": (0.7, -3.0),
        "env_high": (0.9, 3.0),
    }

    def margins(gain):
        loop = closed_loop(plant, model, {}, law._replace(gain=gain), (0.01,) * 4)
        return law_margins(loop, data)

    # As strong as those of the laws that ship.
    usual, strong = margins(4.0 * law.gain), margins(8.0 * law.gain)
    ratio = np.asarray(strong.delay_s) / np.asarray(usual.delay_s)
    assert np.all(np.asarray(usual.delay_s) < 0.4)
    assert np.all(np.abs(ratio - 0.5) < 0.15)
    assert np.all(np.asarray(strong.noise_steering) > np.asarray(usual.noise_steering))


def seen_and_hidden_servo(share=4.0):
    """One car with a servo twice: the angle is a state that is measured, or hidden."""
    law = any_law()
    law = law._replace(gain=share * law.gain)
    seen = plants.with_servo(plants.kinematic(), lag=0.3)
    hidden = seen._replace(states=seen.states[:-1], hidden=1)
    # The law that sees the angle does not read it.
    reading_all = law._replace(
        state=jnp.concatenate([law.state, law.control[..., :1]], axis=-1),
        gain=jnp.pad(law.gain, [(0, 0)] * (law.gain.ndim - 1) + [(0, 1)]),
    )
    model = assembly.reference_systems(plants.kinematic(), law)["oracle"].model
    return (
        closed_loop(seen, model, {}, reading_all, (0.01,) * 5),
        closed_loop(hidden, model, {}, law, (0.01,) * 4),
    )


STRAIGHT = {
    "lateral_acceleration": 0.01,
    "peak_curvature": 0.0001,
    "speed": (8.0, 10.5),
    "env_low": (0.8, -0.01),
    "env_high": (0.81, 0.01),
}


def test_a_hidden_state_is_part_of_the_margins():
    seen, hidden = seen_and_hidden_servo()
    expected = law_margins(seen, STRAIGHT)
    found = law_margins(hidden, STRAIGHT)
    assert expected is not None
    assert found is not None
    assert max(found.delay_s) < 0.5
    np.testing.assert_allclose(found.delay_s, expected.delay_s, atol=0.011)
    np.testing.assert_allclose(
        found.noise_lateral_m, expected.noise_lateral_m, rtol=0.02
    )


def test_a_law_that_does_not_hold_the_vehicle_has_no_margins_and_no_fault():
    for loop in seen_and_hidden_servo(share=-40.0):
        assert law_margins(loop, STRAIGHT) is None
