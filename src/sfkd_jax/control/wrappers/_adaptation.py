"""Adaptation while driving: estimate unmeasured causes, and drive with them."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.tasks._along_path import curvature_ahead, path_coordinates
from sfkd_jax.control.wrappers._disturbances import (
    CAUSES,
    DRIVE,
    FORCE,
    FRICTION,
    STEERING,
    TURN_FORCE,
    TURN_STEERING,
    WIND,
    Applied,
    Loop,
    compensation,
    input_error,
    side_force,
    split_force,
)
from sfkd_jax.control.wrappers._estimator import Belief, Estimator, Measured, follow
from sfkd_jax.control.wrappers._kalman import Bank
from sfkd_jax.control.wrappers._multiple_models import transition_matrix
from sfkd_jax.core.folding import fold
from sfkd_jax.core.path_frame import HEADING, LATERAL
from sfkd_jax.core.ranges import AtLeastTwo, Fraction, Interval, Positive
from sfkd_jax.core.se2 import between, compose
from sfkd_jax.types import (
    POSE,
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Model,
    Params,
    Reference,
    State,
)

BOUNDS = {FORCE: 4.0, STEERING: 0.1, DRIVE: 3.0, TURN_STEERING: 0.1, TURN_FORCE: 4.0}
"""Largest causes that are believed: four times the side force of E, 6° of steering."""

TOLERANCE = 1.1
"""The estimates are not used while their squared prediction errors exceed those of the
model alone by more than this factor.
"""


class AdaptiveState(NamedTuple):
    """What the adaptation carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        belief: of the estimator; the part to save and resume.
    """

    inner: Any
    belief: Belief


class _Settings(NamedTuple):
    """Settings of `adaptive` as its functions need them."""

    controller: Controller
    loop: Loop
    estimator: Estimator
    control_low: Control
    control_high: Control
    initial: Bank
    estimated: bool
    shrinkage: float
    patience: int


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
        `causes_std` (5,), `rejected` (nothing was learned from the
        measurement) and `adapting` (over
        the last seconds the estimates did not predict worse than the model alone;
        otherwise they are not used).

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
    settings = _Settings(
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
    return Controller(partial(_init, settings), partial(_act, settings))


def _init(settings: _Settings, key: Key) -> AdaptiveState:
    """The state before the first control step."""
    states = 1 + settings.estimator.sensors.shape[0]
    unknown = jnp.full(2, jnp.nan, dtype=float)
    return AdaptiveState(
        inner=settings.controller.init(key),
        belief=Belief(
            bank=settings.initial,
            applied=Applied(jnp.zeros(2), unknown, unknown),
            observation=jnp.full(states, jnp.nan, dtype=float),
            started=jnp.asarray(False),
            missing=jnp.zeros((), dtype=jnp.int32),
            scores=jnp.zeros(2),
        ),
    )


def _act(
    settings: _Settings,
    params: Params,
    state: AdaptiveState,
    observation: State,
    env: Environment,
    reference: Reference,
) -> tuple[Control, AdaptiveState, ControllerInfo]:
    """One control step."""
    loop, before = settings.loop, state.belief
    params = fold(loop.model, params)
    clean = all_finite((observation, reference))
    clean &= settings.estimated | all_finite(env)
    env = _known_environment(settings, before, env)
    road = jnp.stack([curvature_ahead(reference)[0], reference[0, 3]])
    coordinates = path_coordinates(observation, reference[0], road[0])
    repeated = jnp.all(observation == before.observation)
    usable = all_finite((observation, coordinates, env, reference)) & ~repeated
    belief, rejected = follow(
        settings.estimator, params, before, Measured(coordinates, usable)
    )
    adapting = belief.scores[0] <= TOLERANCE * belief.scores[1]
    causes = jnp.where(adapting | settings.estimated, _causes(settings, belief), 0.0)

    size = coordinates.shape[0]
    if settings.estimated:
        friction = belief.bank.probabilities @ settings.estimator.frictions
        env = jnp.zeros_like(env).at[FRICTION].set(friction)
    inside, excess = split_force(loop, env, side_force(causes, road))
    estimate = belief.bank.mean()[:size]
    offset = compensation(loop, params, inside, road, estimate, excess)
    bridged = (belief.missing > 0) & (belief.missing <= settings.patience)
    bridged &= belief.started & all_finite((estimate, reference))
    seen = jnp.where(bridged, _in_world(estimate, reference), observation)
    control, inner, info = settings.controller.act(
        offset, state.inner, seen, inside, reference
    )
    control = control + offset.inputs[:2] - input_error(causes, road)
    control = jnp.clip(control, settings.control_low, settings.control_high)

    belief = belief._replace(
        applied=_next_applied(before.applied, Applied(control, road, env)),
        observation=observation,
    )
    report: ControllerInfo = {
        **info,
        "healthy": info["healthy"] & clean,
        "env_estimate": inside,
        "causes": causes,
        "causes_std": jnp.sqrt(belief.bank.variance()[size:]),
        "rejected": rejected,
        "adapting": adapting,
    }
    return control, AdaptiveState(inner, belief), report


def _known_environment(
    settings: _Settings, belief: Belief, env: Environment
) -> Environment:
    """e in its box; where it is not finite, the last one; any if it is estimated."""
    centre = 0.5 * (settings.loop.low + settings.loop.high)
    if settings.estimated:
        return centre
    known = jnp.where(all_finite(env), env, belief.applied.env)
    return jnp.clip(known, settings.loop.low, settings.loop.high)


def _causes(settings: _Settings, belief: Belief) -> Float[Array, " cause"]:
    """The estimated causes; a force that could be noise is shrunk."""
    size = settings.estimator.sensors.shape[0]
    causes, variance = belief.bank.mean()[size:], belief.bank.variance()[size:]
    share = 1.0 - settings.shrinkage * variance[FORCE] / (causes[FORCE] ** 2 + 1e-9)
    return causes.at[FORCE].multiply(jnp.maximum(share, 0.0))


def _in_world(coordinates: Float[Array, " n"], reference: Reference) -> State:
    """The state at path coordinates beside the point where the vehicle should be now.

    That point is one step back along the circle through the first two reference points.
    """
    now = compose(reference[0, POSE], between(reference[1, POSE], reference[0, POSE]))
    beside = jnp.stack([jnp.zeros(()), coordinates[LATERAL], coordinates[HEADING]])
    return jnp.concatenate([compose(now, beside), coordinates[HEADING + 1 :]])


def _next_applied(before: Applied, now: Applied) -> Applied:
    """What acts over the next step; the last finite values where now is not finite."""
    return jax.tree.map(
        lambda new, old: jnp.where(jnp.isfinite(new), new, old), now, before
    )


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
