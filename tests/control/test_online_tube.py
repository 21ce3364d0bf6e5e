"""The tube that is calibrated while driving: coverage under an adversary, and speed."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit, straight

from sfkd_jax import control
from sfkd_jax.types import Controller

HORIZON, STEPS, LEVEL, RATE = 5, 600, 0.9, 0.2


def straight_plan():
    """A planner that predicts the path itself and reports the speed asked of it."""

    def act(params, state, xi, env, preview):
        ahead = jnp.zeros((HORIZON, 3)).at[:, 2].set(preview.road[:, 1])
        info = {"predicted_states": ahead, "asked": preview.road[-1, 1]}
        return jnp.zeros(2), state, info

    planner = Controller(lambda key: jnp.zeros(()), act)
    return control.along_reference(planner, coordinates=3)


def circle(curvature, speed=10.0, dt=0.1):
    """A reference along a circle."""
    angle = curvature * speed * dt * np.arange(1, HORIZON + 1)
    radius = 1.0 / curvature
    x, y = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    return np.stack([x, y, angle, np.full(HORIZON, speed)], axis=1)


@cache
def runner(**settings):
    """Infos while the car is at given distances left of a path, compiled once."""
    options = {"horizon": HORIZON, "level": LEVEL, "rate": RATE} | settings
    controller = control.OnlineTube(inner=straight_plan(), **options)

    @jit
    def run(laterals, reference):
        def step(state, lateral):
            seen = jnp.asarray([0.0, 0.0, 0.0, 10.0]).at[1].set(lateral)
            _, state, info = controller.act({}, state, seen, jnp.zeros(2), reference)
            return state, info

        return jax.lax.scan(step, controller.init(jax.random.key(0)), laterals)[1]

    return run


def follow(laterals, reference=None, **settings):
    reference = straight(HORIZON) if reference is None else reference
    inputs = (jnp.asarray(array, dtype=float) for array in (laterals, reference))
    return jax.tree.map(np.asarray, runner(**settings)(*inputs))


RANDOM = np.random.default_rng(0)
ADVERSARIES = {
    "noise": 0.02 * RANDOM.normal(size=STEPS),
    "growing": 0.01 * np.exp(np.linspace(0.0, 5.0, STEPS)),
    "shift": np.where(np.arange(STEPS) < 300, 0.005, 0.5),
    "heavy": 0.01 * RANDOM.standard_cauchy(size=STEPS),
    "alternating": np.where(np.arange(STEPS) % 7 == 0, 1.0, 1e-3),
}


@pytest.mark.parametrize("name", ADVERSARIES)
def test_the_share_of_misses_is_bounded_by_the_change_of_the_radius(name):
    """|misses / N − (1 − level)| ≤ |log(r_N / r_0)| / (γ N), for every horizon."""
    info = follow(ADVERSARIES[name])
    compared = np.isfinite(info["tube_errors"])
    for h in range(HORIZON):
        count = compared[:, h].sum()
        assert count == STEPS - h - 1
        share = info["tube_missed"][compared[:, h], h].mean()
        change = np.log(info["tube"][-1, h] / control.OnlineTube.start_radius)
        bound = abs(change) / (RATE * count)
        assert abs(share - (1.0 - LEVEL)) <= bound + 1e-3


def test_a_quiet_drive_keeps_its_level_and_a_tube_of_its_quantile():
    info = follow(ADVERSARIES["noise"])
    assert abs(info["tube_missed"][100:].mean() - (1.0 - LEVEL)) < 0.02
    quantile = np.quantile(np.abs(ADVERSARIES["noise"]), LEVEL)
    assert 0.8 < np.median(info["tube"][200:]) / quantile < 1.25


def test_the_speed_falls_until_the_corridor_fits_and_rises_again():
    errors = np.where(np.arange(STEPS) < 200, 0.3, 0.0)
    info = follow(errors, lane=0.2, slowest=7.0, fall=0.01)
    assert info["speed_factor"].min() == pytest.approx(0.7)
    assert info["speed_factor"][-1] > info["speed_factor"].min()
    assert np.all(np.diff(info["speed_factor"]) >= -0.01 - 1e-6)
    slowed = info["asked"] < 10.0
    np.testing.assert_allclose(
        info["asked"][1:], 10.0 * info["speed_factor"][:-1], rtol=1e-5
    )
    assert slowed.any()


def test_a_turn_is_taken_at_a_lateral_acceleration_that_fitted_before():
    settings = {"reference": circle(0.02), "grip": 1.0, "slowest": 1.0, "fall": 0.01}
    info = follow(np.zeros(STEPS), lane=0.5, **settings)
    demand = 0.02 * (10.0 * info["speed_factor"]) ** 2
    assert demand[0] > 1.9
    assert np.all(demand[60:] <= np.maximum(info["grip"][60:], 1.0) * 1.001)
    assert demand[:100].min() < 1.5
    np.testing.assert_allclose(info["speed_factor"][-1], 1.0)
    assert np.abs(np.diff(info["speed_factor"])).max() <= 0.01 + 1e-6
    lost = follow(np.where(np.arange(STEPS) < 300, 0.0, 1.0), lane=0.5, **settings)
    assert lost["grip"][-1] < 0.5 * lost["grip"][299]
    np.testing.assert_array_equal(lost["grip"][:300], info["grip"][:300])


def test_measurements_that_are_not_finite_change_no_radius():
    laterals = ADVERSARIES["noise"].copy()
    laterals[100:110] = np.nan
    info = follow(laterals, lane=0.5)
    before = np.tile(info["tube"][99], (10, 1))
    np.testing.assert_array_equal(info["tube"][100:110], before)
    assert np.isfinite(info["tube"]).all()
    np.testing.assert_array_equal(info["speed_factor"], 1.0)


@pytest.mark.parametrize(
    "change", [{"level": 1.0}, {"rate": 0.0}, {"lane": np.nan}, {"start_radius": 1e9}]
)
def test_invalid_settings_are_refused_by_name(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        control.OnlineTube(inner=straight_plan(), horizon=HORIZON, **change)
