"""Latency: mean commands over a period, and states of the past."""

import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.geometry import compose
from sfkd_jax.latency import (
    CommandDelay,
    Latency,
    ReadingBuffer,
    delayed,
    rows_needed,
)

FINE = 1000
"""Parts of a period in which a mean is computed numerically."""


@pytest.mark.parametrize("periods", [(0.0, 0.0), (1.0, 1.0), (0.3, 2.45), (3.0, 0.7)])
@pytest.mark.parametrize("period", [0, 1])
def test_the_acting_command_is_the_mean_of_what_acts(periods, period):
    delay = CommandDelay(periods)
    random = np.random.default_rng(0)
    commands = random.normal(size=(delay.steps + 1, 2)).astype(np.float32)
    acting = delay.acting(jnp.asarray(commands[:-1]), jnp.asarray(commands[-1]), period)
    times = period + (np.arange(FINE) + 0.5) / FINE
    for control, late in enumerate(periods):
        # Command k of those before this call acts from k + late on, the last for ever.
        which = np.floor(times - late).astype(int) + delay.steps
        expected = commands[np.minimum(which, delay.steps), control].mean()
        np.testing.assert_allclose(acting[control], expected, atol=5e-3)


@pytest.mark.parametrize("periods", [(0.0, 0.0), (1.0, 1.0), (0.3, 2.45)])
def test_of_a_delay_that_may_be_wrong_every_hypothesis_is_another_delay(periods):
    delay = CommandDelay(periods, tolerance=2.0)
    assert delay.hypotheses[-1] == 2.0
    assert 0.0 in delay.hypotheses
    assert min(delay.hypotheses) + delay.first >= 0.0
    random = np.random.default_rng(0)
    commands = random.normal(size=(delay.steps + 1, 2)).astype(np.float32)
    sent = jnp.asarray(commands[:-1])
    now = jnp.asarray(commands[-1])
    for later in delay.hypotheses:
        true = CommandDelay(tuple(max(one + later, 0.0) for one in periods))
        found = delay.acting(sent, now, later=jnp.asarray(later))
        np.testing.assert_allclose(found, true.acting(sent, now), atol=1e-6)


def test_before_the_first_command_the_present_one_acts():
    delay = CommandDelay((1.5, 0.0))
    sent = jnp.full((delay.steps, 2), jnp.nan)
    command = jnp.asarray([0.1, -2.0])
    np.testing.assert_allclose(delay.acting(sent, command), command, rtol=1e-6)


def test_a_past_pose_is_on_the_arc_that_joins_two_observed_ones():
    """Exact for a car that turns steadily, across the jump of its yaw from π to −π."""

    def at(time):
        turned = 0.5 * time
        arc = jnp.asarray([20.0 * np.sin(turned), 20.0 * (1 - np.cos(turned)), turned])
        pose = compose(jnp.asarray([3.0, -2.0, 3.0]), arc)
        wrapped = pose.at[2].set(jnp.arctan2(jnp.sin(pose[2]), jnp.cos(pose[2])))
        return jnp.append(wrapped, 5.0 + time)

    periods = (1.25, 1.25, 1.25, 0.5)
    past = jnp.stack([at(0.1 * k) for k in range(rows_needed(periods))])
    now = 0.1 * (len(past) - 1)
    state = delayed(past, periods)
    expected = at(now - 0.125)
    np.testing.assert_allclose(state[:2], expected[:2], atol=1e-3)
    turn = (state - expected)[2]
    np.testing.assert_allclose(np.arctan2(np.sin(turn), np.cos(turn)), 0.0, atol=1e-5)
    np.testing.assert_allclose(state[3], 5.0 + now - 0.05, rtol=1e-6)


def test_nothing_late_is_the_newest_bit_for_bit():
    past = jnp.asarray(np.random.default_rng(1).normal(size=(1, 5)))
    assert (delayed(past, (0.0,) * 5) == past[-1]).all()
    assert CommandDelay((0.0, 0.0)).steps == 0


def test_one_number_stands_for_all_and_none_for_nothing():
    sized = Latency((0.1,), ()).sized(4, 2)
    assert sized == Latency((0.1,) * 4, (0.0, 0.0))
    assert not sized.is_none
    assert Latency().sized(4, 2).is_none


def test_in_words_equal_delays_are_one():
    assert (
        str(Latency((0.06,), (0.04,)).sized(4, 2)) == "sensors 0.06 s, controls 0.04 s"
    )
    assert str(Latency((0.1, 0.2), ())) == "sensors 0.1, 0.2 s, controls 0 s"


def test_younger_entries_wait_for_the_oldest():
    latency = Latency((0.2, 0.2, 0.2, 0.05), (0.1, 0.3))
    assert latency.hold_back(0.1) == (0.0, 0.0, 0.0, 1.5)
    assert latency.loop(0.1).periods == (3.0, 5.0)
    # 0.3 / 0.1 is 2.9999999999999996: no part of a period may be left of it.
    assert Latency((0.3,), (0.0,)).loop(0.1).periods == (3.0,)


@pytest.mark.parametrize("bad", [-0.1, 2.5, float("nan"), float("inf")])
def test_delays_that_are_none_are_refused(bad):
    with pytest.raises(ValueError, match="must be in"):
        Latency((bad,), ())
    with pytest.raises(ValueError, match="must be in"):
        Latency((), (0.1, bad))


def test_a_wrong_number_of_delays_is_refused():
    with pytest.raises(ValueError, match=r"latency\.sensors needs one number or 4"):
        Latency((0.1, 0.2), ()).sized(4, 2)


def jittered(seed):
    """Readings of a car that turns, each up to 0.2 s late, in the order they arrive."""
    random = np.random.default_rng(seed)
    times = np.round(0.1 * np.arange(60), 9)
    turned = 0.3 * times
    x = 20.0 * np.sin(turned)
    y = 20.0 * (1.0 - np.cos(turned))
    states = np.stack([x, y, turned, 6.0 + 0.1 * times], axis=1)
    arrivals = times + 0.1 * random.integers(0, 3, len(times))
    return times, states, arrivals


def test_readings_that_come_in_any_order_are_of_one_time():
    """Each is handed over 0.2 s after its time, whenever it came."""
    times, states, arrivals = jittered(0)
    buffer = ReadingBuffer(0.2)
    for now in times[2:]:
        for which in np.flatnonzero(np.isclose(arrivals, now)):
            buffer.push(times[which], states[which])
        if now > times[3]:
            seen = buffer.at(now)
            np.testing.assert_allclose(
                seen, states[np.isclose(times, now - 0.2)][0], atol=1e-5
            )


def test_a_lost_reading_is_on_the_arc_of_its_neighbours():
    times, states, _ = jittered(1)
    buffer = ReadingBuffer(0.2)
    # On Earth, where float32 resolves half a metre.
    states = states + np.asarray([5e5, 4.5e6, 0.0, 0.0])
    for which in (0, 2, 3):
        buffer.push(times[which], states[which])
    np.testing.assert_allclose(buffer.at(0.3), states[1], rtol=0.0, atol=2e-3)
    # Beyond the gap nothing is known, and what follows still is.
    buffer.push(times[8], states[8])
    assert np.isnan(buffer.at(0.7)).all()
    np.testing.assert_allclose(buffer.at(1.0), states[8])


def test_a_buffer_keeps_no_reading_that_no_call_needs():
    buffer = ReadingBuffer(0.1)
    for step in range(1000):
        buffer.push(0.1 * step, np.zeros(4))
        buffer.at(0.1 * step)
    assert len(buffer._readings) <= 3


def test_times_that_are_none_are_refused_or_ignored():
    with pytest.raises(ValueError, match="latest must be in"):
        ReadingBuffer(float("nan"))
    buffer = ReadingBuffer(0.1)
    with pytest.raises(ValueError, match="no reading"):
        buffer.at(0.0)
    buffer.push(float("nan"), np.zeros(4))
    buffer.push(0.0, np.ones(4))
    np.testing.assert_array_equal(buffer.at(0.1), np.ones(4))
