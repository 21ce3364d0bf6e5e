"""Whole episodes as one scan: plant, controller, path and weather together."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.scenarios import Scenario, project, reference_window, side_pushes
from sfkd_jax.types import Controller, Key, Params, Scalar, State, Step
from sfkd_jax.vehicle import Vehicle, equivalent_wind

PUSHES = 2
"""Folded into an episode's key; `split` gives the planner and the sensors the streams 0
and 1.
"""


class Episode(NamedTuple):
    """What happened.

    Attributes:
        states: x_0 … x_T (time + 1, state).
        controls: applied (time, control).
        lateral: signed distance of x_1 … x_T from the path [m], (time,).
        progress: arc length reached [m], (time,).
        effective_samples: of the planner, (time,).
        healthy: whether it trusted its plan, (time,).
        prediction_error: one-step position error of the planner's model [m], (time,).
        believed: e as the controller took it to be, its own estimate or what it was
            told, (time, environment).
        breach, box_exit: flags of a monitor, False without one, (time,).
    """

    states: Float[Array, "time_plus_1 state"]
    controls: Float[Array, "time control"]
    lateral: Float[Array, " time"]
    progress: Float[Array, " time"]
    effective_samples: Float[Array, " time"]
    healthy: Array
    prediction_error: Float[Array, " time"]
    believed: Float[Array, "time environment"]
    breach: Array
    box_exit: Array


def simulate(
    plant: Step,
    controller: Controller,
    params: Params,
    scenario: Scenario,
    key: Key,
    *,
    dt: float,
    horizon: int,
    observation_noise: tuple[float, ...] = (),
    met: Float[Array, "time 2"] | None = None,
) -> Episode:
    """Drive one episode with the environment measured at every step.

    Two systems given the same scenario and key meet the same path, weather, sensor
    noise and sampler stream.

    Args:
        plant: the true step.
        controller, params: who drives.
        scenario: what to drive.
        key: consumed.
        dt: sampling period [s].
        horizon: length of the reference window.
        observation_noise: standard deviation per state, entries beyond the state are
            not used; () for none.
        met: the environment that the plant meets, where it is not the one that is
            measured.
    """
    planner_key, noise_key = jax.random.split(key)
    known = jnp.asarray(observation_noise, dtype=float)[
        : scenario.initial_state.shape[0]
    ]
    spread = jnp.zeros_like(scenario.initial_state).at[: known.shape[0]].set(known)
    noise_keys = jax.random.split(noise_key, scenario.envs.shape[0])

    def step(
        carry: tuple[State, Scalar, Any], inputs: tuple[Array, Array, Key]
    ) -> tuple[Any, Any]:
        state, progress, planner = carry
        env, met_env, sensor_key = inputs
        observation = state + spread * jax.random.normal(sensor_key, state.shape)
        reference = reference_window(
            scenario.path, progress, scenario.speed, dt=dt, horizon=horizon
        )
        control, planner, info = controller.act(
            params, planner, observation, env, reference
        )
        state = plant(state, control, met_env)
        progress, lateral = project(
            scenario.path, state[:2], progress + scenario.speed * dt
        )
        miss = jnp.linalg.norm(info["predicted_states"][0, :2] - state[:2])
        flags = [jnp.asarray(info.get(name, False)) for name in ("breach", "box_exit")]
        seen = (
            info["effective_samples"],
            info["healthy"],
            miss,
            info.get("env_estimate", env),
        )
        record = (state, control, lateral, progress, *seen, *flags)
        return (state, progress, planner), record

    start = (scenario.initial_state, jnp.zeros(()), controller.init(planner_key))
    inputs = (scenario.envs, scenario.envs if met is None else met, noise_keys)
    _, (states, *rest) = jax.lax.scan(step, start, inputs)
    return Episode(jnp.concatenate([scenario.initial_state[None], states]), *rest)


def pushed(
    plant: Vehicle,
    envs: Float[Array, "time 2"],
    key: Key,
    *,
    largest: float | Float[Array, ""],
) -> Float[Array, "time 2"]:
    """The environment that a car meets which is also pushed sideways: the wind holds a force that nobody measures.

    Args:
        plant: whose wind it is.
        envs: as measured.
        key: of the episode, and not consumed: its other streams stay what they are
            without a push.
        largest: F, forces lie in [-F, F] [N].

    Raises:
        ValueError: a plant on which wind has no force.
    """
    if not plant.wind_force:
        raise ValueError(
            "evaluation.side_forces push through the wind, and vehicle.wind_force is 0"
        )
    force = side_pushes(
        jax.random.fold_in(key, PUSHES),
        steps=envs.shape[0],
        dt=plant.dt,
        largest=largest,
    )
    wind = jax.vmap(partial(equivalent_wind, wind_force=plant.wind_force))(
        envs[:, 1], force
    )
    return envs.at[:, 1].set(wind)


def first_reference(
    scenario: Scenario, *, horizon: int, dt: float
) -> Float[Array, "horizon 4"]:
    """The reference window at the start of an episode."""
    return reference_window(
        scenario.path, jnp.zeros(()), scenario.speed, dt=dt, horizon=horizon
    )
