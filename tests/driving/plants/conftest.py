"""Two plants, double precision for comparisons with formulas, and simulation helpers."""

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sfkd_jax.driving.plants import dynamic, kinematic

# One object a setting, so one compilation.
PLANTS = {"kinematic": cache(kinematic), "dynamic": cache(dynamic)}
LONGEST = 300


class Drawn(NamedTuple):
    """Rows of random inputs of a step."""

    states: jax.Array
    controls: jax.Array
    envs: jax.Array


HIGHEST = np.asarray([50.0, 50.0, 3.0, 25.0, 4.0, 1.5, 0.5])
LOWEST = np.asarray([-50.0, -50.0, -3.0, 0.0, -4.0, -1.5, -0.5])
ENV_LIMITS = [(0.3, 0.9), (-8, 8)]


@pytest.fixture(params=list(PLANTS))
def factory(request) -> Callable:
    return PLANTS[request.param]


@pytest.fixture
def vehicle(factory):
    return factory()


@pytest.fixture
def coasting(factory):
    """The same plant without drag and rolling resistance: only tyres and wind
    accelerate it.
    """
    return factory(drag=0.0, rolling=0.0)


@pytest.fixture
def x64() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@partial(jax.jit, static_argnums=0)
def _hold(step, state, control, env):
    def move(x, _):
        x = step(x, control, env)
        return x, x

    return jnp.concatenate(
        [state[None], jax.lax.scan(move, state, None, length=LONGEST)[1]]
    )


@cache
def _many(step):
    return jax.jit(jax.vmap(step))


@pytest.fixture
def many() -> Callable:
    """Step -> the same step on batches."""
    return _many


@pytest.fixture(scope="session")
def dynamic_plant() -> Callable:
    return PLANTS["dynamic"]


@pytest.fixture
def hold() -> Callable:
    """(vehicle, speed or state, control, env, seconds) -> states x_0 … x_T under a
    control that is held.
    """

    def drive(vehicle, start, control, env, seconds):
        steps = round(seconds / vehicle.dt)
        assert steps <= LONGEST
        size = len(vehicle.state_names)
        state = jnp.zeros(size).at[3].set(start) if jnp.ndim(start) == 0 else start
        return _hold(vehicle.step, state, jnp.array(control), jnp.array(env))[
            : steps + 1
        ]

    return drive


@pytest.fixture
def sweep() -> Callable:
    """(vehicle, count, overdrive) -> random states, controls and envs; every second row
    sits on the bounds.
    """

    def draw(vehicle, count, overdrive=1.0):
        random, size = np.random.default_rng(0), len(vehicle.state_names)
        controls = overdrive * np.array([vehicle.control_low, vehicle.control_high]).T
        states = np.stack([LOWEST, HIGHEST], axis=1)[:size]
        low, high = np.concatenate([states, controls, ENV_LIMITS]).T
        share = random.uniform(size=(count, low.size))
        share[1::2] = np.round(2 * share[1::2]) / 2
        rows = jnp.asarray(low + (high - low) * share)
        return Drawn(*jnp.split(rows, [size, size + 2], axis=1))

    return draw
