"""Environment estimation: infer e from the motion, with the model that also plans."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control.wrappers._multiple_models import (
    Hypotheses,
    MultipleModels,
    difference,
    environment_grid,
    transition_matrix,
    update,
)
from sfkd_jax.ranges import AtLeastTwo, Interval, Positive
from sfkd_jax.types import (
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Model,
    Params,
    State,
)


class EstimatorState(NamedTuple):
    """What the estimator carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        states: x̂_i, the state estimate of each hypothesis.
        covariance: P of their errors, shared by all hypotheses.
        probabilities: p_i of the hypotheses.
        control: applied last.
        started: whether there was an observation.
    """

    inner: Any
    states: Float[Array, "hypothesis state"]
    covariance: Float[Array, "state state"]
    probabilities: Float[Array, " hypothesis"]
    control: Control
    started: Bool[Array, ""]


class _Settings(NamedTuple):
    """Settings of `estimated` as its functions need them."""

    controller: Controller
    filter: MultipleModels
    controls: int
    smooth: bool


def estimated(
    controller: Controller,
    model: Model,
    *,
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    states: int,
    controls: int = 2,
    points: tuple[AtLeastTwo, ...] = (7, 17),
    dwell: Annotated[float, Interval("(1, inf)")] = 30.0,
    drift: tuple[float, ...] = (0.01, 0.3),
    sensor_noise: tuple[float, ...] = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001),
    model_error: tuple[Positive, ...] = (
        0.001,
        0.001,
        0.0003,
        0.005,
        0.005,
        0.002,
        0.001,
    ),
    smooth: bool = True,
) -> Controller:
    """Wrap a controller for an environment that is not measured but estimated.

    Interacting multiple models (Blom and Bar-Shalom, 1988) over a grid of environments
    e_i of the box E. Between steps e stays, drifts, or jumps to anywhere in E with
    probability 1/dwell; with Π the transition matrix of that Markov chain,

        c_i = Σ_j Π_ji p_j,   x̄_i = F(Σ_j Π_ji p_j x̂_j / c_i, u_{k−1}, e_i)
        ν_i = y_k − x̄_i,   p_i ∝ c_i exp(−½ ν_iᵀ S⁻¹ ν_i),   x̂_i = x̄_i + K ν_i
        ê = Σ_i p_i e_i

    S and K are those of an extended Kalman filter whose covariance all hypotheses
    share, propagated at their mean. Sensor errors are independent, so the measurements
    are processed one by one. The `env` argument of `act` is not read. Without a finite
    observation the hypotheses are predicted only, and an observation that no hypothesis
    explains resets their states.

    Args:
        controller: receives ê.
        model: used for the prediction; its fibres are evaluated at all e_i in every
            step.
        env_low: lower end of E.
        env_high: upper end of E.
        states: number of states.
        controls: number of controls.
        points: number of hypotheses along each axis of E.
        dwell: mean number of steps between jumps.
        drift: standard deviation of e over one step, per axis.
        sensor_noise: standard deviation r of the sensors, per state; further entries
            are ignored.
        model_error: standard deviation q of one step of the model, per state; further
            entries are ignored.
        smooth: plan from Σ p_i x̂_i instead of the observation.

    Returns:
        A `Controller`; `info` gains `env_estimate`, ê, and `env_spread`, the standard
        deviation of p around it.

    Raises:
        ValueError: a setting is out of its range or has the wrong number of entries.
    """
    sensor_noise, model_error = sensor_noise[:states], model_error[:states]
    _check(env_low, env_high, points, drift, dwell, states, sensor_noise, model_error)
    settings = _Settings(
        controller=controller,
        filter=MultipleModels(
            model=model,
            grid=environment_grid(env_low, env_high, points),
            transition=transition_matrix(env_low, env_high, points, drift, dwell),
            sensor_variance=jnp.asarray(sensor_noise, dtype=float) ** 2,
            model_variance=jnp.asarray(model_error, dtype=float) ** 2,
        ),
        controls=controls,
        smooth=smooth,
    )
    return Controller(partial(_init, settings), partial(_act, settings))


def _init(settings: _Settings, key: Key) -> EstimatorState:
    """The state before the first observation: all hypotheses are equally likely."""
    count = settings.filter.grid.shape[0]
    sensors = settings.filter.sensor_variance
    # An explicit dtype: weakly typed arrays would make the second call of a jitted
    # `act` compile it again.
    return EstimatorState(
        inner=settings.controller.init(key),
        states=jnp.full((count, sensors.shape[0]), jnp.nan, dtype=float),
        covariance=jnp.diag(sensors),
        probabilities=jnp.full(count, 1.0 / count, dtype=float),
        control=jnp.zeros(settings.controls),
        started=jnp.asarray(False),
    )


def _act(
    settings: _Settings,
    params: Params,
    state: EstimatorState,
    observation: State,
    env: Environment,
    reference: Any,
) -> tuple[Control, EstimatorState, ControllerInfo]:
    """One control step."""
    del env
    before = Hypotheses(state.states, state.covariance, state.probabilities)
    hypotheses = update(
        settings.filter, params, before, state.control, state.started, observation
    )
    probabilities, grid = hypotheses.probabilities, settings.filter.grid
    estimate = probabilities @ grid
    spread = jnp.sqrt(probabilities @ (grid - estimate) ** 2)
    clean = jnp.isfinite(observation).all()
    mean = observation + probabilities @ difference(hypotheses.states, observation)
    if settings.smooth:
        observation = jnp.where(clean, mean, observation)
    control, inner, info = settings.controller.act(
        params, state.inner, observation, estimate, reference
    )
    after = EstimatorState(inner, *hypotheses, control, state.started | clean)
    return control, after, {**info, "env_estimate": estimate, "env_spread": spread}


def _check(*settings: Any) -> None:
    """Raise a ValueError that names a setting out of its range."""
    low, high, points, drift, dwell, states, noise, error = settings
    if not len(low) == len(high) == len(points) == len(drift):
        raise ValueError(
            f"points and drift need one entry for each of {len(low)} environments, "
            f"got {points}, {drift}"
        )
    if min(points) < 2 or dwell <= 1.0 or min(drift) < 0:
        raise ValueError(
            "points must be at least 2, dwell above 1 step and drift not negative"
        )
    if not len(noise) == len(error) == states or min(noise) < 0 or min(error) <= 0:
        raise ValueError(
            "sensor_noise (not negative) and model_error (above 0) "
            f"need {states} entries"
        )
    if not all(a < b for a, b in itertools.zip_longest(low, high)):
        raise ValueError(f"env_low must lie below env_high, got {low} and {high}")
