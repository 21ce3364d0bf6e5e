"""Runs in path coordinates: within their limits, everywhere in E, and the same
as logs of the world.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, any_law

from sfkd_jax.driving import plants
from sfkd_jax.driving.drives import check_on_path, generate_along_path
from sfkd_jax.driving.scenarios import DriveClass, random_drive
from sfkd_jax.types import BODY, POSE

PLANT = plants.kinematic()
LAW = any_law()
LOOP = plants.along_path(PLANT, LAW)
BOX = {"env_low": ENV_LOW, "env_high": ENV_HIGH}


@pytest.fixture(scope="module")
def runs():
    return jax.jit(partial(generate_along_path, LOOP, segments=64, steps=30, **BOX))(
        jax.random.key(3)
    )


def test_roads_speeds_and_perturbations_are_as_asked(runs):
    given = runs.controls
    nu, curvature, speed = given[..., :2], given[..., 2], given[..., 3]
    assert runs.states.shape == (64, 31, 6)
    assert runs.controls.shape == (64, 30, 4)
    assert not np.any(np.asarray(runs.states[..., POSE]))
    assert np.all(np.abs(curvature) <= 0.05 + 1e-6)
    assert np.all((speed >= 3.0) & (speed <= 12.0))
    assert np.all(np.abs(curvature) * speed**2 <= 2.0 + 1e-4)
    assert np.all(np.abs(nu) <= np.asarray(LOOP.control_high[:2]) + 1e-6)
    assert np.ptp(speed, axis=1).max() > 0.2


def test_a_quarter_of_the_environments_is_held_another_switches_and_both_reach_the_corners(
    runs,
):
    held = runs.envs[32:]
    assert np.all(held[:16] == held[:16, :1])
    jumps = np.any(np.diff(held[16:], axis=1) != 0, axis=2)
    for run in jumps:
        assert np.all(np.diff(np.flatnonzero(run)) >= 14)  # 1.5 s, less a step
    ends = (held[:, 0] <= np.asarray(ENV_LOW)) | (held[:, 0] >= np.asarray(ENV_HIGH))
    assert 0.0 < np.mean(np.all(ends, axis=1)) < 0.35  # of 32, a ninth in the mean


def test_every_step_is_one_of_the_loop(runs):
    batch = jax.vmap(jax.vmap(LOOP.step))
    expected = batch(runs.states[:, :-1], runs.controls, runs.envs)
    np.testing.assert_allclose(expected, runs.states[:, 1:], atol=1e-5)


def test_held_out_runs_keep_the_levels_of_s3():
    make = partial(generate_along_path, LOOP, segments=4, steps=40, **BOX)
    s3 = jax.jit(partial(make, held_out=True))(jax.random.key(0))
    levels = np.asarray(s3.envs)[..., :1] - [0.3, 0.6, 0.9]
    assert np.all(np.min(np.abs(levels), axis=-1) < 1e-6)


def test_runs_that_left_their_path_are_refused(runs):
    check_on_path(runs)
    lost = runs._replace(states=runs.states.at[5, 3, BODY.start].set(60.0))
    lost = lost._replace(controls=lost.controls.at[5, 3, 2].set(0.02))
    with pytest.raises(ValueError, match="1 of 64 runs left their path"):
        check_on_path(lost)


def test_drives_of_every_group_stay_in_their_class_and_reach_its_ends():
    drive = partial(random_drive, limits=DriveClass(), steps=300, dt=0.1)
    groups = jnp.repeat(jnp.arange(3), 40)
    speed, curvature = jax.jit(jax.vmap(drive))(
        jax.random.split(jax.random.key(0), 120), groups
    )
    turning = np.abs(curvature) * speed**2
    slope = np.abs(np.diff(curvature)) / (0.1 * speed[:, 1:])
    rate = np.abs(np.diff(speed)) / 0.1
    left = np.sqrt(np.maximum(1.0 - (turning[:, :-1] / 2.0) ** 2, 0.0))
    for value, most in (
        (np.abs(curvature), 0.05),
        (turning, 2.0),
        (slope, 0.02),
        (slope * speed[:, 1:] ** 3, 7.0),
        (speed, 12.0),
        (3.0 / speed, 1.0),
    ):
        each = np.max(np.asarray(value).reshape(3, -1), axis=1)
        assert np.all(each <= most * 1.001)
        assert np.max(each) >= most * 0.999
    assert np.all(rate <= 2.0 * left + 1e-3)
    assert np.max(rate[:40]) < 2.0 <= np.max(rate[40:80]) + 1e-3
    # Lane changes turn to both sides and straight on between them.
    lanes = np.asarray(curvature[80:])
    assert np.mean(np.min(lanes, axis=1) < 0.0) > 0.9
