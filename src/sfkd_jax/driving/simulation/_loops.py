"""Episodes in closed loop, with imperfect sensors and side forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.paths import reference_window
from sfkd_jax.driving.plants import Vehicle, equivalent_wind, late_loop
from sfkd_jax.driving.scenarios import Scenario, in_view, random_side_forces
from sfkd_jax.driving.simulation._control_step import (
    ClosedLoop,
    LoopState,
    Surroundings,
)
from sfkd_jax.driving.simulation.metrics import SIGNALS, Signal
from sfkd_jax.latency import NO_LATENCY, Latency
from sfkd_jax.ranges import Real
from sfkd_jax.types import Controller, Key, Params, Scalar, State, Step

FORCE_STREAM = 2
"""Number that is folded into an episode's key for the random side forces. The streams 0
and 1 are those of the planner and of the state sensors, which `split` makes.
"""
SENSOR_STREAM = 3
"""The same for the errors of the observed environment."""
LEAST_FRICTION = 0.05
"""Smallest friction that a faulty sensor shows [-]."""


class Episode(NamedTuple):
    """One closed-loop episode.

    Attributes:
        states: x_0 … x_T, (time + 1, state).
        controls: applied controls, (time, control).
        lateral: signed distance of x_1 … x_T from the path [m], (time,). On a course
            with obstacles it is from the reference that the controller follows.
        progress: arc length that x_1 … x_T have reached [m], (time,).
        signals: values that metrics or the caller recorded at every step, by name,
            each (time, …).
    """

    states: Float[Array, "time_plus_1 state"]
    controls: Float[Array, "time control"]
    lateral: Float[Array, " time"]
    progress: Float[Array, " time"]
    signals: dict[str, Any]


def simulate(
    plant: Step,
    controller: Controller,
    params: Params,
    scenario: Scenario,
    key: Key,
    *,
    dt: float,
    horizon: int,
    observation_noise: Sequence[float | Scalar] = (),
    latency: Latency = NO_LATENCY,
    size: tuple[float, float] | None = None,
    hidden: int = 0,
    record: Mapping[str, Signal] | None = None,
) -> Episode:
    """Simulate one episode.

    The plant is in `scenario.envs`, the controller observes `scenario.observed_envs`.
    Two systems with the same scenario and key follow the same path in the same
    environment, with the same sensor noise and sampling keys.

    On a course with obstacles the controller receives lane and obstacles in view in
    place of a reference. Two signals then say how near the car comes: `gap` is its true
    distance from the nearest obstacle [m], and `clearance` is the distance that the
    controller claims. Both are NaN where there is no such value.

    Args:
        plant: the true step.
        controller: of the car.
        params: of the controller's model.
        scenario: path, speed, environment and start.
        key: consumed.
        dt: sampling period [s].
        horizon: length of the reference window.
        observation_noise: standard deviation per state. States beyond its length are
            observed without noise; entries beyond the states are not used.
        latency: of sensors and controls, see `plants.Late`. The reference begins where
            the vehicle is observed.
        size: length and width of the car [m], which a course needs.
        hidden: number of entries of the plant's state after those of the scenario's
            start, which are not observed and begin at 0.
        record: more signals of every step, by name, besides those of the metrics.

    Raises:
        ValueError: a course without the size of the car.
    """
    if scenario.course is not None and size is None:
        raise ValueError("obstacles on the road need the size of the car: vehicle.size")
    # Sensors have a key of their own, so that two systems meet the same noise.
    planner_key, noise_key = jax.random.split(key)
    recorded = SIGNALS | dict(record or {})
    observed = len(scenario.initial_state)
    noise_keys = jax.random.split(noise_key, scenario.envs.shape[0])
    loop = ClosedLoop(
        plant=plant,
        controller=controller,
        late=late_loop(latency, states=observed, dt=dt),
        spread=_spread(observation_noise, observed),
        size=None if scenario.course is None else size,
    )
    ahead_of = partial(_ahead, scenario, dt=dt, horizon=horizon)

    def step(
        before: LoopState, inputs: tuple[Array, Array, Key]
    ) -> tuple[LoopState, Any]:
        env, observed_env, sensor_key = inputs
        around = Surroundings(env, observed_env, scenario.path, scenario.speed)
        after, outcome = loop.step(params, before, around, ahead_of, sensor_key)
        signals = {name: signal(outcome.info) for name, signal in recorded.items()}
        return after, (*outcome[:-1], signals)

    first = scenario.initial_state
    start = loop.start(first, planner_key, hidden=hidden)
    inputs = (scenario.envs, scenario.observed_envs, noise_keys)
    _, (states, *rest) = jax.lax.scan(step, start, inputs)
    return Episode(jnp.concatenate([first[None], states]), *rest)


def _spread(levels: Sequence[float | Scalar], states: int) -> State:
    """Return the standard deviation of every state; 0 beyond those that are given."""
    known = jnp.asarray(levels, dtype=float)[:states]
    return jnp.zeros(states).at[: len(known)].set(known)


def _ahead(scenario: Scenario, progress: Scalar, *, dt: float, horizon: int) -> Any:
    """Return what a controller is shown: a reference, or lane and obstacles.

    Args:
        scenario: with its path or course.
        progress: arc length at which the vehicle is observed [m].
        dt: sampling period [s].
        horizon: length of the reference.
    """
    if scenario.course is not None:
        return scenario.course.lane, in_view(scenario.course, progress)
    return reference_window(
        scenario.path, progress, scenario.speed, dt=dt, horizon=horizon
    )


def observed_environment(
    envs: Float[Array, "time environment"],
    key: Key,
    *,
    dt: float,
    delay_s: float = 0.0,
    noise: tuple[float, float] = (0.0, 0.0),
    bias: tuple[Real, Real] = (0.0, 0.0),
) -> Float[Array, "time environment"]:
    """Return ê_k = e_{k−d} + b + n_k: delayed, biased, with white noise.

    Until the first delayed value arrives, the first value of the episode is observed.
    Observed friction is at least 0.05, unless the sensor is perfect.

    Args:
        envs: the true environment.
        key: of the episode. It is not consumed, so that its other streams stay as they
            are.
        dt: sampling period [s].
        delay_s: d in seconds.
        noise: standard deviations of friction [-] and wind [m/s].
        bias: b of friction [-] and wind [m/s].
    """
    steps = round(delay_s / dt)
    delayed = jnp.concatenate([jnp.tile(envs[:1], (steps, 1)), envs])[: envs.shape[0]]
    white = jnp.asarray(noise) * jax.random.normal(
        jax.random.fold_in(key, SENSOR_STREAM), envs.shape
    )
    observed = delayed + jnp.asarray(bias) + white
    perfect = steps == 0 and not any(noise) and not any(bias)
    # A perfect sensor passes e on bit for bit, even if the friction is below 0.05.
    if perfect:
        return envs
    return observed.at[:, 0].max(LEAST_FRICTION)


def disturbed_environment(
    plant: Vehicle,
    envs: Float[Array, "time environment"],
    key: Key,
    *,
    largest: float | Float[Array, ""],
) -> Float[Array, "time environment"]:
    """Return the environment with random side forces, expressed as additional wind.

    Args:
        plant: whose wind force it is.
        envs: the environment without these forces.
        key: of the episode. It is not consumed, so that its other streams stay as they
            are.
        largest: F, forces lie in [-F, F] [N].

    Raises:
        ValueError: wind does not act on this plant.
    """
    if not plant.wind_force:
        raise ValueError(
            "evaluation.side_forces act through the wind, but vehicle.wind_force is 0"
        )
    force = random_side_forces(
        jax.random.fold_in(key, FORCE_STREAM),
        steps=envs.shape[0],
        dt=plant.dt,
        largest=largest,
    )
    # Plants have no other input from the side than wind.
    wind = jax.vmap(partial(equivalent_wind, wind_force=plant.wind_force))
    return envs.at[:, 1].set(wind(envs[:, 1], force))
