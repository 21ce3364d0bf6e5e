"""Two ways to adapt from the field, around any planner along a path."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sfkd_jax.control import PathLaw, curvature_ahead, path_coordinates
from sfkd_jax.geometry import path_state
from sfkd_jax.types import BODY, Controller, Model

OUTLIER = 100.0
"""Squared normalised innovation above which nothing is learned from a step."""


class Loop(NamedTuple):
    """A model of a car around its law, in path coordinates."""

    model: Model
    law: PathLaw


class Applied(NamedTuple):
    """What acted over the last step; NaN before the first one."""

    coordinates: jax.Array
    control: jax.Array
    road: jax.Array
    env: jax.Array


def predicted(loop, params, applied, env):
    """Return ξ one step after `applied` under an environment."""
    at, road = applied.coordinates, applied.road
    nu = applied.control - loop.law(at, road[0], road[1], env)
    fiber = loop.model.fiber(params, env)
    latent = loop.model.encode(fiber, path_state(at))
    after = loop.model.step(fiber, latent, jnp.concatenate([nu, road]))
    return loop.model.decode(fiber, after)[BODY]


def _seen(observation, reference):
    """ξ, κ and v_ref of a step."""
    curvature = curvature_ahead(reference)[0]
    road = jnp.stack([curvature, reference[0, 3]])
    return path_coordinates(observation, reference[0], curvature), road


def _nothing_applied(size):
    return Applied(*(jnp.full(n, jnp.nan) for n in (size, 2, 2, 2)))


class LastLayerState(NamedTuple):
    """Weights of the last layer, their covariance, and the last step."""

    inner: Any
    weights: jax.Array
    covariance: jax.Array
    applied: Applied


def last_layer_filter(
    controller, loop, params, *, layer, sensors, error, prior, drift, forgetting
):
    """Wrap a controller with an extended Kalman filter for a network's last layer.

        θ⁺ = θ₀ + λ (θ − θ₀) + w,   ξ⁺ = F(ξ, u; θ) + v

    Args:
        controller: plans with the parameters it is given.
        loop: model and law.
        params: θ₀ and all other weights.
        layer: name of the last layer; its weights of the path coordinates are adapted.
        sensors: standard deviations of ξ, of both measurements of a step.
        error: standard deviations of one step of the model.
        prior: standard deviation of every weight before the first step.
        drift: of its change over a step.
        forgetting: λ.

    Source: Levy et al., arXiv 2504.16923; O'Connell et al., Neural-Fly, arXiv
    2205.06908.
    """
    start = jnp.concatenate(
        [params[layer]["kernel"][:, 3:], params[layer]["bias"][None, 3:]]
    )
    sensors, error = jnp.asarray(sensors), jnp.asarray(error)

    def with_last(weights):
        weights = weights.reshape(start.shape)
        last = params[layer]
        kernel = last["kernel"].at[:, 3:].set(weights[:-1])
        last = {"kernel": kernel, "bias": last["bias"].at[3:].set(weights[-1])}
        return {**params, layer: last}

    def init(key):
        return LastLayerState(
            controller.init(key),
            start.ravel(),
            prior**2 * jnp.eye(start.size),
            _nothing_applied(sensors.size),
        )

    def learned(state, measured):
        def after(weights, coordinates):
            applied = state.applied._replace(coordinates=coordinates)
            return predicted(loop, with_last(weights), applied, state.applied.env)

        at = state.weights, state.applied.coordinates
        innovation = measured - after(*at)
        by_weights, by_coordinates = jax.jacrev(after, (0, 1))(*at)
        noise = jnp.diag(sensors**2 + error**2)
        noise += (by_coordinates * sensors**2) @ by_coordinates.T
        cross = state.covariance @ by_weights.T
        total = by_weights @ cross + noise
        gain = jnp.linalg.solve(total, cross.T).T
        weights = state.weights + gain @ innovation
        covariance = state.covariance - gain @ cross.T
        likely = innovation @ jnp.linalg.solve(total, innovation) < OUTLIER
        finite = jnp.isfinite(weights).all() & jnp.isfinite(covariance).all() & likely
        weights = jnp.where(finite, weights, state.weights)
        covariance = jnp.where(finite, covariance, state.covariance)
        weights = start.ravel() + forgetting * (weights - start.ravel())
        covariance = 0.5 * forgetting**2 * (covariance + covariance.T)
        return weights, covariance + drift**2 * jnp.eye(start.size)

    def act(_, state, observation, env, reference):
        measured, road = _seen(observation, reference)
        weights, covariance = learned(state, measured)
        control, inner, info = controller.act(
            with_last(weights), state.inner, observation, env, reference
        )
        applied = Applied(measured, control, road, env)
        return control, LastLayerState(inner, weights, covariance, applied), info

    return Controller(init, act)


class BankState(NamedTuple):
    """Errors of every model over the last steps, newest first, and the last step."""

    inner: Any
    errors: jax.Array
    applied: Applied


def look_back_bank(controller, loop, envs, *, sensors, steps):
    """Wrap a controller with a bank of models, of which the best in hindsight plans.

    The models differ by e. The one with the least squared normalised error over the
    last steps is used; before the first step, that of the measured environment.

    Args:
        controller: plans with the environment it is given.
        loop: model and law.
        envs: e of every model, (model, 2).
        sensors: standard deviations of ξ.
        steps: of the window.

    Source: LLA-MPC (IROS 2025), which looks back over a bank of models.
    """
    sensors = jnp.asarray(sensors)

    def init(key):
        errors = jnp.full((steps, len(envs)), jnp.nan)
        return BankState(controller.init(key), errors, _nothing_applied(sensors.size))

    def act(params, state, observation, env, reference):
        measured, road = _seen(observation, reference)
        one_step = jax.vmap(partial(predicted, loop, params, state.applied))
        newest = jnp.sum(((one_step(envs) - measured) / sensors) ** 2, axis=1)
        errors = jnp.concatenate([newest[None], state.errors[:-1]])
        total = jnp.where(jnp.isfinite(errors), errors, 0.0).sum(axis=0)
        best = jnp.where(jnp.isfinite(errors).any(), envs[jnp.argmin(total)], env)
        control, inner, info = controller.act(
            params, state.inner, observation, best, reference
        )
        applied = Applied(measured, control, road, best)
        return control, BankState(inner, errors, applied), info

    return Controller(init, act)
