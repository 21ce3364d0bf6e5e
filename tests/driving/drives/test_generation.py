"""Generated driving: repeatable, obedient to the plant, exciting, all over the box."""

from functools import partial

import jax
import numpy as np
import pytest
from helpers import ENV_HIGH, ENV_LOW, driver, generator, jit, segments

from sfkd_jax.driving import drives, plants


@pytest.fixture(scope="module")
def data():
    return jax.tree.map(np.asarray, segments())


def test_the_same_key_makes_the_same_data_and_another_key_other_data():
    first, again, other = (generator()(jax.random.key(seed)) for seed in (3, 3, 4))
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, c)


def test_every_state_is_the_plants_step_from_the_one_before(data):
    step = jit(jax.vmap(jax.vmap(plants.kinematic().step)))
    expected = step(data.states[:, :-1], data.controls, data.envs)
    np.testing.assert_allclose(data.states[:, 1:], expected, rtol=0, atol=2e-5)


def test_controls_respect_the_actuators_quietly_and_violently(data):
    plant = plants.kinematic()
    assert np.all(data.controls >= np.float32(plant.control_low))
    assert np.all(data.controls <= np.float32(plant.control_high))
    spread = data.controls.std(axis=1)
    quiet, violent = np.quantile(spread, [0.1, 0.9], axis=0)
    assert np.all(violent > 3 * quiet)


def test_the_controls_are_persistently_exciting(data):
    """Willems: the block Hankel matrix of depth L has full row rank; with margin, in
    units of each channel's spread.
    """
    depth = 6
    scaled = (data.controls - data.controls.mean(axis=(0, 1))) / data.controls.std(
        axis=(0, 1)
    )
    columns = [
        piece[k : k + depth].ravel()
        for piece in scaled
        for k in range(len(piece) - depth + 1)
    ]
    hankel = np.stack(columns, axis=1) / np.sqrt(len(columns))
    assert hankel.shape[0] == 2 * depth < hankel.shape[1]
    assert np.linalg.svd(hankel, compute_uv=False)[-1] > 0.1


def test_the_environment_covers_its_box(data):
    low, high = data.envs.min(axis=(0, 1)), data.envs.max(axis=(0, 1))
    assert np.all(low >= np.float32(ENV_LOW) - 1e-6)
    assert np.all(high <= np.float32(ENV_HIGH) + 1e-6)
    size = np.subtract(ENV_HIGH, ENV_LOW)
    assert np.all(high - low > 0.95 * size)
    cells = np.clip(((data.envs.reshape(-1, 2) - ENV_LOW) / size * 4).astype(int), 0, 3)
    assert (
        len(np.unique(cells, axis=0)) >= 14
    )  # of 16: friction in quarters x wind in quarters


def test_no_key_is_used_twice():
    plant = plants.kinematic()
    make = partial(drives.generate, plant, driver(plant), segments=8, steps=5)
    with jax.debug_key_reuse(True):
        jax.jit(make)(jax.random.key(0))


def test_held_out_runs_meet_the_levels_of_s3_at_random_times():
    plant = plants.kinematic()
    make = partial(drives.generate, plant, driver(plant), segments=40, held_out=True)
    data = jax.tree.map(np.asarray, jit(make)(jax.random.key(0)))
    levels = {
        (round(float(mu), 3), abs(round(float(wind), 3)))
        for mu, wind in data.envs.reshape(-1, 2)
    }
    assert levels == {(0.9, 0.0), (0.6, 4.0), (0.3, 8.0)}
    switches = np.any(np.diff(data.envs, axis=1) != 0, axis=2)
    assert np.all(switches.sum(axis=1) >= 1)  # 5 s hold at least one switch every 3 s
    assert len(np.unique(switches.argmax(axis=1))) > 10  # not always at the same moment
