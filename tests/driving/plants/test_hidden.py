"""States that a vehicle has and no sensor shows: they go on, and nobody is told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import jit

from sfkd_jax.driving import drives, plants, scenarios, simulation
from sfkd_jax.types import Controller
from tests.driving.plants import simulators

OPEN = plants.with_servo(plants.kinematic(), lag=0.2, rate=0.5)
"""A car whose steering angle is its last state."""
HIDDEN = OPEN._replace(states=OPEN.states[:-1], hidden=1)
"""The same car without a sensor of it."""
ENV_LOW = (0.5, -1.0)
ENV_HIGH = (0.9, 1.0)


def law(xi, curvature, speed, env):
    """A law that asks for nothing but what both cars show."""
    steering = 2.7 * curvature - 0.1 * xi[0] - 1.0 * xi[1]
    return jnp.stack([steering, speed - xi[2]])


def test_a_run_along_a_path_is_that_of_the_same_car_with_a_sensor_more():
    key = jax.random.key(0)
    options = {"segments": 8, "steps": 20, "env_low": ENV_LOW, "env_high": ENV_HIGH}
    runs = {}
    for car in (OPEN, HIDDEN):
        loop = plants.along_path(car, law)
        along = jit(
            lambda key, loop=loop: drives.generate_along_path(loop, key, **options)
        )
        runs[car.hidden] = along(key)
    assert runs[1].states.shape[-1] == runs[0].states.shape[-1] - 1
    np.testing.assert_array_equal(runs[1].states, runs[0].states[..., :-1])
    np.testing.assert_array_equal(runs[1].controls, runs[0].controls)
    # The servo matters: a car that forgets it at every step drives otherwise.
    forgetting = plants.along_path(HIDDEN.forgetting(), law)
    others = drives.generate_along_path(forgetting, key, **options)
    assert np.abs(np.asarray(others.states - runs[1].states)).max() > 0.01


def test_so_is_a_run_without_a_path():
    options = {"speed": (5.0, 9.0), "lateral_acceleration": 2.0, "segments": 4}
    options |= {"steps": 20, "env_low": ENV_LOW, "env_high": ENV_HIGH}
    seen, unseen = (
        drives.generate_open_loop(car, jax.random.key(1), **options)
        for car in (OPEN, HIDDEN)
    )
    np.testing.assert_array_equal(unseen.states, seen.states[..., :-1])


def test_a_controller_is_not_shown_what_is_hidden():
    shapes = []

    def act(params, memory, observation, env, ahead):
        shapes.append(observation.shape)
        steering = jnp.clip(0.1 * (ahead[5, 2] - observation[2]), -0.3, 0.3)
        return jnp.stack([steering, 0.1]), memory, {}

    driver = Controller(lambda key: (), act)
    episodes = []
    for car in (OPEN, HIDDEN):
        family = scenarios.scenario(
            name="s3", duration=4.0, state_size=len(car.states), dt=car.dt
        )
        episodes.append(
            simulation.simulate(
                car.step,
                driver,
                {},
                family(jax.random.key(2)),
                jax.random.key(3),
                dt=car.dt,
                horizon=8,
                hidden=car.hidden,
            )
        )
    seen, unseen = episodes
    assert shapes == [(5,), (4,)]
    np.testing.assert_array_equal(unseen.states, seen.states[:, :-1])
    np.testing.assert_array_equal(unseen.lateral, seen.lateral)


def test_a_simulator_names_them_after_the_others():
    make = f"{simulators.__name__}:Remembering"
    car = plants.simulator(make)
    assert (len(car.states), car.hidden) == (4, 4)
    plants.check_step(car, environments=1)
    box = {"speed": (0.5, 3.0), "env_low": (0.0,), "env_high": (1.0,)}
    assert plants.hidden_change(make, car, **box) == {}
    state = car.whole(jnp.asarray([0.0, 0.0, 0.0, 2.0]))
    control = jnp.asarray([0.4, 0.0])
    for share in (0.5, 0.75):
        state = car.step(state, control, jnp.zeros(1))
        np.testing.assert_allclose(state[-1], share * 0.4, rtol=1e-6)


def test_what_cannot_know_them_is_refused():
    with pytest.raises(ValueError, match="has hidden states, and its servo belongs"):
        plants.with_servo(HIDDEN, lag=0.1)
