"""A closed loop with noisy sensors, and the calibration of the test of innovations.

The test raises an alarm when a vehicle or its sensors are not those of the calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification import alarm_thresholds, rows
from sfkd_jax.driving.certificate import Innovations
from sfkd_jax.driving.drives import sensor_keys
from sfkd_jax.driving.path_coordinates import (
    CURVATURE,
    HEADING,
    LATERAL,
    PERTURBATION,
    REFERENCE_SPEED,
)
from sfkd_jax.driving.path_following import (
    InnovationTest,
    PathLaw,
    expected_coordinates,
    turning_rate,
)
from sfkd_jax.driving.plants import Vehicle, along_path
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
"""Number of times that all runs are simulated for the calibration. Half of these
simulations fix the units of the charts.
"""
SHARES = (0.5, 0.75, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999)
"""Shares of the steps, in the order of their levels. The steps between two shares are a
group, and every group has a standard deviation of its own.
"""
MARGIN = 1.25
"""Factor on thresholds. The tail of real runs is somewhat heavier than the exponential
that the thresholds are computed from.
"""
SECONDS_PER_ALARM = 86_400.0
"""Time of driving in which one false alarm is accepted, a day [s]."""
Observed: TypeAlias = tuple[Float[Array, "run gap chart"], Float[Array, "run gap"]]
"""Innovations and levels of the law at every step between two rows of runs."""


class Loop(NamedTuple):
    """The closed loop of plant and law, and the model of the policy.

    Attributes:
        plant: the true plant with the law around it.
        law: of the policy.
        model: of the policy.
        params: of the model, folded.
        noise: standard deviations of the sensors, one per state of the vehicle.
    """

    plant: Vehicle
    law: PathLaw
    model: Model
    params: Params
    noise: tuple[float, ...]


def closed_loop(
    plant: Vehicle,
    model: Model,
    params: Params,
    law: PathLaw | None,
    noise: Sequence[float],
) -> Loop:
    """Return the closed loop of a plant and the parts of a policy.

    Args:
        plant: the vehicle without a law.
        model: of the policy.
        params: of the model; they are folded here.
        law: of the policy.
        noise: standard deviations of the sensors, one per state of the vehicle.

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
    )


def sensor_effect(
    loop: Loop, key: Key, state: State, inputs: Control, env: Environment
) -> Array:
    """Return the perturbation of ν that the noise of the sensors amounts to.

    The law is a known function. If it reads ξ + n in place of ξ, its control changes as
    if ν were perturbed.

    Args:
        loop: whose law reads the sensors.
        key: of the noise; consumed.
        state: true path state.
        inputs: w = (ν, κ, v_ref).
        env: e.
    """
    coordinates = state[BODY]
    curvature = inputs[CURVATURE]
    reference_speed = inputs[REFERENCE_SPEED]
    spread = spread_of(loop.noise, state.shape[-1])[BODY]
    measured = coordinates + spread * jax.random.normal(key, coordinates.shape)
    turn = loop.law.turn(curvature, reference_speed, env)
    return turn.feedback(measured) - turn.feedback(coordinates)


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


def simulate_nominal(
    loop: Loop, runs: Trajectory, key: Key
) -> tuple[Float[Array, "run time"], Float[Array, "run rank"]]:
    """Return ê_y of a nominal model that starts at the true state, and z_0 − ẑ_0.

    In a controller the nominal model starts at the measured state instead; ẑ_0 is its
    latent state there, and z_0 that of the true state.

    Args:
        loop: whose model is simulated.
        runs: of the loop.
        key: of the measurements; consumed.
    """
    model = loop.model
    spread = spread_of(loop.noise, runs.states.shape[-1])

    def lateral(run: Trajectory) -> Array:
        return rollout(model, loop.params, run).free[:, BODY][:, LATERAL]

    def gap(state: State, env: Environment, key: Key) -> Array:
        fiber = model.fiber(loop.params, env)
        measured = state + spread * jax.random.normal(key, state.shape)
        from_measured = model.vector(model.encode(fiber, measured))
        from_true = model.vector(model.encode(fiber, state))
        return from_measured - from_true

    keys = jax.random.split(key, len(runs.states))
    gaps = jax.vmap(gap)(runs.states[:, 0], runs.envs[:, 0], keys)
    return jax.vmap(lateral)(runs), gaps


def innovations(loop: Loop, runs: Trajectory, key: Key) -> Observed:
    """Return innovations and levels of runs, with the noise that their law has read.

    Args:
        loop: that drove the runs.
        runs: of the loop.
        key: with which the runs were made. Its first half drew the environments, its
            second half everything else, the noise of the sensors included.
    """
    model = loop.model
    law = loop.law
    _, run_key = jax.random.split(key)
    keys = sensor_keys(run_key, *runs.controls.shape[:2])
    spread = spread_of(loop.noise, runs.states.shape[-1])[BODY]
    noise = jax.vmap(jax.vmap(partial(jax.random.normal, shape=spread.shape)))(keys)

    def step(
        before: Array, after: Array, inputs: Array, env: Array
    ) -> tuple[Array, Array]:
        """Return innovation and level from measured ξ before and after a step."""
        fiber = model.fiber(loop.params, env)
        nu = inputs[PERTURBATION]
        road = inputs[PERTURBATION.stop :]
        # The law has read the measured ξ, as this prediction does. The noise is
        # therefore in both of their controls, and cancels.
        expected = expected_coordinates(model, fiber, before, nu, road)
        turn = law.turn(road[0], road[1], env)
        control = turn.feedback(before) + nu
        turned = loop.plant.dt * turning_rate(law, before, control, road, env)
        innovation = jnp.append(after - expected, (after - before)[HEADING] - turned)
        return innovation, turn.level

    measured = runs.states[:, :-1, BODY] + spread * noise
    return jax.vmap(jax.vmap(step))(
        measured[:, :-1], measured[:, 1:], runs.controls[:, :-1], runs.envs[:, :-1]
    )


@jax.jit
def largest_means(test: InnovationTest, observed: Observed) -> Float[Array, "run mean"]:
    """Return the largest absolute moving means of each run."""

    def largest_of_run(innovations: Array, levels: Array) -> Array:
        def step(means: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
            innovation, level = inputs
            means = test.moved(means, innovation, level)
            return means, jnp.abs(means)

        _, sizes = jax.lax.scan(step, test.init().means, (innovations, levels))
        return jnp.max(sizes, 0).ravel()

    return jax.vmap(largest_of_run)(*observed)


def calibrate_innovations(
    observe: Callable[[Key], Observed],
    observe_s3: Callable[[Key], Observed],
    key: Key,
    *,
    duration: float,
) -> Innovations:
    """Return the calibration of the test of innovations.

    The thresholds are for one false alarm a day. Alarms are counted on runs that the
    calibration has not seen, and on S3.

    Args:
        observe: key -> innovations and levels of runs under the conditions of the
            corridor.
        observe_s3: the same for S3.
        key: consumed.
        duration: of a run [s].
    """
    test_key, s3_key, *keys = jax.random.split(key, 2 + BATCHES)
    batches = [observe(key) for key in keys]
    levels, deviations = _deviations_by_level(batches)
    test = InnovationTest(
        jnp.asarray(levels, float), jnp.asarray(deviations, float), jnp.ones(())
    )
    largest = partial(largest_means, test)
    maxima = np.concatenate([*map(largest, batches)], dtype=np.float64)
    reference, scores = np.array_split(maxima, 2)
    rate = duration / SECONDS_PER_ALARM
    thresholds = MARGIN * alarm_thresholds(reference, scores, rate=rate)
    test_maxima = largest(observe(test_key))
    s3_maxima = largest(observe_s3(s3_key))
    return Innovations(
        levels=rows(levels),
        deviation=rows(deviations),
        threshold=rows(thresholds.reshape(-1, deviations.shape[1])),
        calibration_runs=len(maxima),
        runs=len(test_maxima),
        alarms=int(np.sum(np.any(test_maxima > thresholds, axis=1))),
        alarms_s3=int(np.sum(np.any(s3_maxima > thresholds, axis=1))),
    )


def _deviations_by_level(
    batches: list[Observed],
) -> tuple[Float[np.ndarray, " group"], Float[np.ndarray, "group chart"]]:
    """Return the mean level of each group of steps, and its standard deviations.

    The groups are those of `SHARES`.
    """
    innovations = np.concatenate([batch[0] for batch in batches], dtype=np.float64)
    levels = np.concatenate([batch[1] for batch in batches], dtype=np.float64)
    order = np.argsort(levels, axis=None)
    edges = np.asarray(SHARES) * len(order)
    groups = [part for part in np.split(order, edges.astype(int)) if len(part)]
    steps = innovations.reshape(len(order), -1)
    means = [np.mean(levels.ravel()[group]) for group in groups]
    # `nanmean`, because an innovation is NaN where the steering is in no steady turn of
    # the law.
    deviations = [np.sqrt(np.nanmean(steps[group] ** 2, axis=0)) for group in groups]
    return np.asarray(means), np.stack(deviations)
