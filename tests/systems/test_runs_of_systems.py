"""Simulated runs stay in their ranges, and what they record replays them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import same
from loops import DT, FASTEST, MASS, WIND, frame, loop, mass

from sfkd_jax.systems import (
    ClosedLoop,
    System,
    Tracked,
    derive_law,
    integrated,
    random_reference,
    random_runs,
    regulation,
    spread_of,
    steady_states,
)
from sfkd_jax.systems._runs import tried
from sfkd_jax.types import BODY

DWELL = (1.0, 4.0)
STEPS = 200
ROOM = 1e-3
"""Share of a range by which the shield accepts more."""


def runs(of, key, *, noisy=False, count=8, spread=(0.1, 0.1)):
    return random_runs(
        of,
        key,
        count=count,
        steps=STEPS,
        dwell=DWELL,
        spread=jnp.asarray(spread),
        noisy=noisy,
    )


FRAMES = {
    "rates": frame(),
    "velocity": frame(ranges={"v": (-0.5, 1.0)}),
    "one way": frame(ranges={"v": (2.0, 3.0)}),
    "place": frame(ranges={"x": (-1.0, 2.0)}),
    "both": frame(ranges={"x": (-1.0, 2.0), "v": (-0.6, 0.6)}),
    "uneven": frame(
        reference={("x", "v"): (-0.2, 1.0)}, ranges={"x": (-0.3, 0.3), "v": (-0.2, 0.2)}
    ),
    "set point": regulation(
        {"position": ("x",)}, set_points={"x": (-1.0, 2.0)}, rates={"x": 0.7}
    ),
}


@pytest.mark.parametrize("name", FRAMES)
def test_references_stay_in_their_ranges_and_change_with_the_dwell(name, key):
    of = Tracked(mass(), FRAMES[name])
    draw = jax.jit(jax.vmap(partial(random_reference, of, steps=STEPS)))
    points, rates = draw(jax.random.split(key, 40))
    for state, (low, high) in of.frame.ranges.items():
        values = np.asarray(points)[..., of.frame.followed.index(state)]
        room = ROOM * (high - low)
        assert values.min() >= low - room
        assert values.max() <= high + room
        # They use their range.
        assert np.ptp(values) > 0.7 * (high - low)
    for index, (low, high) in enumerate(of.frame.reference.values()):
        assert np.asarray(rates)[..., index].min() >= low - 1e-5
        assert np.asarray(rates)[..., index].max() <= high + 1e-5
    # What is recorded is one reference.
    after = jax.vmap(jax.vmap(of.advance))(points[:, :-1], rates)
    np.testing.assert_allclose(after, points[:, 1:], atol=1e-5)
    between = jax.vmap(of.rates_between)(points)
    np.testing.assert_allclose(between, rates, atol=1e-3)


def test_rates_are_held_for_the_dwell(key):
    of = Tracked(mass(), frame(dwell=(0.5, 2.0)))
    rates = np.asarray(random_reference(of, key, steps=2000).rates)[:, 0]
    changes = np.flatnonzero(np.diff(rates)) + 1
    held = np.diff(changes) * DT
    # A change to the same end of the range is none.
    assert held.min() >= 0.5 - DT
    assert np.median(held) <= 2.0 + DT
    assert np.abs(rates).max() == FASTEST


def test_runs_stay_in_their_boxes_and_repeat_with_their_key(key):
    of = loop()
    drawn = runs(of, key, noisy=True)
    assert same(drawn, runs(of, key, noisy=True))
    assert not same(drawn, runs(of, jax.random.split(key)[0], noisy=True))
    assert np.all(np.isfinite(drawn.states))
    envs = np.asarray(drawn.envs)
    for index, (low, high) in enumerate((MASS, WIND)):
        assert envs[..., index].min() >= low
        assert envs[..., index].max() <= high
    switches = np.any(np.diff(envs, axis=1) != 0.0, axis=2).sum(axis=1)
    assert np.all(switches >= STEPS * DT / DWELL[1] - 2)
    assert np.all(switches <= STEPS * DT / DWELL[0] + 1)
    nu = np.asarray(drawn.controls)[..., 0]
    assert np.abs(nu).max() <= float(of.law.perturbation[0]) * (1.0 + 1e-4)
    assert np.abs(nu).max() > 0.2 * float(of.law.perturbation[0])


def replayed(of, run):
    def step(state, given):
        after = of.step(state, *given)
        return after, after

    _, states = jax.lax.scan(step, run.states[0], (run.controls, run.envs))
    return states


@pytest.mark.parametrize("spread", [0.1, 30.0], ids=["calm", "saturated"])
def test_recorded_controls_replay_a_run(spread, key):
    """Where a control is at its limit, the part of ν that acts is recorded."""
    of = loop()
    drawn = runs(of, key, spread=(spread, spread))
    again = jax.jit(jax.vmap(partial(replayed, of)))(drawn)
    np.testing.assert_allclose(again, drawn.states[:, 1:], atol=2e-4)
    largest = np.abs(np.asarray(drawn.controls)[..., 0]).max()
    assert (largest > float(of.law.perturbation[0])) == (spread > 1.0)


def test_noise_of_the_sensors_is_what_separates_noisy_runs(key):
    of = loop()
    quiet = np.asarray(runs(of, key).states)[..., BODY]
    noisy = np.asarray(runs(of, key, noisy=True).states)[..., BODY]
    apart = np.abs(noisy - quiet)
    assert apart.max() > 1e-5
    assert apart.max() < 0.05
    np.testing.assert_array_equal(apart[:, 0], 0.0)


def test_saturation_is_the_share_of_steps_at_a_limit(key):
    assert tried(loop(), key, steps=STEPS, dwell=DWELL).saturated == 0.0
    weak = Tracked(mass(controls={"force [N]": (-1.71, 1.71)}), frame())
    table = steady_states(weak, points=3)
    of = ClosedLoop(weak, derive_law(weak, table, rate=0.75))
    assert 0.0 < tried(of, key, steps=STEPS, dwell=DWELL).saturated < 1.0

    def unstable(state, control, env):
        return jnp.full_like(state, jnp.nan)

    broken = ClosedLoop(Tracked(mass(unstable), frame()), of.law)
    trial = tried(broken, key, steps=STEPS, dwell=DWELL)
    assert trial == (1.0, np.inf)


def test_the_spread_is_that_of_runs_from_steady_states(key):
    spread = np.asarray(spread_of(loop(), key, steps=STEPS, dwell=DWELL))
    assert spread.shape == (2,)
    # ν of at most 0.05 * 4 N, on a mass of about 1 kg whose law contracts.
    assert np.all((spread > 1e-4) & (spread < 0.3))


def test_what_a_steady_state_changes_by_is_no_spread(key):
    """The drive of a wheel follows its speed, which is anywhere in its range."""

    def rates(state, control, env):
        speed, drive = state
        return [drive - env[0] * speed, control[0] - drive]

    system = System(
        integrated(rates, dt=0.1),
        dt=0.1,
        states={"speed [m/s]": 0.0, "drive [m/s²]": 0.0},
        controls={"push [m/s²]": (-40.0, 40.0)},
        environment={"drag [1/s]": (1.0, 1.01)},
    )
    wheel = regulation(
        {"speed": ("speed",)}, set_points={"speed": (-10.0, 10.0)}, rates={"speed": 0.5}
    )
    tracked = Tracked(system, wheel)
    steady = steady_states(tracked, points=3)
    of = ClosedLoop(tracked, derive_law(tracked, steady, rate=0.75))
    assert steady.states[:, 1].std() > 5.0
    _, drive = spread_of(of, key, steps=STEPS, dwell=DWELL)
    assert drive < 1.5
