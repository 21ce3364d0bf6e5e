"""The drone's windows: its references are of the certified class, and walls are hard."""

import runpy

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import drone
from sfkd_jax.systems import Tracked

LENGTH = 280
COURSES = 20


@pytest.fixture(scope="module")
def courses():
    """The drone in the coordinates of its frame, and courses for it."""
    tracked = Tracked(*runpy.run_path(str(drone.EXAMPLE))["make"]())
    keys = jax.random.split(jax.random.key(8), COURSES)
    drawn = jax.vmap(lambda key: drone.random_course(tracked, key, length=LENGTH))(keys)
    return tracked, drawn


def test_references_through_windows_are_of_the_certified_class(courses):
    tracked, drawn = courses
    low, high = map(np.asarray, tracked.frame.input_box)
    for points in drawn.points:
        rates = tracked.rates_between(points)
        moves = jax.vmap(tracked.moves)(points[:-1], rates, points[1:])
        assert bool(jnp.all(moves))
        assert np.all((rates > low - 1e-3) & (rates < high + 1e-3))
        changes = np.flatnonzero(np.abs(np.diff(rates, axis=0)).max(axis=1) > 0.01)
        shortest = tracked.frame.dwell[0] / tracked.system.dt
        assert np.all(np.diff(changes) >= shortest)
        # It flies forwards, so that it passes every window once.
        assert np.all(points[1:, 1] > 0.0)


def test_a_cage_passes_a_window_within_the_bound_and_hits_its_edge_beyond(courses):
    _, drawn = courses
    bound = 0.08
    half = drone.RADIUS + bound
    for points, windows in zip(drawn.points, drawn.windows, strict=True):
        path = np.asarray(points[:, [0, 2]])
        gaps = np.asarray(windows)

        def gap(away, path=path, gaps=gaps):
            return drone.clearances(path + np.asarray(away), gaps, half).min()

        # A place between two of the path is up to 1 mm off its line.
        np.testing.assert_allclose(gap((0.0, 0.0)), bound, atol=1e-3)
        assert gap((0.0, 0.9 * bound)) > 0.0
        assert gap((0.0, -0.9 * bound)) > 0.0
        assert gap((0.0, 1.1 * bound)) < 0.0
        assert gap((0.0, -1.1 * bound)) < 0.0
        assert gap((0.0, 3.0)) == pytest.approx(-drone.RADIUS, abs=0.02)
