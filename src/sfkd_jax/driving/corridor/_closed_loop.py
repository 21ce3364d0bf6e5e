"""The closed loop that a corridor is about: plant, law, and what the law reads."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.drives import Reading, Sensors
from sfkd_jax.driving.path_coordinates import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PERTURBATION,
)
from sfkd_jax.driving.path_following import PathLaw, Prediction, periods_ahead
from sfkd_jax.driving.plants import Vehicle, along_path
from sfkd_jax.latency import NO_LATENCY, CommandDelay, Latency, pushed
from sfkd_jax.rollout import fold, on_host
from sfkd_jax.types import BODY, Control, Environment, Key, Model, Params, State


class Loop(NamedTuple):
    """The closed loop of plant and law, and the model of the policy.

    Attributes:
        plant: the true plant with the law around it.
        law: of the policy.
        model: of the policy.
        params: of the model, folded.
        noise: standard deviations of the sensors, one per state of the vehicle.
        limits: lower and upper ends of the vehicle's controls.
        latency: of the vehicle, for each state and control.
    """

    plant: Vehicle
    law: PathLaw
    model: Model
    params: Params
    noise: tuple[float, ...]
    limits: tuple[tuple[float, ...], tuple[float, ...]]
    latency: Latency

    @property
    def delay(self) -> CommandDelay:
        """The delays of the commands after an observation."""
        return self.latency.loop(self.plant.dt)


def closed_loop(
    plant: Vehicle,
    model: Model,
    params: Params,
    law: PathLaw | None,
    noise: Sequence[float],
    latency: Latency = NO_LATENCY,
) -> Loop:
    """Return the closed loop of a plant and the parts of a policy.

    Args:
        plant: the vehicle without a law.
        model: of the policy.
        params: of the model; they are folded here.
        law: of the policy.
        noise: standard deviations of the sensors, one per state of the vehicle.
        latency: of the vehicle, which the law compensates.

    Raises:
        ValueError: the policy has no law.
    """
    if law is None:
        raise ValueError(
            "a corridor needs a policy in path coordinates, with its law: "
            "model.frame=path"
        )
    return Loop(
        plant=along_path(plant, law, perturbation=law.perturbation),
        law=law,
        model=model,
        params=fold(model, params, on_host),
        noise=tuple(noise),
        limits=(plant.control_low, plant.control_high),
        latency=latency.sized(len(plant.states), len(plant.controls)),
    )


class Past(NamedTuple):
    """What a loop with latency remembers, newest last.

    Attributes:
        xi: true ξ.
        road: κ [1/m] and v_ref [m/s] of the periods that begin there.
        env: e.
        sent: the commands that may still act; NaN before the first one.
    """

    xi: Float[Array, "time coordinate"]
    road: Float[Array, "time 2"]
    env: Float[Array, "time environment"]
    sent: Float[Array, "step control"]


def law_sensors(loop: Loop, *, noisy: bool = True) -> Sensors:
    """Return how the law of a loop reads its state: with noise, and late.

    A period of these runs begins when a command of the first control begins to act. The
    law has then seen the state of `delay.first` periods ago, and predicts it with the
    model, as `path_following.Predictor` does. In place of its command the exact law
    with another ν would apply the same control, since the law is a known function.

    Args:
        loop: whose law reads.
        noisy: whether the sensors have noise; otherwise they are only late.
    """
    delay = loop.delay
    rows = ceil(delay.first) + 1
    share = ceil(delay.first) - delay.first
    # Controls that act later than the first one.
    later = CommandDelay(tuple(max(p - delay.first, 0.0) for p in delay.periods))
    # e is known at the call, and the command acts later.
    call = ceil(loop.latency.actuators(loop.plant.dt).first)
    model = loop.model.predicting
    prediction = Prediction(model=model, law=loop.law, dt=loop.plant.dt)
    low, high = map(jnp.asarray, loop.limits)

    def init(state: State, inputs: Control, env: Environment) -> Past:
        return Past(
            xi=jnp.tile(state[BODY], (rows, 1)),
            road=jnp.tile(inputs[PERTURBATION.stop :], (rows, 1)),
            env=jnp.tile(env, (call + 1, 1)),
            sent=jnp.full((delay.steps, 2), jnp.nan, dtype=float),
        )

    def read(
        past: Past, key: Key, state: State, inputs: Control, env: Environment
    ) -> tuple[Float[Array, " 2"], Reading, Past]:
        xi = state[BODY]
        road = inputs[PERTURBATION.stop :]
        past = past._replace(
            xi=pushed(past.xi, xi),
            road=pushed(past.road, road),
            env=pushed(past.env, env),
        )
        # Between two periods, as ξ was when it was observed.
        seen = past.xi[0] + share * (past.xi[min(1, rows - 1)] - past.xi[0])
        roads = past.road[:-1] + share * (past.road[1:] - past.road[:-1])
        roads = jnp.concatenate([roads, road[None]])
        if noisy:
            spread = spread_of(loop.noise, state.shape[-1])[BODY]
            seen = seen + spread * jax.random.normal(key, seen.shape)
        known = past.env[0]
        expected = seen
        if delay.first:
            fiber = model.fiber(loop.params, known)
            periods = periods_ahead(delay, roads, past.sent)
            expected, _ = prediction.ahead(fiber, known, seen, periods)
        feedback = loop.law.turn(road[0], road[1], known).feedback(expected)
        command = feedback + inputs[PERTURBATION]
        exact = loop.law.turn(road[0], road[1], env).feedback(xi)
        if not delay.steps:
            nu = inputs[PERTURBATION] + (feedback - exact)
            return nu, Reading(seen, command, road, known), past
        command = jnp.clip(command, low, high)
        reading = Reading(seen, delay.acting(past.sent, command), roads[0], known)
        nu = later.acting(past.sent, command) - exact
        return nu, reading, past._replace(sent=pushed(past.sent, command))

    return Sensors(init, read)


def spread_of(noise: tuple[float, ...], size: int) -> Array:
    """Return the standard deviations of a path state from those of the sensors.

    The deviation of e_y is that of a position, and the one of e_ψ is that of the yaw.
    The other coordinates are states of the vehicle and keep their deviations. The pose
    of a path state is exact.

    Args:
        noise: standard deviations of (p_x, p_y, yaw, v, …).
        size: of the path state.
    """
    # Without p_x: p_y, yaw, v, … are the deviations of ξ = (e_y, e_ψ, v, …).
    of_coordinates = noise[1 : size - 2]
    stop = BODY.start + len(of_coordinates)
    return jnp.zeros(size).at[BODY.start : stop].set(jnp.asarray(of_coordinates))


def predicted_spread(loop: Loop, state: State) -> Array:
    """Return the standard deviations of a path state when the command acts.

    Until then an error of the heading moves the vehicle sideways.
    """
    spread = spread_of(loop.noise, state.shape[-1])
    way = loop.plant.dt * loop.delay.first * state[BODY][PATH_SPEED]
    sideways = way * spread[BODY][HEADING]
    lateral = jnp.hypot(spread[BODY][LATERAL], sideways)
    return spread.at[BODY.start + LATERAL].set(lateral)
