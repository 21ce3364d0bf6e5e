"""The nominal model of a loop, and the calibration of the test of innovations.

The test raises an alarm when a vehicle or its sensors are not those of the calibration.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification import alarm_thresholds, rows
from sfkd_jax.driving.certificate import Innovations
from sfkd_jax.driving.corridor._closed_loop import Loop, predicted_spread
from sfkd_jax.driving.drives import Reading
from sfkd_jax.driving.path_coordinates import HEADING, LATERAL
from sfkd_jax.driving.path_following import (
    InnovationTest,
    expected_coordinates,
    turning_rate,
)
from sfkd_jax.rollout import in_batches, rollout
from sfkd_jax.types import BODY, Environment, Key, State, Trajectory

BATCHES = 10
"""Number of times that all runs are simulated for the calibration. Half of these
simulations fix the units of the charts.
"""
RUNS_AT_ONCE = 50
"""Runs whose innovations are computed at once."""
SHARES = (0.5, 0.75, 0.9, 0.95, 0.98, 0.99, 0.995, 0.998, 0.999)
"""Shares of the steps, in the order of their levels. The steps between two shares are a
group, and every group has a standard deviation of its own.
"""
MARGIN = 1.25
"""Factor on thresholds. The tail of real runs is somewhat heavier than the exponential
that the thresholds are computed from.
"""
SMALLEST_DEVIATION = 1e-6
"""Smallest standard deviation of an innovation: what float32 rounds. A state that a
model predicts exactly has none.
"""
LARGEST_THRESHOLD = 1e6
"""Largest threshold. None that a run without end would ask for is reached."""
SECONDS_PER_ALARM = 86_400.0
"""Time of driving in which one false alarm is accepted, a day [s]."""
Observed: TypeAlias = tuple[Float[Array, "run gap chart"], Float[Array, "run gap"]]
"""Innovations and levels of the law at every step between two rows of runs."""


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

    def lateral(run: Trajectory) -> Array:
        return rollout(model, loop.params, run).free[:, BODY][:, LATERAL]

    def gap(state: State, env: Environment, key: Key) -> Array:
        fiber = model.fiber(loop.params, env)
        spread = predicted_spread(loop, state)
        measured = state + spread * jax.random.normal(key, state.shape)
        from_measured = model.vector(model.encode(fiber, measured))
        from_true = model.vector(model.encode(fiber, state))
        return from_measured - from_true

    keys = jax.random.split(key, len(runs.states))
    gaps = jax.vmap(gap)(runs.states[:, 0], runs.envs[:, 0], keys)
    return jax.vmap(lateral)(runs), gaps


def innovations(loop: Loop, readings: Reading) -> Observed:
    """Return innovations and levels of runs, as a gate computes them while driving.

    They are those of the model that planners roll out, which predicts best.

    Args:
        loop: that drove the runs.
        readings: of its law, (run, time, …).
    """
    model = loop.model.predicting
    law = loop.law

    def step(reading: Reading, after: Array) -> tuple[Array, Array]:
        """Return innovation and level from a reading and the next measured ξ."""
        before = reading.measured
        road = reading.road
        fiber = model.fiber(loop.params, reading.env)
        turn = law.turn(road[0], road[1], reading.env)
        nu = reading.control - turn.feedback(before)
        expected = expected_coordinates(model, fiber, before, nu, road)
        rate = turning_rate(law, before, reading.control, road, reading.env)
        turned = loop.plant.dt * rate
        innovation = jnp.append(after - expected, (after - before)[HEADING] - turned)
        return innovation, turn.level

    def of_run(run: tuple[Reading, Array]) -> tuple[Array, Array]:
        return jax.vmap(step)(*run)

    first = jax.tree.map(lambda leaf: leaf[:, :-1], readings)
    # A model of planners needs much memory for each of so many steps.
    return in_batches(
        jax.vmap(of_run), (first, readings.measured[:, 1:]), size=RUNS_AT_ONCE
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
    with np.errstate(all="ignore"):
        thresholds = MARGIN * alarm_thresholds(reference, scores, rate=rate)
    # A run that diverged has no finite maximum, and a threshold of NaN is no threshold.
    thresholds = np.nan_to_num(thresholds, nan=np.inf, posinf=np.inf)
    thresholds = np.minimum(thresholds, LARGEST_THRESHOLD)
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
    found = np.stack(deviations)
    # Nothing is known of a chart that had no finite innovation.
    known = np.where(np.isfinite(found), found, 1.0)
    return np.asarray(means), np.maximum(known, SMALLEST_DEVIATION)
