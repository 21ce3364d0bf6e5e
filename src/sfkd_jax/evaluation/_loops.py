"""Episodes in closed loop, with imperfect sensors and side forces; open-loop errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.evaluation.metrics import SIGNALS, Signal
from sfkd_jax.geometry import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    curvature_ahead,
    path_coordinates,
    wrap_angle,
)
from sfkd_jax.plants import Vehicle, equivalent_wind
from sfkd_jax.ranges import Real
from sfkd_jax.rollout import adjacent_windows, in_batches, rollout, state_errors
from sfkd_jax.scenarios import (
    Scenario,
    car_clearance,
    in_view,
    project,
    random_side_forces,
    reference_window,
)
from sfkd_jax.types import (
    BODY,
    Controller,
    Key,
    Model,
    Params,
    Scalar,
    State,
    Step,
    Trajectory,
)

FORCE_STREAM = 2
SENSOR_STREAM = 3
"""Folded into an episode's key; `split` gives the planner and the state sensors the
streams 0 and 1.
"""
LEAST_FRICTION = 0.05


class Episode(NamedTuple):
    """One closed-loop episode.

    Attributes:
        states: x_0 … x_T (time + 1, state).
        controls: applied (time, control).
        lateral: signed distance of x_1 … x_T from the path [m], or from the reference
            that a controller of scenes follows, (time,).
        progress: arc length reached [m], (time,).
        signals: what metrics and the caller recorded of every step, by name,
            (time, …).
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
    size: tuple[float, float] | None = None,
    record: Mapping[str, Signal] | None = None,
) -> Episode:
    """Simulate one episode.

    The plant is in `scenario.envs`, the controller observes `scenario.observed_envs`.
    Two systems given the same scenario and key follow the same path in the same
    environment, with the same sensor noise and sampling keys.

    On a course the controller is given the scene, lane and obstacles in view, in place
    of a reference. Two signals tell how near the car comes: `gap`, its true distance
    from the nearest obstacle [m], and `clearance`, what the controller claimed of it;
    NaN where there is none.

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
        size: length and width of the car [m], which a course needs.
        record: more signals of every step, by name, besides those of the metrics.

    Raises:
        ValueError: a course without the size of the car.
    """
    if scenario.course is not None and size is None:
        raise ValueError("obstacles on the road need the size of the car: vehicle.size")
    # Sensors have their own stream: two systems meet the same noise.
    planner_key, noise_key = jax.random.split(key)
    wanted = SIGNALS | dict(record or {})
    known = jnp.asarray(observation_noise, dtype=float)[: len(scenario.initial_state)]
    # A state that no level is given for is observed as it is.
    spread = jnp.zeros_like(scenario.initial_state).at[: len(known)].set(known)
    noise_keys = jax.random.split(noise_key, scenario.envs.shape[0])

    def step(
        carry: tuple[State, Scalar, Any], inputs: tuple[Array, Array, Key]
    ) -> tuple[Any, Any]:
        state, progress, memory = carry
        env, observed_env, sensor_key = inputs
        # Noise reaches the controller, never the truth or the scores.
        observation = state + spread * jax.random.normal(sensor_key, state.shape)
        if scenario.course is not None:
            ahead: Any = scenario.course.lane, in_view(scenario.course, progress)
        else:
            ahead = reference_window(
                scenario.path, progress, scenario.speed, dt=dt, horizon=horizon
            )
        control, memory, info = controller.act(
            params, memory, observation, observed_env, ahead
        )
        # The plant is in e, whatever the controller observed of it.
        state = plant(state, control, env)
        # The guess moves on at the reference speed, so a loop does not catch it.
        progress, lateral = project(
            scenario.path, state[:2], progress + scenario.speed * dt
        )
        if scenario.course is not None:
            assert size is not None
            info["gap"] = car_clearance(ahead[1], state, size=size)
            if "reference" in info:
                # Where the reference is one step later.
                follows = info["reference"]
                bend = curvature_ahead(follows)[0]
                lateral = path_coordinates(state, follows[0], bend)[LATERAL]
        signals = {name: signal(info) for name, signal in wanted.items()}
        return (state, progress, memory), (state, control, lateral, progress, signals)

    start = (scenario.initial_state, jnp.zeros(()), controller.init(planner_key))
    inputs = (scenario.envs, scenario.observed_envs, noise_keys)
    _, (states, *rest) = jax.lax.scan(step, start, inputs)
    return Episode(jnp.concatenate([scenario.initial_state[None], states]), *rest)


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
    Observed friction is at least 0.05.

    Args:
        envs: the true environment.
        key: of the episode, not consumed: its other streams stay what they are.
        dt: sampling period [s].
        delay_s: d in seconds.
        noise: standard deviations of friction [-] and wind [m/s].
        bias: of the same.
    """
    steps = round(delay_s / dt)
    # Until something arrives, a sensor shows what it showed before the start.
    delayed = jnp.concatenate([jnp.tile(envs[:1], (steps, 1)), envs])[: envs.shape[0]]
    white = jnp.asarray(noise) * jax.random.normal(
        jax.random.fold_in(key, SENSOR_STREAM), envs.shape
    )
    observed = delayed + jnp.asarray(bias) + white
    # A perfect sensor passes e on as it is, bit for bit, and below 0.05 too.
    faulty = steps or any(noise) or any(bias)
    return observed.at[:, 0].max(LEAST_FRICTION) if faulty else envs


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
        key: of the episode, not consumed: its other streams stay what they are.
        largest: F, forces lie in [-F, F] [N].
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
    # A force is passed on as wind: plants have no other input from the side.
    wind = jax.vmap(partial(equivalent_wind, wind_force=plant.wind_force))
    return envs.at[:, 1].set(wind(envs[:, 1], force))


def open_loop(
    model: Model, params: Params, trajectories: Trajectory, *, horizon: int
) -> Float[Array, "horizon column"]:
    """Return the RMSE of free-running predictions 1 … horizon steps ahead.

    Predictions start at every `horizon`-th step of each trajectory.

    Columns: along and across the true heading [m] (so that each axis means the same on
    every trajectory), yaw [rad], and the body state. In path coordinates: 0, e_y [m],
    e_ψ [rad], and the body state of the vehicle.

    Args:
        model: that predicts.
        params: of the model.
        trajectories: held out from training.
        horizon: steps.
    """
    windows = adjacent_windows(trajectories, length=horizon)

    def squares(window: Trajectory) -> Float[Array, "horizon column"]:
        predicted = rollout(model, params, window).free
        true = window.states[1:]
        if not model.along_path:
            return state_errors(predicted, true) ** 2
        gap = (predicted - true)[:, BODY]
        # Along a path nothing is predicted of the way along it.
        still = jnp.zeros(gap.shape[0])
        yaw = wrap_angle(gap[:, HEADING])
        rest = gap[:, PATH_SPEED:]
        return jnp.column_stack([still, gap[:, LATERAL], yaw, rest]) ** 2

    return jnp.sqrt(jnp.mean(in_batches(jax.vmap(squares), windows, size=128), axis=0))
