"""Positions that do not move as the measured speed says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.driving.path_following import OdometryTest

POSITION, YAW, SPEED, DT = 0.015, 0.002, 0.03, 0.1
NOISE = (POSITION, POSITION, YAW, SPEED, 0.02)
TEST = OdometryTest(deviations=NOISE, dt=DT, sideways=4)


def circle(steps, speed=10.0, radius=20.0):
    """Exact states of a vehicle that slides on a circle, (step, 5): v_y = 0.3 m/s."""
    way = speed * DT * np.arange(steps)
    angle = way / radius
    chord = [radius * np.sin(angle), radius * (1.0 - np.cos(angle))]
    slip = 0.3 / speed
    still = np.ones(steps)
    yaw = angle - np.arctan(slip)
    speeds = speed * still * np.asarray([[np.cos(slip)], [np.sin(slip)]])
    return np.stack([*chord, yaw, *speeds], axis=1)


def alarms(states, used=None, noise=1.0, seed=0):
    """Whether there is an alarm at each step."""
    spread = noise * np.asarray(NOISE)
    seen = states + spread * np.random.default_rng(seed).normal(size=states.shape)
    used = np.ones(len(states), bool) if used is None else used

    def step(state, inputs):
        state, statistic = TEST.update(state, *inputs)
        return state, (state.alarm, statistic)

    inputs = jnp.asarray(seen, float), jnp.asarray(used)
    scan = jit(lambda start, inputs: jax.lax.scan(step, start, inputs)[1])
    return tuple(map(np.asarray, scan(TEST.init(), inputs)))


def test_an_hour_of_right_sensors_raises_no_alarm():
    raised, statistic = alarms(circle(36_000))
    assert not raised.any()
    # The threshold is six deviations: noise is seen, and far below it.
    assert 0.2 < statistic.max() < 0.95


def test_without_noise_the_chord_of_a_bend_is_all_that_differs():
    _, statistic = alarms(circle(200), noise=0.0)
    assert statistic.max() < 0.05


@pytest.mark.parametrize(
    ("scale", "first", "last"), [(0.0, 1, 1), (0.9, 1, 5), (1.02, 5, 40)]
)
def test_a_position_of_another_scale_is_found(scale, first, last):
    states = circle(120)
    states[60:, :2] = states[59, :2] + scale * (states[60:, :2] - states[59, :2])
    raised, _ = alarms(states)
    assert not raised[:60].any()
    assert first <= np.argmax(raised[59:]) <= last


def test_a_position_that_is_dragged_aside_is_found():
    """0.1 m/s, on a straight and at 10 m/s."""
    states = circle(120, radius=1e6)
    states[60:, 1] += 0.01 * np.arange(1, 61)
    raised, _ = alarms(states)
    assert not raised[:60].any()
    assert 8 <= np.argmax(raised[59:]) <= 40


def test_what_a_worn_tyre_does_is_tolerated():
    states = circle(3_000)
    states[:, :2] *= 1.005
    assert not alarms(states)[0].any()


def test_a_gap_is_not_compared_and_does_not_end_an_alarm():
    states = circle(120)
    states[60:, :2] = states[60, :2]
    used = np.ones(120, bool)
    used[70:90] = False
    states[70:90] = np.nan
    raised, _ = alarms(states, used)
    assert raised[65:].all()
    # The first observation after a gap follows nothing.
    states = circle(120)
    states[70:90] = np.nan
    assert not alarms(states, used)[0].any()


def test_in_its_own_frame_a_vehicle_does_not_move():
    states = circle(60)
    states[:, :3] = 0.0
    assert not alarms(states, noise=0.0)[0].any()
