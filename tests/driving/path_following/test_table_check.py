"""Holes in the tables of a law are errors or are filled; states may never settle."""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.driving import plants
from sfkd_jax.driving.path_following import (
    checked_law,
    derive_path_law,
    unsettled_coordinates,
)
from sfkd_jax.driving.path_following.laws._table_check import _found_turns

BOX = {"env_low": (0.3, -8.0), "env_high": (0.9, 8.0)}
CAR = plants.kinematic()
GRID = {"speed": (8.0, 10.5), "points": (5, 2, 2)}
NEVER = {"odometer": 4, "charge": 5, "clock": 6, "gear": 7}


def with_states_that_never_settle(state, control, env):
    """The car with a way, a charge that sinks, a time and a gear that slows it."""
    after = CAR.step(state[:4], control, env)
    _, charge, clock, gear = state[4:]
    after = after.at[3].add(-0.1 * gear)
    odometer = state[4] + 0.1 * state[3]
    others = jnp.stack([odometer, charge - 1e-5, clock + 0.1, gear])
    return jnp.concatenate([after, others])


def step_of_clipped_steering(limit, state, control, env):
    steering = jnp.clip(control[0], -limit, limit)
    return CAR.step(state, control.at[0].set(steering), env)


def derived(step, coordinates=3, **options):
    return jit(
        partial(
            derive_path_law, step, coordinates=coordinates, **BOX, **GRID, **options
        )
    )()


@pytest.fixture(scope="module")
def law():
    return derived(CAR.step)


def test_states_that_never_settle_are_found_and_leave_the_law_as_it_is(law):
    size = 3 + len(NEVER)
    at = {"speed": 9.0, "env": (0.6, 0.0)}
    found = unsettled_coordinates(with_states_that_never_settle, coordinates=size, **at)
    # The index in the state is one more than that in the coordinates.
    assert [coordinate + 1 for coordinate in found] == [4, 5, 6, 7]
    longer = derived(with_states_that_never_settle, size, unsettled=found)
    np.testing.assert_allclose(longer.control, law.control, atol=2e-4)
    np.testing.assert_allclose(longer.state[..., :3], law.state, atol=2e-4)
    # Gains on the states of the car are those without the others, which have none.
    np.testing.assert_allclose(longer.gain[..., :3], law.gain, rtol=0.02, atol=5e-3)
    np.testing.assert_allclose(longer.gain[..., 3:6], 0.0, atol=1e-4)
    holes = derived(with_states_that_never_settle, size)
    assert not _found_turns(holes).any()
    with pytest.raises(
        ValueError, match="no steady driving straight ahead, as at 8 m/s"
    ):
        checked_law(holes, tightest=0.2)


@pytest.mark.parametrize("name", plants.FACTORIES)
def test_every_state_of_the_cars_settles(name):
    plant = plants.FACTORIES[name]()
    size = len(plant.state_names) - 1
    at = {"coordinates": size, "speed": 9.0, "env": (0.6, 2.0)}
    assert unsettled_coordinates(plant.step, **at) == ()


def test_a_complete_law_is_returned_as_it_is(law):
    checked, findings = checked_law(law, tightest=0.2)
    assert checked is law
    assert findings == ()


def test_turns_that_the_steering_cannot_make_are_counted_and_named():
    limit = 0.06
    law = derived(partial(step_of_clipped_steering, limit))
    tightest = np.tan(limit) / CAR.wheelbase
    found = _found_turns(law)
    # At 8 m/s the table asks for 0.034 1/m, and the steering gives 0.022.
    assert found[2].all()
    assert not found[[0, -1], 0].any()
    checked, (finding,) = checked_law(law, tightest=tightest)
    assert f"{(~found).sum()} of {found.size} points of the law" in finding
    assert "8 m/s, kappa = -0.0344 1/m, e = (0.3, -8)" in finding
    np.testing.assert_array_equal(checked.control[-1, 0], checked.control[-2, 0])


def test_a_gain_of_zero_is_that_of_the_next_smaller_curvature(law):
    gain = np.array(law.gain)
    gain[0, 1, 0, 1] = 0.0
    gain[:3, 0, 1, 1] = 0.0
    gain[4, 0, 0, 0] = np.nan
    checked, (finding,) = checked_law(
        law._replace(gain=jnp.asarray(gain)), tightest=1.0
    )
    filled = np.asarray(checked.gain)
    np.testing.assert_array_equal(filled[0, 1, 0, 1], gain[1, 1, 0, 1])
    # Straight ahead has none either: the nearest turn that has one.
    np.testing.assert_array_equal(filled[:3, 0, 1, 1], gain[[3, 3, 3], 0, 1, 1])
    np.testing.assert_array_equal(filled[4, 0, 0, 0], gain[3, 0, 0, 0])
    whole = np.isfinite(gain).all(axis=(-2, -1)) & gain.any(axis=(-2, -1))
    np.testing.assert_array_equal(filled[whole], gain[whole])
    assert f"{(~whole).sum()} of {whole.size} points" in finding
    gain[:, 1, 1, 0] = 0.0
    reason = r"no gain at any curvature, as at 10.5 m/s, kappa = 0 1/m, e = \(0.9, -8\)"
    with pytest.raises(ValueError, match=reason):
        checked_law(law._replace(gain=jnp.asarray(gain)), tightest=1.0)


def test_a_straight_that_was_not_found_is_that_of_the_nearest_speed_and_e(law):
    """Without a turn the derivation leaves ξ* = 0 and u* = 0, and no speed."""
    tables = {
        name: np.array(getattr(law, name)) for name in ("state", "control", "gain")
    }
    for name in ("state", "control"):
        tables[name][2, 1, 0, 0] = 0.0
    tables["gain"][2, 1, 0, 0] = 7.0
    holed = law._replace(**{name: jnp.asarray(table) for name, table in tables.items()})
    checked, (finding,) = checked_law(holed, tightest=1.0)
    assert (
        "at 1 of 8 speeds and e (10.5 m/s, kappa = 0 1/m, e = (0.3, -8), …)" in finding
    )
    np.testing.assert_array_equal(checked.gain[2, 1, 0, 0], law.gain[2, 0, 0, 0])
    np.testing.assert_array_equal(checked.control[2, 1, 0, 0], law.control[2, 0, 0, 0])
    assert checked.state[2, 1, 0, 0, 2] == 10.5
    others = np.ones(law.gain.shape[:4], bool)
    others[2, 1, 0, 0] = False
    np.testing.assert_array_equal(
        np.asarray(checked.gain)[others], np.asarray(law.gain)[others]
    )
