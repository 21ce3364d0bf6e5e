"""An environment that nobody measures: inferred from what the vehicle does, with the model that also plans."""

from __future__ import annotations

import itertools
import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.core.se2 import wrap_angle
from sfkd_jax.types import (
    POSE,
    Control,
    Controller,
    Environment,
    Key,
    Model,
    Params,
    State,
)

YAW = POSE.stop - 1
OUTLIER = -12.0
"""Log-likelihood, against a perfect match, below which a hypothesis is not blamed any
further: about five deviations. An observation that nothing explains then changes no
probability.
"""


class EstimatorState(NamedTuple):
    """What the estimator carries from one control step to the next.

    Attributes:
        inner: state of the controller that is told.
        states: x̂_i, what each hypothesis takes x to be.
        covariance: P of their errors, one for all.
        probabilities: p_i of the hypotheses.
        control: applied last.
        primed: whether there was an observation.
    """

    inner: Any
    states: Float[Array, "hypothesis state"]
    covariance: Float[Array, "state state"]
    probabilities: Float[Array, " hypothesis"]
    control: Control
    primed: Bool[Array, ""]


def estimated(
    controller: Controller,
    model: Model,
    *,
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    states: int,
    controls: int = 2,
    points: tuple[int, ...] = (7, 17),
    dwell: float = 30.0,
    drift: tuple[float, ...] = (0.01, 0.3),
    sensor_noise: tuple[float, ...] = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001),
    model_error: tuple[float, ...] = (0.001, 0.001, 0.0003, 0.005, 0.005, 0.002, 0.001),
    smooth: bool = True,
) -> Controller:
    """The same controller where e cannot be measured: it is told the mean of what the last steps make likely.

    Interacting multiple models (Blom and Bar-Shalom, 1988) over a grid of environments
    e_i of the box E. Between steps e stays, drifts, or switches to anywhere in E with
    probability 1/dwell; with Π that Markov chain,

        c_i = Σ_j Π_ji p_j,   x̄_i = F(Σ_j Π_ji p_j x̂_j / c_i, u_{k−1}, e_i),   ν_i = y_k − x̄_i,
        p_i ∝ c_i exp(−½ ν_iᵀ S⁻¹ ν_i),   x̂_i = x̄_i + K ν_i,   ê = Σ_i p_i e_i,

    S and K those of an extended Kalman filter whose covariance all hypotheses share,
    propagated at their mean; the sensors, whose errors are independent, are taken in
    one by one. The environment that `act` is given is not read. Without a clean
    observation the hypotheses run on open loop, and one that no hypothesis explains
    starts their states anew.

    Args:
        controller: told ê.
        model: predicts; whose fibres are evaluated at all e_i in every step.
        env_low, env_high: E.
        points: hypotheses along each of its axes.
        states, controls: how many there are.
        dwell: steps between switches, on average.
        drift: standard deviation of e over one step, per axis.
        sensor_noise: r, per state.
        model_error: q, of one step, per state; entries beyond the state are not used.
        smooth: plan from Σ p_i x̂_i instead of the observation.

    Returns:
        A `Controller`; `info` gains `env_estimate`, ê, and `env_spread`, the standard
        deviations of p around it.

    Raises:
        ValueError: settings that cannot be meant.
    """
    sensor_noise, model_error = sensor_noise[:states], model_error[:states]
    _check(env_low, env_high, points, drift, dwell, states, sensor_noise, model_error)
    grid = _grid(env_low, env_high, points)
    chain = _chain(env_low, env_high, points, drift, dwell)
    sensors, disturbance = (
        jnp.asarray(spread, dtype=float) ** 2 for spread in (sensor_noise, model_error)
    )

    def init(key: Key) -> EstimatorState:
        count = grid.shape[0]
        # Without a dtype they would be weakly typed, and the second call of a jitted
        # `act` would compile it again.
        unseen = jnp.full((count, states), jnp.nan, dtype=float)
        alike = jnp.full(count, 1.0 / count, dtype=float)
        nothing = jnp.zeros(controls), jnp.asarray(False)
        return EstimatorState(
            controller.init(key), unseen, jnp.diag(sensors), alike, *nothing
        )

    def act(
        params: Params,
        state: EstimatorState,
        observation: State,
        env: Environment,
        reference: Any,
    ) -> tuple[Control, EstimatorState, dict[str, Array]]:
        del env
        believed, covariance, probabilities = follow(params, state, observation)
        estimate = probabilities @ grid
        spread = jnp.sqrt(probabilities @ (grid - estimate) ** 2)
        clean = jnp.isfinite(observation).all()
        best = observation + probabilities @ _difference(believed, observation)
        seen = jnp.where(clean, best, observation) if smooth else observation
        control, inner, info = controller.act(
            params, state.inner, seen, estimate, reference
        )
        after = EstimatorState(
            inner, believed, covariance, probabilities, control, state.primed | clean
        )
        return control, after, info | {"env_estimate": estimate, "env_spread": spread}

    def follow(
        params: Params, state: EstimatorState, observation: State
    ) -> tuple[
        Float[Array, "hypothesis state"],
        Float[Array, "state state"],
        Float[Array, " hypothesis"],
    ]:
        """States, their covariance and probabilities after an observation; the first one starts all states."""
        advance = partial(_advance, model, params, state.control)
        joint = chain * state.probabilities[:, None]
        expected = joint.sum(axis=0)
        origin = state.states[0]
        gaps = _difference(state.states, origin)
        predicted = jax.vmap(advance)(
            origin + (joint.T @ gaps) / expected[:, None], grid
        )
        slope = jax.jacfwd(advance)(
            origin + state.probabilities @ gaps, state.probabilities @ grid
        )
        ahead = slope @ state.covariance @ slope.T + jnp.diag(disturbance)
        corrected, left, fit = _corrected(predicted, ahead, observation, sensors)
        # A hypothesis whose prediction is not finite explains nothing, and must not
        # reach the others by mixing.
        sound = jnp.isfinite(fit) & jnp.isfinite(corrected).all(axis=1)
        fit, corrected = (
            jnp.where(sound, fit, -jnp.inf),
            jnp.where(sound[:, None], corrected, observation),
        )
        left = jnp.where(jnp.isfinite(left).all(), left, jnp.diag(sensors))
        weights = expected * (jnp.exp(fit) + math.exp(OUTLIER))

        clean, lost = jnp.isfinite(observation).all(), jnp.max(fit) < OUTLIER
        start = clean & (lost | ~state.primed)
        believed = jnp.where(start, observation, jnp.where(clean, corrected, predicted))
        covariance = jnp.where(start, jnp.diag(sensors), jnp.where(clean, left, ahead))
        kept = jnp.where(state.primed | clean, covariance, state.covariance)
        return (
            believed,
            kept,
            jnp.where(clean & ~start, weights / weights.sum(), expected),
        )

    return Controller(init, act)


def _advance(
    model: Model, params: Params, control: Control, state: State, env: Environment
) -> State:
    """F(x, u, e)."""
    fiber = model.fiber(params, env)
    return model.decode(fiber, model.step(fiber, model.encode(fiber, state), control))


def _difference(
    states: Float[Array, "hypothesis state"], origin: State
) -> Float[Array, "hypothesis state"]:
    """x_i − x with the yaw wrapped."""
    gap = states - origin
    return gap.at[:, YAW].set(wrap_angle(gap[:, YAW]))


def _grid(
    low: tuple[float, ...], high: tuple[float, ...], points: tuple[int, ...]
) -> Float[Array, "hypothesis n"]:
    """All combinations of evenly spaced values."""
    axes = [jnp.linspace(*ends) for ends in zip(low, high, points, strict=True)]
    return jnp.stack(
        [axis.ravel() for axis in jnp.meshgrid(*axes, indexing="ij")], axis=1
    )


def _chain(
    low: tuple[float, ...],
    high: tuple[float, ...],
    points: tuple[int, ...],
    drift: tuple[float, ...],
    dwell: float,
) -> Float[Array, "m m"]:
    """Π, symmetric: a walk along the axes with the variance of the drift, held at the border of E, and switches."""
    walk = jnp.ones((1, 1))
    for start, end, count, spread in zip(low, high, points, drift, strict=True):
        pace = min(0.5 * (spread * (count - 1) / (end - start)) ** 2, 1.0 / 3.0)
        beside = pace * (jnp.eye(count, k=1) + jnp.eye(count, k=-1))
        walk = jnp.kron(walk, beside + jnp.diag(1.0 - beside.sum(axis=1)))
    return (1.0 - 1.0 / dwell) * walk + 1.0 / (dwell * walk.shape[0])


def _corrected(
    states: Float[Array, "hypothesis n"],
    covariance: Float[Array, "n n"],
    observation: State,
    sensors: State,
) -> tuple[
    Float[Array, "hypothesis n"], Float[Array, "n n"], Float[Array, " hypothesis"]
]:
    """x̄_i + K ν_i, (I − K) P̄ and −½ ν_iᵀ S⁻¹ ν_i, one sensor after the other, so that nothing is inverted."""
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


def _check(*settings: Any) -> None:
    """Refuse settings that cannot be meant, naming them."""
    low, high, points, drift, dwell, states, noise, error = settings
    if not len(low) == len(high) == len(points) == len(drift):
        raise ValueError(
            f"points and drift need one entry for each of {len(low)} environments, got {points}, {drift}"
        )
    if min(points) < 2 or dwell <= 1.0 or min(drift) < 0:
        raise ValueError(
            "points must be at least 2, dwell above 1 step and drift not negative"
        )
    if not len(noise) == len(error) == states or min(noise) < 0 or min(error) <= 0:
        raise ValueError(
            f"sensor_noise (not negative) and model_error (above 0) need {states} entries"
        )
    if not all(a < b for a, b in itertools.zip_longest(low, high)):
        raise ValueError(f"env_low must lie below env_high, got {low} and {high}")
