"""A closed loop with its sensors, and the test of innovations on its runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._measured import alarm_thresholds
from sfkd_jax.control import InnovationTest, PathLaw, expected_coordinates, turning_rate
from sfkd_jax.data import sensor_keys
from sfkd_jax.geometry import HEADING, LATERAL, PERTURBATION
from sfkd_jax.plants import Vehicle, along_path
from sfkd_jax.rollout import fold, on_host, rollout
from sfkd_jax.types import (
    BODY,
    Control,
    Environment,
    Key,
    Model,
    Params,
    State,
    Trajectory,
)

BATCHES = 10
"""Simulations of all runs for the calibration; half of them fix the units."""
SHARES = (0.5, 0.75, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999)
"""Of the steps in order of their level, where another deviation begins."""
MARGIN = 1.25
"""On thresholds: the tail of real runs is somewhat heavier than an exponential."""
DAY = 86_400.0
"""Time of driving to one false alarm [s]."""
Observed: TypeAlias = tuple[Float[Array, "run gap chart"], Float[Array, "run gap"]]
"""Innovations and levels."""


class Loop(NamedTuple):
    """The closed loop of plant and law, and the model of the policy."""

    plant: Vehicle  # the true plant with the law around it
    law: PathLaw  # of the policy, as are model and (folded) params
    model: Model
    params: Params
    noise: tuple[float, ...]  # standard deviations of the sensors


def closed_loop(
    plant: Vehicle,
    model: Model,
    params: Params,
    law: PathLaw | None,
    noise: Sequence[float],
) -> Loop:
    """Return the closed loop of a plant and a policy's parts, with folded weights."""
    if law is None:
        raise ValueError(
            "a corridor needs a policy in path coordinates, with its law: "
            "model.frame=path"
        )
    closed = along_path(plant, law, perturbation=law.perturbation)
    return Loop(closed, law, model, fold(model, params, on_host), tuple(noise))


def sensor_effect(
    loop: Loop, key: Key, state: State, inputs: Control, env: Environment
) -> Array:
    """Return the change of ν because the law reads ξ through the sensors."""
    coordinates = state[BODY]
    road = inputs[PERTURBATION.stop :]
    spread = spread_of(loop.noise, state.shape[-1])[BODY]
    measured = coordinates + spread * jax.random.normal(key, coordinates.shape)
    # A law is a known function: reading ξ + n acts like a perturbation of ν.
    turn = loop.law.turn(road[0], road[1], env)
    return turn.feedback(measured) - turn.feedback(coordinates)


def spread_of(noise: tuple[float, ...], size: int) -> Array:
    """Standard deviations of a path state from those of the sensors.

    e_y takes that of a position, e_ψ that of yaw, the other coordinates their own.
    """
    known = noise[1 : size - 2]
    return jnp.zeros(size).at[3 : 3 + len(known)].set(jnp.asarray(known))


def simulate_nominal(
    loop: Loop, runs: Trajectory, key: Key
) -> tuple[Float[Array, "run time"], Float[Array, "run rank"]]:
    """Return ê_y of a nominal model that starts at the true state, and z_0 − ẑ_0.

    ẑ_0 is the latent state of a nominal model that starts at the measured state.
    """
    model = loop.model
    spread = spread_of(loop.noise, runs.states.shape[-1])

    def lateral(run: Trajectory) -> Array:
        return rollout(model, loop.params, run).free[:, BODY][:, LATERAL]

    def gap(state: State, env: Environment, key: Key) -> Array:
        fiber = model.fiber(loop.params, env)
        measured = state + spread * jax.random.normal(key, state.shape)
        # The nominal model starts at what sensors show, the car at the truth.
        starts = model.encode(fiber, measured), model.encode(fiber, state)
        return model.vector(starts[0]) - model.vector(starts[1])

    keys = jax.random.split(key, len(runs.states))
    gaps = jax.vmap(gap)(runs.states[:, 0], runs.envs[:, 0], keys)
    return jax.vmap(lateral)(runs), gaps


def innovations(loop: Loop, runs: Trajectory, key: Key) -> Observed:
    """Return innovations and levels of runs, with the noise that their law read.

    `key` made the runs: one half of it drew the environments, the other one the rest.
    """
    model = loop.model
    law = loop.law
    keys = sensor_keys(jax.random.split(key)[1], *runs.controls.shape[:2])
    spread = spread_of(loop.noise, runs.states.shape[-1])[BODY]
    noise = jax.vmap(jax.vmap(partial(jax.random.normal, shape=spread.shape)))(keys)

    def step(xi: Array, after: Array, inputs: Array, env: Array) -> tuple[Array, Array]:
        fiber = model.fiber(loop.params, env)
        road = inputs[2:]
        # ν beside the law of what was measured: the noise in the control cancels.
        expected = expected_coordinates(model, fiber, xi, inputs[:2], road)
        turn = law.turn(road[0], road[1], env)
        control = turn.feedback(xi) + inputs[:2]
        turned = loop.plant.dt * turning_rate(law, xi, control, road, env)
        innovation = jnp.append(after - expected, (after - xi)[HEADING] - turned)
        return innovation, turn.level

    measured = runs.states[:, :-1, BODY] + spread * noise
    given = measured[:, :-1], measured[:, 1:], runs.controls[:, :-1], runs.envs[:, :-1]
    return jax.vmap(jax.vmap(step))(*given)


@jax.jit
def largest_means(test: InnovationTest, seen: Observed) -> Float[Array, "run mean"]:
    """Return the largest absolute moving means of each run."""

    def one(innovation: Array, level: Array) -> Array:
        def step(means: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            means = test.moved(means, *now)
            return means, jnp.abs(means)

        start = test.init().means
        return jnp.max(jax.lax.scan(step, start, (innovation, level))[1], 0).ravel()

    return jax.vmap(one)(*seen)


def calibrate_innovations(
    observe: Callable[[Key], Observed],
    observe_s3: Callable[[Key], Observed],
    key: Key,
    *,
    duration: float,
) -> dict[str, Any]:
    """Return the entry of the certificate about the test of innovations.

    The thresholds are for one false alarm a day. Alarms are counted on runs that the
    calibration has not seen, and on S3.

    Args:
        observe: key -> innovations of runs under the conditions of the corridor.
        observe_s3: of S3.
        key: consumed.
        duration: of a run [s].
    """
    test_key, s3_key, *keys = jax.random.split(key, 2 + BATCHES)
    parts = [observe(key) for key in keys]
    innovation, level = (
        np.concatenate(part, dtype=np.float64) for part in zip(*parts, strict=True)
    )
    order = np.argsort(level, axis=None)
    sizes = np.asarray(SHARES) * len(order)
    groups = [part for part in np.split(order, sizes.astype(int)) if len(part)]
    steps = innovation.reshape(len(order), -1)
    levels = np.asarray([np.mean(level.ravel()[group]) for group in groups])
    # NaN where the steering is in no steady turn of the law.
    deviation = [np.sqrt(np.nanmean(steps[group] ** 2, axis=0)) for group in groups]
    scale = jnp.asarray(levels, float), jnp.asarray(np.stack(deviation), float)
    largest = partial(largest_means, InnovationTest(*scale, jnp.ones(())))
    maxima = np.concatenate([*map(largest, parts)], dtype=np.float64)
    reference, scores = np.array_split(maxima, 2)
    thresholds = MARGIN * alarm_thresholds(reference, scores, rate=duration / DAY)
    test = largest(observe(test_key))
    s3 = largest(observe_s3(s3_key))
    return {
        "levels": levels.tolist(),
        "deviation": np.stack(deviation).tolist(),
        "threshold": thresholds.reshape(-1, steps.shape[1]).tolist(),
        "calibration_runs": len(maxima),
        "runs": len(test),
        "alarms": int(np.sum(np.any(test > thresholds, axis=1))),
        "alarms_s3": int(np.sum(np.any(s3 > thresholds, axis=1))),
    }
