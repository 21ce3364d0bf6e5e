"""A thousand steps of a shipped policy while its inputs are wrong every few seconds.

`benchmarks/robustness/soak.py` drives the same loop for 10^5 steps, one call of `act` each; here it is one scan.
"""

from functools import cache

import jax
import numpy as np
import pytest
from helpers import jit

from benchmarks.robustness import faults, faulty_road

STEPS = 1000
RELEASE = 10
"""Steps for which the shipped monitor's fallback stays active after the last flag."""


@cache
def driven():
    """The loop, the fault at each step, and (controls, distance, lost, healthy, entries
    not finite).
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(faults, "PAUSE", (2 * RELEASE + 2, 40))
        loop = faulty_road.track("kinematic", samples=8, steps=STEPS)
        road = jit(lambda key: loop.road(key, np.random.default_rng(1)))(
            jax.random.key(0)
        )

    @jit
    def run(key):
        def step(carry, _):
            world, observed, state = carry
            control, state, info = loop.act(loop.params, state, observed)
            world, lateral, lost = loop.advance(road, world, control)
            record = (
                control,
                lateral,
                lost,
                info["healthy"],
                faulty_road.not_finite(state),
            )
            return (*loop.sense(road, world), state), record

        start = (*loop.sense(road, loop.enter(road)), loop.init(key))
        return jax.lax.scan(step, start, length=STEPS)[1]

    kinds = np.asarray(road.faults.kind)
    assert set(kinds) == {-1, *range(len(faults.KINDS))}
    return loop, kinds, jax.tree.map(np.asarray, run(jax.random.key(0)))


def test_every_control_is_finite_and_within_the_limits():
    loop, _, (controls, *_) = driven()
    assert np.all((loop.low <= controls) & (controls <= loop.high))


def test_nothing_that_is_not_finite_outlasts_its_fault():
    _, kinds, (*_, left) = driven()
    assert np.max(left[kinds < 0]) == 0


def test_after_every_fault_the_controller_trusts_its_plan_again():
    _, kinds, (_, _, _, healthy, _) = driven()
    for end in np.flatnonzero((kinds[:-1] >= 0) & (kinds[1:] < 0)) + 1:
        assert np.any(healthy[end : end + 2 * RELEASE + 1])


def test_between_faults_the_car_follows_its_path():
    _, kinds, (_, lateral, *_) = driven()
    assert np.median(np.abs(lateral[kinds < 0])) < 0.1
