"""Calibration of the test of innovations on runs under the conditions of a corridor."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sfkd_jax.certification._measured import alarm_thresholds
from sfkd_jax.control import (
    InnovationTest,
    PathLaw,
    expected_coordinates,
    steering_level,
    turning_rate,
)
from sfkd_jax.geometry import HEADING
from sfkd_jax.types import BODY, Key, Model, Params, Trajectory

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


def innovations(
    model: Model,
    params: Params,
    law: PathLaw,
    runs: Trajectory,
    noise: Float[Array, "run time coordinate"],
    dt: float,
) -> Observed:
    """Return the innovations of runs whose law read ξ with this noise, and levels."""

    def step(xi: Array, after: Array, inputs: Array, env: Array) -> tuple[Array, Array]:
        fiber, road = model.fiber(params, env), inputs[2:]
        # ν beside the law of what was measured: the noise in the control cancels.
        expected = expected_coordinates(model, fiber, xi, inputs[:2], road)
        control = law(xi, road[0], road[1], env) + inputs[:2]
        turned = dt * turning_rate(law, xi, control, road, env)
        innovation = jnp.append(after - expected, (after - xi)[HEADING] - turned)
        return innovation, steering_level(law, road, env)

    measured = runs.states[:, :-1, BODY] + noise
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
    test, s3 = largest(observe(test_key)), largest(observe_s3(s3_key))
    return {
        "levels": levels.tolist(),
        "deviation": np.stack(deviation).tolist(),
        "threshold": thresholds.reshape(-1, steps.shape[1]).tolist(),
        "calibration_runs": len(maxima),
        "runs": len(test),
        "alarms": int(np.sum(np.any(test > thresholds, axis=1))),
        "alarms_s3": int(np.sum(np.any(s3 > thresholds, axis=1))),
    }
