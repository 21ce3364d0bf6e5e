"""Whole episodes as one scan: plant, controller, path and weather together."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.scenarios import Scenario, project, reference_window
from sfkd_jax.types import Controller, Key, Params, Scalar, State, Step


class Episode(NamedTuple):
    """What happened.

    Attributes:
        states: x_0 … x_T (time + 1, state). controls: applied (time, control).
        lateral: signed distance of x_1 … x_T from the path [m], (time,).
        progress: arc length reached [m], (time,).
        effective_samples: of the planner, (time,). healthy: whether it trusted its plan, (time,).
        prediction_error: one-step position error of the planner's model [m], (time,).
    """

    states: Float[Array, "time_plus_1 state"]
    controls: Float[Array, "time control"]
    lateral: Float[Array, " time"]
    progress: Float[Array, " time"]
    effective_samples: Float[Array, " time"]
    healthy: Array
    prediction_error: Float[Array, " time"]


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
) -> Episode:
    """Drive one episode with the environment measured at every step.

    Two systems given the same scenario and key meet the same path, weather, sensor noise and sampler stream.

    Args:
        plant: the true step. controller, params: who drives.
        scenario: what to drive. key: consumed.
        dt: sampling period [s]. horizon: length of the reference window.
        observation_noise: standard deviation per state, entries beyond the state are not used; () for none.
    """
    planner_key, noise_key = jax.random.split(key)
    known = jnp.asarray(observation_noise, dtype=float)[: scenario.initial_state.shape[0]]
    spread = jnp.zeros_like(scenario.initial_state).at[: known.shape[0]].set(known)
    noise_keys = jax.random.split(noise_key, scenario.envs.shape[0])

    def step(carry: tuple[State, Scalar, Any], inputs: tuple[Array, Key]) -> tuple[Any, Any]:
        state, progress, planner = carry
        env, sensor_key = inputs
        observation = state + spread * jax.random.normal(sensor_key, state.shape)
        reference = reference_window(scenario.path, progress, scenario.speed, dt=dt, horizon=horizon)
        control, planner, info = controller.act(params, planner, observation, env, reference)
        state = plant(state, control, env)
        progress, lateral = project(scenario.path, state[:2], progress + scenario.speed * dt)
        miss = jnp.linalg.norm(info["predicted_states"][0, :2] - state[:2])
        record = (state, control, lateral, progress, info["effective_samples"], info["healthy"], miss)
        return (state, progress, planner), record

    start = (scenario.initial_state, jnp.zeros(()), controller.init(planner_key))
    _, (states, *rest) = jax.lax.scan(step, start, (scenario.envs, noise_keys))
    return Episode(jnp.concatenate([scenario.initial_state[None], states]), *rest)


def first_reference(scenario: Scenario, *, horizon: int, dt: float) -> Float[Array, "horizon 4"]:
    """The reference window at the start of an episode."""
    return reference_window(scenario.path, jnp.zeros(()), scenario.speed, dt=dt, horizon=horizon)
