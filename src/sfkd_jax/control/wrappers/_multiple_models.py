"""Interacting multiple models: one Kalman filter for each environment of a grid."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.geometry import wrap_angle
from sfkd_jax.types import POSE, Control, Environment, Model, Params, State

YAW = POSE.stop - 1
OUTLIER = -12.0
"""Floor of the log-likelihood relative to a perfect match, about five standard
deviations. An observation that no hypothesis explains changes no probability.
"""


class MultipleModels(NamedTuple):
    """Settings of the filter.

    Attributes:
        model: used for the prediction.
        grid: e_i.
        transition: Π, of the Markov chain of e.
        sensor_variance: r², per state.
        model_variance: q², of one step, per state.
    """

    model: Model
    grid: Float[Array, "hypothesis environment"]
    transition: Float[Array, "hypothesis hypothesis"]
    sensor_variance: State
    model_variance: State


class Hypotheses(NamedTuple):
    """State estimates, their shared covariance, and probabilities of all e_i."""

    states: Float[Array, "hypothesis state"]
    covariance: Float[Array, "state state"]
    probabilities: Float[Array, " hypothesis"]


def update(
    settings: MultipleModels,
    params: Params,
    before: Hypotheses,
    control: Control,
    started: Bool[Array, ""],
    observation: State,
) -> Hypotheses:
    """Return the hypotheses after one step and an observation.

    Args:
        settings: of the filter.
        params: of the model.
        before: the hypotheses one step earlier.
        control: applied since then.
        started: whether there was an observation before; the first one sets all states.
        observation: may be not finite.
    """
    sensors = settings.sensor_variance
    predicted, ahead, expected = _predict(settings, params, before, control)
    corrected, covariance, fit = _correct(predicted, ahead, observation, sensors)
    # A hypothesis whose prediction is not finite explains nothing, and must not reach
    # the others by mixing.
    valid = jnp.isfinite(fit) & jnp.isfinite(corrected).all(axis=1)
    fit, corrected = (
        jnp.where(valid, fit, -jnp.inf),
        jnp.where(valid[:, None], corrected, observation),
    )
    initial = jnp.diag(sensors)
    covariance = jnp.where(jnp.isfinite(covariance).all(), covariance, initial)
    weights = expected * (jnp.exp(fit) + math.exp(OUTLIER))

    clean, lost = jnp.isfinite(observation).all(), jnp.max(fit) < OUTLIER
    reset = clean & (lost | ~started)
    covariance = jnp.where(reset, initial, jnp.where(clean, covariance, ahead))
    return Hypotheses(
        jnp.where(reset, observation, jnp.where(clean, corrected, predicted)),
        jnp.where(started | clean, covariance, before.covariance),
        jnp.where(clean & ~reset, weights / weights.sum(), expected),
    )


def _predict(
    settings: MultipleModels, params: Params, before: Hypotheses, control: Control
) -> tuple[
    Float[Array, "hypothesis n"], Float[Array, "n n"], Float[Array, " hypothesis"]
]:
    """x̄_i from the mixed estimates, their covariance, and c_i."""
    advance = partial(_advance, settings.model, params, control)
    joint = settings.transition * before.probabilities[:, None]
    expected = joint.sum(axis=0)
    origin = before.states[0]
    gaps = difference(before.states, origin)
    predicted = jax.vmap(advance)(
        origin + (joint.T @ gaps) / expected[:, None], settings.grid
    )
    slope = jax.jacfwd(advance)(
        origin + before.probabilities @ gaps, before.probabilities @ settings.grid
    )
    model_error = jnp.diag(settings.model_variance)
    return predicted, slope @ before.covariance @ slope.T + model_error, expected


def _advance(
    model: Model, params: Params, control: Control, state: State, env: Environment
) -> State:
    """F(x, u, e)."""
    fiber = model.fiber(params, env)
    return model.decode(fiber, model.step(fiber, model.encode(fiber, state), control))


def difference(
    states: Float[Array, "hypothesis state"], origin: State
) -> Float[Array, "hypothesis state"]:
    """Return x_i − x with the yaw wrapped."""
    gap = states - origin
    return gap.at[:, YAW].set(wrap_angle(gap[:, YAW]))


def environment_grid(
    low: tuple[float, ...], high: tuple[float, ...], points: tuple[int, ...]
) -> Float[Array, "hypothesis n"]:
    """Return all combinations of evenly spaced values.

    Args:
        low: lower end of each axis.
        high: upper end of each axis.
        points: number of values along each axis.
    """
    axes = [jnp.linspace(*ends) for ends in zip(low, high, points, strict=True)]
    return jnp.stack(
        [axis.ravel() for axis in jnp.meshgrid(*axes, indexing="ij")], axis=1
    )


def transition_matrix(
    low: tuple[float, ...],
    high: tuple[float, ...],
    points: tuple[int, ...],
    drift: tuple[float, ...],
    dwell: float,
) -> Float[Array, "m m"]:
    """Return Π, symmetric: diffusion by the drift within E, and jumps.

    Args:
        low: lower end of each axis.
        high: upper end of each axis.
        points: number of values along each axis.
        drift: standard deviation of e over one step, per axis.
        dwell: mean number of steps between jumps.
    """
    diffusion = jnp.ones((1, 1))
    for start, end, count, spread in zip(low, high, points, drift, strict=True):
        rate = min(0.5 * (spread * (count - 1) / (end - start)) ** 2, 1.0 / 3.0)
        neighbours = rate * (jnp.eye(count, k=1) + jnp.eye(count, k=-1))
        stay = jnp.diag(1.0 - neighbours.sum(axis=1))
        diffusion = jnp.kron(diffusion, neighbours + stay)
    return (1.0 - 1.0 / dwell) * diffusion + 1.0 / (dwell * diffusion.shape[0])


def _correct(
    states: Float[Array, "hypothesis n"],
    covariance: Float[Array, "n n"],
    observation: State,
    sensors: State,
) -> tuple[
    Float[Array, "hypothesis n"], Float[Array, "n n"], Float[Array, " hypothesis"]
]:
    """x̄_i + K ν_i, (I − K) P̄ and −½ ν_iᵀ S⁻¹ ν_i, one sensor at a time."""
    fit = jnp.zeros(states.shape[0])
    for entry in range(observation.shape[0]):
        gap = states[:, entry] - observation[entry]
        innovation = -(wrap_angle(gap) if entry == YAW else gap)
        variance = covariance[entry, entry] + sensors[entry]
        gain = covariance[:, entry] / variance
        states = states + innovation[:, None] * gain
        covariance = covariance - variance * jnp.outer(gain, gain)
        fit = fit - 0.5 * innovation**2 / variance
    return states, covariance, fit
