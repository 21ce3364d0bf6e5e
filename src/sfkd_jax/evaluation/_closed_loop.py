"""Simulate closed-loop episodes: plant, controller and scenario in one scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.evaluation.metrics import SIGNALS, Signal
from sfkd_jax.scenarios import Scenario, project, reference_window
from sfkd_jax.types import Controller, Key, Params, Scalar, State, Step


class Episode(NamedTuple):
    """One closed-loop episode.

    Attributes:
        states: x_0 … x_T (time + 1, state).
        controls: applied (time, control).
        lateral: signed distance of x_1 … x_T from the path [m], (time,).
        progress: arc length reached [m], (time,).
        assumed_envs: e that the controller planned with, observed or estimated,
            (time, environment).
        signals: what metrics and the caller recorded of every step, by name,
            (time, …).
    """

    states: Float[Array, "time_plus_1 state"]
    controls: Float[Array, "time control"]
    lateral: Float[Array, " time"]
    progress: Float[Array, " time"]
    assumed_envs: Float[Array, "time environment"]
    signals: dict[str, Any]


Result = TypeVar("Result")


def over_episodes(run: Callable[..., Result]) -> Callable[..., Result]:
    """Return the function that runs every episode of a batch.

    On a single CPU one episode follows the other: the samples of one plan stay in its
    caches, those of all episodes do not. On accelerators, or several devices, all run
    at once.

    Args:
        run: one episode, such as `simulate` with its first arguments bound.

    Returns:
        A function of the same arguments with a leading axis of episodes.
    """
    if jax.default_backend() != "cpu" or len(jax.devices()) > 1:
        return jax.vmap(run)
    return lambda *batch: jax.lax.map(lambda one: run(*one), batch)


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
    record: Mapping[str, Signal] | None = None,
) -> Episode:
    """Simulate one episode.

    The plant is in `scenario.envs`, the controller observes `scenario.observed_envs`.
    Two systems given the same scenario and key follow the same path in the same
    environment, with the same sensor noise and sampling keys.

    Args:
        plant: the true step.
        controller: of the car.
        params: of the controller's model.
        scenario: path, speed, environment and start.
        key: consumed.
        dt: sampling period [s].
        horizon: length of the reference window.
        observation_noise: standard deviation per state, entries beyond the state are
            not used; () for none.
        record: more signals of every step, by name, besides those of the metrics.
    """
    # Sensors have their own stream: two systems meet the same noise.
    planner_key, noise_key = jax.random.split(key)
    wanted = SIGNALS | dict(record or {})
    spread = _noise_levels(observation_noise, scenario.initial_state)
    noise_keys = jax.random.split(noise_key, scenario.envs.shape[0])

    def step(
        carry: tuple[State, Scalar, Any], inputs: tuple[Array, Array, Key]
    ) -> tuple[Any, Any]:
        state, progress, memory = carry
        env, observed_env, sensor_key = inputs
        # Noise reaches the controller, never the truth or the scores.
        observation = state + spread * jax.random.normal(sensor_key, state.shape)
        reference = reference_window(
            scenario.path, progress, scenario.speed, dt=dt, horizon=horizon
        )
        control, memory, info = controller.act(
            params, memory, observation, observed_env, reference
        )
        state = plant(state, control, env)
        # The guess moves on at the reference speed, so a loop does not catch it.
        progress, lateral = project(
            scenario.path, state[:2], progress + scenario.speed * dt
        )
        assumed = info.get("env_estimate", observed_env)
        signals = {name: signal(info) for name, signal in wanted.items()}
        recorded = (state, control, lateral, progress, assumed, signals)
        return (state, progress, memory), recorded

    start = (scenario.initial_state, jnp.zeros(()), controller.init(planner_key))
    inputs = (scenario.envs, scenario.observed_envs, noise_keys)
    _, (states, *rest) = jax.lax.scan(step, start, inputs)
    return Episode(jnp.concatenate([scenario.initial_state[None], states]), *rest)


def _noise_levels(observation_noise: tuple[float, ...], state: State) -> State:
    """Standard deviation of every state's sensor; 0 where none is given."""
    known = jnp.asarray(observation_noise, dtype=float)[: state.shape[0]]
    return jnp.zeros_like(state).at[: known.shape[0]].set(known)


def first_reference(
    scenario: Scenario, *, horizon: int, dt: float
) -> Float[Array, "horizon 4"]:
    """Return the reference window at the start of an episode."""
    return reference_window(
        scenario.path, jnp.zeros(()), scenario.speed, dt=dt, horizon=horizon
    )
