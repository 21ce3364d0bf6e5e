"""Imperfect environments: what a sensor makes of e, and side forces it cannot see."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.plants import Vehicle, equivalent_wind
from sfkd_jax.ranges import Real
from sfkd_jax.scenarios import random_side_forces
from sfkd_jax.types import Key

FORCE_STREAM = 2
SENSOR_STREAM = 3
"""Folded into an episode's key; `split` gives the planner and the state sensors the
streams 0 and 1.
"""
LEAST_FRICTION = 0.05


def observed_environment(
    envs: Float[Array, "time 2"],
    key: Key,
    *,
    dt: float,
    delay_s: float = 0.0,
    noise: tuple[float, float] = (0.0, 0.0),
    bias: tuple[Real, Real] = (0.0, 0.0),
) -> Float[Array, "time 2"]:
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
    envs: Float[Array, "time 2"],
    key: Key,
    *,
    largest: float | Float[Array, ""],
) -> Float[Array, "time 2"]:
    """Return the environment with random side forces, expressed as additional wind.

    Args:
        plant: whose wind force it is.
        envs: the environment without these forces.
        key: of the episode, not consumed: its other streams stay what they are.
        largest: F, forces lie in [-F, F] [N].

    Raises:
        ValueError: a plant on which wind has no force.
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
    wind = jax.vmap(partial(equivalent_wind, wind_force=plant.wind_force))(
        envs[:, 1], force
    )
    return envs.at[:, 1].set(wind)
