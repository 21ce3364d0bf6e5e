"""The systems among the examples can be certified: they have steady states and a law."""

import runpy
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.systems import System, Tracked, integrated, regulation, steady_states

EXAMPLES = sorted((Path(__file__).parents[2] / "examples" / "systems").glob("*.py"))


def tracked_of(example):
    """The system of an example in the coordinates of its frame."""
    system, frame = runpy.run_path(str(example))["make"]()
    return Tracked(system, frame)


def check(tracked, key):
    """The checks with which `certify_system` begins."""
    error = jnp.zeros(len(tracked.names))
    tracked.system.check_step(tracked.state(error, tracked.middle))
    tracked.check_invariance(key)


def test_there_are_systems_of_our_own_and_of_two_simulators():
    assert len(EXAMPLES) == 8


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_and_follows_its_reference_everywhere(example, key):
    assert len(example.read_text("utf-8").splitlines()) <= 60
    tracked = tracked_of(example)
    check(tracked, key)
    variables = (*tracked.system.state_variables, *tracked.system.control_variables)
    assert all(variable.unit for variable in variables)
    assert all(noise > 0.0 for noise in tracked.system.sensor_noise)
    # It raises where a steady state is missing or needs more than the limits.
    steady = steady_states(tracked, points=2)
    assert np.isfinite(steady.slopes).all()
    assert np.abs(steady.states[:, list(tracked.held)]).max() == 0.0


def test_a_system_may_have_no_step_outside_the_ranges_of_its_reference(key):
    """As an aircraft, which does not fly at a speed of 0."""

    def rates(state, control, env):
        return [control[0] - env[0] / state[0]]

    system = System(
        integrated(rates, dt=0.1),
        dt=0.1,
        states={"speed [m/s]": 0.01},
        controls={"push [N]": (-1.0, 1.0)},
        environment={"drag": (1.0, 2.0)},
    )
    frame = regulation(
        {"speed": ("speed",)},
        set_points={"speed": (10.0, 20.0)},
        rates={"speed": 0.1},
    )
    tracked = Tracked(system, frame)
    check(tracked, key)
    with pytest.raises(ValueError, match="is not finite"):
        system.check_step(jnp.zeros(1))
