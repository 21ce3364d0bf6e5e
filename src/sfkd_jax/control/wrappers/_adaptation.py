"""Adaptation while driving: estimate unmeasured causes, and drive with them."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import jax
import jax.numpy as jnp

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.wrappers._adaptive_step import AdaptiveSettings, act, initial
from sfkd_jax.control.wrappers._disturbances import (
    CAUSES,
    DRIVE,
    FORCE,
    FRICTION,
    STEERING,
    TURN_FORCE,
    TURN_STEERING,
    WIND,
    Loop,
)
from sfkd_jax.control.wrappers._estimator import (
    Estimator,
)
from sfkd_jax.control.wrappers._kalman import Bank, transition_matrix
from sfkd_jax.ranges import AtLeastTwo, Fraction, Interval, Positive
from sfkd_jax.types import (
    Controller,
    Model,
)

BOUNDS = {FORCE: 4.0, STEERING: 0.1, DRIVE: 3.0, TURN_STEERING: 0.1, TURN_FORCE: 4.0}
"""Largest causes that are believed: four times the side force of E, 6° of steering."""


def adaptive(
    controller: Controller,
    model: Model,
    law: PathLaw,
    *,
    coordinates: int,
    control_low: tuple[float, ...],
    control_high: tuple[float, ...],
    env_low: tuple[float, ...],
    env_high: tuple[float, ...],
    estimate_env: bool = False,
    jump: Fraction = 0.03,
    jump_size: Positive = 0.8,
    force_drift: Positive = 0.05,
    slow_prior: tuple[Positive, ...] = (0.01, 0.05, 0.02, 2.0),
    slow_drift: tuple[Positive, ...] = (1e-4, 0.005, 1e-4, 0.02),
    shrinkage: float = 0.3,
    friction_points: AtLeastTwo = 7,
    friction_drift: Positive = 0.01,
    dwell: Annotated[float, Interval("(1, inf)")] = 30.0,
    sensor_noise: tuple[float, ...] = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001),
    model_error: tuple[Positive, ...] = (
        0.001,
        0.0003,
        0.003,
        0.003,
        0.0015,
        0.0005,
    ),
    patience: int = 5,
) -> Controller:
    """Wrap a controller along a path with estimates of what nobody measures.

    The unmeasured causes are a side force f (relative to the largest of E), an error of
    the steering, of the drive, and a steering error and side force in proportion to κ:

        ξ⁺ = F(ξ, u + Δu(θ); κ, v_ref, e(f)) + (f beyond E) ∂F/∂f

    An extended Kalman filter estimates (ξ, θ). Between steps f stays or jumps, which
    two filters joined by a Markov chain follow (interacting multiple models); with
    `estimate_env` each of them exists for every friction of a grid, and f is the wind.
    Per control step:

    1. the measured ξ corrects (ξ, θ), see `follow` for measurements that do not fit;
    2. e takes up the force within E, `compensation` the rest, u the input errors;
    3. the wrapped controller plans with all of that.

    Only e, an offset of the inputs and an offset of the latent step change. The weights
    that a certificate is about do not, so the rate and its witness stay what they are.
    θ is data of the state: nothing is compiled again.

    Args:
        controller: built with `with_offset(model)`; receives `Offset` parameters.
        model: in path coordinates, without offset.
        law: around which it was learned.
        coordinates: size of ξ.
        control_low: lower limits of u.
        control_high: upper limits of u.
        env_low: lower end of E = (friction, wind).
        env_high: upper end of E; the wind's box is symmetric.
        estimate_env: infer e as well; the `env` argument of `act` is not read.
        jump: probability that the force jumps between two steps.
        jump_size: standard deviation of a jump, relative to the largest force of E.
        force_drift: standard deviation of its change over a step without a jump.
        slow_prior: standard deviations of the errors of steering [rad], drive [control
            unit], steering and relative side force in the tightest turn, before the
            first measurement.
        slow_drift: of their change over a step: the slower, the longer their memory.
        shrinkage: s of f̂ max(0, 1 − s var f / f̂²), which leaves alone what could be
            noise (James-Stein); not used with `estimate_env`.
        friction_points: number of hypotheses on friction, with `estimate_env`.
        friction_drift: standard deviation of friction over a step.
        dwell: mean number of steps between jumps of friction.
        sensor_noise: standard deviation per state of the vehicle; further entries are
            ignored.
        model_error: standard deviation of one step of the model, per entry of ξ;
            further entries are ignored.
        patience: number of steps without a usable measurement that are bridged by the
            estimate; after them the controller receives the observation as it is.
            `healthy` is False in either case.

    Returns:
        A `Controller`; `info` gains `env_estimate` (the e planned with), `causes` (5,),
        `causes_std` (5,), `rejected` (nothing was learned from the measurement),
        `adapting` (over the last seconds the estimates did not predict worse than the
        model alone; otherwise they are not used) and `weights_changed` (the parameters
        are not those of the first step).

    Raises:
        ValueError: a setting is out of its range or has the wrong number of entries.

    Source: Blom and Bar-Shalom (1988); Pannocchia and Rawlings (2003).
    """
    noise, error = (sensor_noise[0], *sensor_noise[2:]), model_error[:coordinates]
    noise = noise[:coordinates]
    _check(model, (env_low, env_high), (noise, error), coordinates, patience)
    low, high = jnp.asarray(env_low, dtype=float), jnp.asarray(env_high, dtype=float)
    points = friction_points if estimate_env else 1
    frictions, chain = jnp.full(1, jnp.nan), jnp.ones((1, 1))
    if estimate_env:
        frictions = jnp.linspace(low[FRICTION], high[FRICTION], points)
        ends = env_low[:1], env_high[:1]
        chain = transition_matrix(*ends, (points,), (friction_drift,), dwell)
    jumps = jnp.tile(jnp.array([1.0 - jump, jump]), (2, 1))
    drift = jnp.asarray([*error, force_drift, *slow_drift]) ** 2
    drifts = jnp.stack([drift, drift.at[coordinates].set(jump_size**2)])
    prior = jnp.asarray([*noise, 1.0 if estimate_env else 0.1, *slow_prior]) ** 2
    loop = Loop(model, law, low, high)
    count = 2 * points
    settings = AdaptiveSettings(
        controller=controller,
        loop=loop,
        estimator=Estimator(
            loop=loop,
            transition=jnp.kron(chain, jumps),
            frictions=jnp.repeat(frictions, 2),
            sensors=jnp.asarray(noise) ** 2,
            noise=jnp.tile(jax.vmap(jnp.diag)(drifts), (points, 1, 1)),
            bounds=jnp.asarray([BOUNDS[entry] for entry in range(CAUSES)]),
        ),
        control_low=jnp.asarray(control_low, dtype=float),
        control_high=jnp.asarray(control_high, dtype=float),
        initial=Bank(
            jnp.zeros((count, coordinates + CAUSES)),
            jnp.tile(jnp.diag(prior), (count, 1, 1)),
            jnp.full(count, 1.0 / count, dtype=float),
        ),
        estimated=estimate_env,
        shrinkage=0.0 if estimate_env else shrinkage,
        patience=patience,
    )
    return Controller(partial(initial, settings), partial(act, settings))


def _check(
    model: Model,
    box: tuple[tuple[float, ...], tuple[float, ...]],
    deviations: tuple[tuple[float, ...], tuple[float, ...]],
    coordinates: int,
    patience: int,
) -> None:
    """Raise a ValueError that names a setting out of its range."""
    low, high = box
    if not model.along_path:
        raise ValueError("adaptation needs a model in path coordinates")
    if len(low) != 2 or len(high) != 2 or low[WIND] != -high[WIND] or high[WIND] <= 0:
        raise ValueError(
            "adaptation needs e = (friction, wind) with a wind in [-w, w], "
            f"got {low} and {high}"
        )
    noise, error = deviations
    if not len(noise) == len(error) == coordinates or min(*noise, *error) <= 0:
        raise ValueError(
            "sensor_noise and model_error need positive numbers for "
            f"{coordinates} path coordinates, got {noise} and {error}"
        )
    if patience < 1:
        raise ValueError(f"patience must be at least 1, got {patience}")
