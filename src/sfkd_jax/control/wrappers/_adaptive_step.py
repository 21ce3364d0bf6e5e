"""One control step with estimates of unmeasured causes."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, UInt32

from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.tasks._along_path import (
    curvature_ahead,
    path_coordinates,
    world_state,
)
from sfkd_jax.control.wrappers._disturbances import (
    FRICTION,
    Applied,
    Loop,
    compensation,
    input_error,
    side_force,
    split_force,
)
from sfkd_jax.control.wrappers._estimator import (
    Belief,
    Estimator,
    Measured,
    applied_next,
    believed_causes,
    follow,
)
from sfkd_jax.control.wrappers._kalman import Bank
from sfkd_jax.rollout import fold
from sfkd_jax.types import (
    Control,
    Controller,
    ControllerInfo,
    Environment,
    Key,
    Params,
    Reference,
    State,
)

TOLERANCE = 1.1
"""The estimates are not used while their squared prediction errors exceed those of the
model alone by more than this factor.
"""


class AdaptiveState(NamedTuple):
    """What the adaptation carries from one control step to the next.

    Attributes:
        inner: state of the wrapped controller.
        belief: of the estimator; the part to save and resume.
        weights: checksum of the parameters at the first step; 0 before.
    """

    inner: Any
    belief: Belief
    weights: UInt32[Array, ""]


class AdaptiveSettings(NamedTuple):
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


def initial(settings: AdaptiveSettings, key: Key) -> AdaptiveState:
    """Return the state before the first control step."""
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
        weights=jnp.zeros((), dtype=jnp.uint32),
    )


def act(
    settings: AdaptiveSettings,
    params: Params,
    state: AdaptiveState,
    observation: State,
    env: Environment,
    reference: Reference,
) -> tuple[Control, AdaptiveState, ControllerInfo]:
    """Take one control step."""
    loop, before = settings.loop, state.belief
    weights = _checksum(params)
    changed = (state.weights != 0) & (weights != state.weights)
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
    causes = jnp.where(
        adapting | settings.estimated,
        believed_causes(settings.estimator, belief, settings.shrinkage),
        0.0,
    )

    size = coordinates.shape[0]
    if settings.estimated:
        friction = belief.bank.probabilities @ settings.estimator.frictions
        env = jnp.zeros_like(env).at[FRICTION].set(friction)
    inside, excess = split_force(loop, env, side_force(causes, road))
    estimate = belief.bank.mean()[:size]
    offset = compensation(loop, params, inside, road, estimate, excess)
    bridged = (belief.missing > 0) & (belief.missing <= settings.patience)
    bridged &= belief.started & all_finite((estimate, reference))
    seen = jnp.where(bridged, world_state(estimate, reference), observation)
    control, inner, info = settings.controller.act(
        offset, state.inner, seen, inside, reference
    )
    correction = offset.inputs[:2] - input_error(causes, road)
    control = control + jnp.where(jnp.isfinite(correction), correction, 0.0)
    control = jnp.clip(control, settings.control_low, settings.control_high)

    belief = belief._replace(
        applied=applied_next(before.applied, Applied(control, road, env)),
        observation=observation,
    )
    report: ControllerInfo = {
        **info,
        "healthy": info["healthy"] & clean & ~changed,
        "env_estimate": inside,
        "causes": causes,
        "causes_std": jnp.sqrt(belief.bank.variance()[size:]),
        "rejected": rejected,
        "adapting": adapting,
        "weights_changed": changed,
    }
    first = jnp.where(state.weights == 0, weights, state.weights)
    return control, AdaptiveState(inner, belief, first), report


def _checksum(params: Params) -> UInt32[Array, ""]:
    """A sum over the bits of all weights in their order, mixed as MurmurHash3 does.

    Between two steps it shows a changed weight, not a forged one: the hash of the
    certificate does that.
    """
    total = jnp.ones((), dtype=jnp.uint32)
    for leaf in jax.tree.leaves(params):
        bits = jax.lax.bitcast_convert_type(jnp.asarray(leaf, float), jnp.uint32)
        index = jnp.arange(bits.size, dtype=jnp.uint32)
        mixed = bits.ravel() + jnp.uint32(0x9E3779B9) * index
        mixed = (mixed ^ (mixed >> 16)) * jnp.uint32(0x85EBCA6B)
        total = 31 * total + jnp.sum(mixed ^ (mixed >> 13), dtype=jnp.uint32)
    return jnp.maximum(total, 1)


def _known_environment(
    settings: AdaptiveSettings, belief: Belief, env: Environment
) -> Environment:
    """e in its box; where it is not finite, the last one; any if it is estimated."""
    centre = 0.5 * (settings.loop.low + settings.loop.high)
    if settings.estimated:
        return centre
    known = jnp.where(all_finite(env), env, belief.applied.env)
    return jnp.clip(known, settings.loop.low, settings.loop.high)
