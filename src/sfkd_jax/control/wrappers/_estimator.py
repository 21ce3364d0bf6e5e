"""The estimator of the state and of unmeasured causes along a path."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.control.planners._plans import all_finite
from sfkd_jax.control.wrappers._disturbances import (
    FORCE,
    FRICTION,
    Applied,
    Loop,
    predicted,
)
from sfkd_jax.control.wrappers._kalman import Bank, corrected, mixed, propagated
from sfkd_jax.geometry import PathState
from sfkd_jax.types import Environment, Params, State

MEMORY = 0.97
"""Forgetting factor of the scores: about 3 s at 10 Hz."""
LARGEST_SCORE = 25.0
"""Limit of a squared normalised error, so that one outlier decides nothing."""


class Belief(NamedTuple):
    """What is known between two control steps: arrays to save and to resume.

    Attributes:
        bank: of (ξ, causes).
        applied: what acted on the vehicle since the last step.
        observation: the last one, to recognise a sensor that freezes.
        started: whether ξ was ever measured.
        missing: number of consecutive measurements that were not usable.
        scores: squared normalised errors of one-step predictions, with the causes and
            without, averaged over the last seconds.
    """

    bank: Bank
    applied: Applied
    observation: State
    started: Bool[Array, ""]
    missing: Int[Array, ""]
    scores: Float[Array, " 2"]


class Estimator(NamedTuple):
    """Settings of the estimator.

    Attributes:
        loop: the learned closed loop.
        transition: of the Markov chain of the filters.
        frictions: of the filters; NaN where friction is measured.
        sensors: variances of the measured ξ.
        noise: Q of the filters.
        bounds: largest causes.
    """

    loop: Loop
    transition: Float[Array, "filter filter"]
    frictions: Float[Array, " filter"]
    sensors: Float[Array, " sensor"]
    noise: Float[Array, "filter vector vector"]
    bounds: Float[Array, " cause"]


class Measured(NamedTuple):
    """A measurement in path coordinates.

    Attributes:
        coordinates: ξ, may be not finite.
        usable: whether it is finite and not a repetition of the last one.
    """

    coordinates: PathState
    usable: Bool[Array, ""]


def follow(
    settings: Estimator, params: Params, belief: Belief, measured: Measured
) -> tuple[Belief, Bool[Array, ""]]:
    """Return the belief after one step and a measurement, and if it was rejected.

    A measurement that is not usable, or farther from every filter than a jump of the
    force could explain, is rejected: the causes stay as predicted, so that a sensor
    that freezes or jumps is never taken for a force. If it is usable, ξ starts anew
    from it.

    Args:
        settings: of the estimator.
        params: of the model, folded.
        belief: before.
        measured: at the end of the step.
    """
    size = measured.coordinates.shape[0]
    expected = _advanced(settings, params, belief)
    coordinates = jnp.where(measured.usable, measured.coordinates, 0.0)
    after, explained = corrected(expected, coordinates, settings.sensors)
    after = _bounded(settings, after, size)
    learned = belief.started & measured.usable & explained & all_finite(after)
    expected = _select(all_finite(expected), expected, belief.bank)
    bank = _select(belief.started, expected, belief.bank)
    bank = _select(learned, after, bank)
    restarted = measured.usable & ~learned
    bank = _select(restarted, _restarted(settings, bank, coordinates), bank)
    scores = _scores(settings, params, belief, expected, coordinates)
    belief = belief._replace(
        bank=bank,
        started=belief.started | measured.usable,
        missing=jnp.where(measured.usable, 0, belief.missing + 1),
        scores=jnp.where(learned & all_finite(scores), scores, belief.scores),
    )
    return belief, ~learned


def believed_causes(
    settings: Estimator, belief: Belief, shrinkage: float
) -> Float[Array, " cause"]:
    """Return the estimated causes; a force that could be noise is shrunk.

    f̂ max(0, 1 − s var f / f̂²)

    Args:
        settings: of the estimator.
        belief: after a measurement.
        shrinkage: s.
    """
    size = settings.sensors.shape[0]
    causes, variance = belief.bank.mean()[size:], belief.bank.variance()[size:]
    share = 1.0 - shrinkage * variance[FORCE] / (causes[FORCE] ** 2 + 1e-9)
    return causes.at[FORCE].multiply(jnp.maximum(share, 0.0))


def applied_next(before: Applied, now: Applied) -> Applied:
    """Return what acts over the next step; where it is not finite, what acted last."""
    return jax.tree.map(
        lambda new, old: jnp.where(jnp.isfinite(new), new, old), now, before
    )


def _advanced(settings: Estimator, params: Params, belief: Belief) -> Bank:
    """The bank one step later, without a measurement."""
    loop, applied = settings.loop, belief.applied
    bank = mixed(belief.bank, settings.transition)
    size = settings.sensors.shape[0]

    def one(mean: Array, friction: Array) -> tuple[Array, Array]:
        env = _environment(applied.env, friction)
        given = applied._replace(env=env)
        after, slope = predicted(loop, params, given, mean[:size], mean[size:])
        return jnp.concatenate([after, mean[size:]]), slope

    means, slopes = jax.vmap(one)(bank.means, settings.frictions)
    stays = jnp.eye(bank.means.shape[1])[size:]
    stays = jnp.tile(stays, (means.shape[0], 1, 1))
    slopes = jnp.concatenate([slopes, stays], axis=1)
    covariances = propagated(bank.covariances, slopes, settings.noise)
    return Bank(means, covariances, bank.probabilities)


def _environment(env: Environment, friction: Array) -> Environment:
    """The e of a filter: measured, or its own friction without wind."""
    hypothesis = jnp.zeros_like(env).at[FRICTION].set(friction)
    return jnp.where(jnp.isnan(friction), env, hypothesis)


def _bounded(settings: Estimator, bank: Bank, size: int) -> Bank:
    """The bank with its causes within their bounds."""
    causes = jnp.clip(bank.means[:, size:], -settings.bounds, settings.bounds)
    return bank._replace(means=bank.means.at[:, size:].set(causes))


def _restarted(settings: Estimator, bank: Bank, coordinates: PathState) -> Bank:
    """The bank at a measured ξ, with the causes as they are."""
    size = coordinates.shape[0]
    covariances = bank.covariances.at[:, :size].set(0.0).at[:, :, :size].set(0.0)
    covariances = covariances.at[:, :size, :size].set(jnp.diag(settings.sensors))
    return bank._replace(
        means=bank.means.at[:, :size].set(coordinates), covariances=covariances
    )


def _scores(
    settings: Estimator,
    params: Params,
    belief: Belief,
    expected: Bank,
    coordinates: PathState,
) -> Float[Array, " 2"]:
    """The scores after one more prediction."""
    size = coordinates.shape[0]
    mean = belief.bank.mean()
    friction = expected.probabilities @ settings.frictions
    applied = belief.applied
    applied = applied._replace(env=_environment(applied.env, friction))
    nothing = jnp.zeros_like(mean[size:])
    alone, _ = predicted(settings.loop, params, applied, mean[:size], nothing)
    both = jnp.stack([expected.mean()[:size], alone])
    errors = jnp.minimum((both - coordinates) ** 2 / settings.sensors, LARGEST_SCORE)
    return MEMORY * belief.scores + (1.0 - MEMORY) * errors.mean(axis=1)


def _select(choice: Bool[Array, ""], first: Bank, second: Bank) -> Bank:
    """One of two banks."""
    return jax.tree.map(lambda a, b: jnp.where(choice, a, b), first, second)
