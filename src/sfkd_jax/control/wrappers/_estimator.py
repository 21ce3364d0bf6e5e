"""The estimator of ξ and of unmeasured causes along a path.

Interacting multiple models: extended Kalman filters on the derivatives of the learned
model, joined by a Markov chain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control._finite import all_finite
from sfkd_jax.control.laws._path_law import PathLaw
from sfkd_jax.control.wrappers._innovations import expected_coordinates
from sfkd_jax.geometry import PathState
from sfkd_jax.types import Control, Environment, Model, Params, Scalar

FRICTION = 0
"""Entry of e that is the friction."""
WIND = 1
"""Entry of e that is the wind."""
FORCE, STEERING, DRIVE, TURN_STEERING, TURN_FORCE = range(5)
"""Entries of the causes: the last two are in proportion to κ."""
CAUSES = 5
BOUNDS = (4.0, 0.1, 3.0, 0.1, 4.0)
"""Largest causes that are believed: four times the side force of E, 6° of steering."""
FORCE_STEP = 0.25
"""Half the difference of relative side forces that a slope is taken over."""
TIGHTEST = 0.02
"""Curvature [1/m] at which the causes in proportion to κ have their full effect."""
MEMORY = 0.97
"""Forgetting factor of the scores: about 3 s at 10 Hz."""
LARGEST_SCORE = 25.0
"""Limit of a squared normalised error, so that one outlier decides nothing."""
OUTLIER = -200.0
"""Log-likelihood relative to a perfect match below which no filter explains a
measurement: eight standard deviations.
"""
LEAST_LIKELIHOOD = 1e-9
"""Floor relative to the best filter, so that every filter can become likely again."""


class Bank(NamedTuple):
    """The Gaussian estimates of all filters and their probabilities."""

    means: Float[Array, "filter n"]  # of the estimated vector
    covariances: Float[Array, "filter n n"]  # of its errors
    probabilities: Float[Array, " filter"]  # of the filters

    def mean(self) -> Float[Array, " n"]:
        """Return the mean over all filters."""
        return self.probabilities @ self.means

    def variance(self) -> Float[Array, " n"]:
        """Return the variance over all filters, entry by entry."""
        spread = (self.means - self.mean()) ** 2
        own = jnp.diagonal(self.covariances, axis1=1, axis2=2)
        return self.probabilities @ (own + spread)


def mixed(bank: Bank, transition: Float[Array, "filter filter"]) -> Bank:
    """Return the bank after a transition of the Markov chain.

        c_j = Σ_i Π_ij p_i,   x̄_j = Σ_i Π_ij p_i x_i / c_j

    P̄_j is the covariance of that mixture. Source: Blom and Bar-Shalom (1988).
    """
    joint = transition * bank.probabilities[:, None]
    expected = joint.sum(axis=0)
    # No division by 0: every entry of Π is positive, hence every entry of c.
    weights = joint / expected
    means = weights.T @ bank.means
    gaps = bank.means[:, None] - means[None]
    covariances = jnp.einsum("ij,iab->jab", weights, bank.covariances)
    covariances += jnp.einsum("ij,ija,ijb->jab", weights, gaps, gaps)
    return Bank(means, covariances, expected)


def corrected(
    bank: Bank,
    measurement: Float[Array, " sensor"],
    variances: Float[Array, " sensor"],
) -> tuple[Bank, Bool[Array, ""]]:
    """Return the bank after a measurement of the first entries, and if it is explained.

    The sensors are independent and processed one by one, in Joseph's form, which keeps
    covariances positive in float32.

    Returns:
        The bank, and False if every filter is farther away than `OUTLIER` or is not
        finite.
    """
    means = bank.means
    covariances = bank.covariances
    identity = jnp.eye(means.shape[1])
    fit = jnp.zeros(means.shape[0])
    surprise = jnp.zeros(means.shape[0])
    for entry in range(measurement.shape[0]):
        innovation = measurement[entry] - means[:, entry]
        variance = covariances[:, entry, entry] + variances[entry]
        gain = covariances[:, :, entry] / variance[:, None]
        means = means + innovation[:, None] * gain
        rest = identity - gain[:, :, None] * identity[entry]
        covariances = rest @ covariances @ rest.swapaxes(1, 2)
        covariances += variances[entry] * gain[:, :, None] * gain[:, None, :]
        surprise = surprise - 0.5 * innovation**2 / variance
        fit = fit - 0.5 * jnp.log(variance)
    # A filter of NaN counts as impossible, or it would make all probabilities NaN.
    fit = jnp.where(jnp.isfinite(surprise), fit + surprise, -jnp.inf)
    relative = jnp.exp(fit - jnp.max(fit)) + LEAST_LIKELIHOOD
    weights = bank.probabilities * relative
    explained = jnp.max(jnp.nan_to_num(surprise, nan=-math.inf)) > OUTLIER
    return Bank(means, covariances, weights / weights.sum()), explained


def transition_matrix(
    low: float, high: float, points: int, drift: float, dwell: float
) -> Float[Array, "m m"]:
    """Return Π, symmetric: diffusion by the drift on a grid, and jumps to anywhere.

    Args:
        low: lower end of the grid.
        high: upper end of the grid.
        points: number of values on it.
        drift: standard deviation over one step.
        dwell: mean number of steps between jumps.
    """
    # At most 1/3, so that every entry of the diagonal stays positive.
    rate = min(0.5 * (drift * (points - 1) / (high - low)) ** 2, 1.0 / 3.0)
    neighbours = rate * (jnp.eye(points, k=1) + jnp.eye(points, k=-1))
    diffusion = neighbours + jnp.diag(1.0 - neighbours.sum(axis=1))
    return (1.0 - 1.0 / dwell) * diffusion + 1.0 / (dwell * points)


class Applied(NamedTuple):
    """What acts on the vehicle over one step: u, (κ [1/m], v_ref [m/s]) and e in E."""

    control: Control
    road: Float[Array, " 2"]
    env: Environment


def side_force(causes: Float[Array, " cause"], road: Float[Array, " 2"]) -> Scalar:
    """Return the relative side force of the causes on a road."""
    return causes[FORCE] + causes[TURN_FORCE] * road[0] / TIGHTEST


def input_error(causes: Float[Array, " cause"], road: Float[Array, " 2"]) -> Control:
    """Return what acts beside the control: steering [rad], drive [control unit]."""
    steering = causes[STEERING] + causes[TURN_STEERING] * road[0] / TIGHTEST
    return jnp.stack([steering, causes[DRIVE]])


class Loop(NamedTuple):
    """The learned closed loop and the box of its environments."""

    model: Model  # in path coordinates, without offset
    law: PathLaw  # around which it was learned
    low: Environment  # lower end of E
    high: Environment  # upper end of E; wind in [-high, high]
    power: float = 2.0  # of the wind in its side force

    def relative_force(self, env: Environment) -> Scalar:
        """Return the side force, w|w| of a wind, relative to the largest one in E."""
        share = env[WIND] / self.high[WIND]
        return share * jnp.abs(share) ** (self.power - 1.0)

    def with_force(self, env: Environment, force: Scalar) -> Environment:
        """Return e with the wind of a relative side force."""
        # The root has no derivative at 0; nothing differentiates by the force.
        root = jnp.sign(force) * jnp.abs(force) ** (1.0 / self.power)
        return env.at[WIND].set(self.high[WIND] * root)

    def split_force(
        self, env: Environment, force: Scalar
    ) -> tuple[Environment, Scalar]:
        """Return the e in E with as much of an additional force as fits, and the rest.

        Forces are relative to the largest in E.
        """
        total = self.relative_force(env) + force
        inside = jnp.clip(total, -1.0, 1.0)
        return self.with_force(env, inside), total - inside

    def next_coordinates(
        self, params: Params, applied: Applied, xi: PathState
    ) -> PathState:
        """Return ξ one step later; the model takes ν = u − law(ξ; κ, v_ref, e)."""
        road = applied.road
        env = applied.env
        nu = applied.control - self.law(xi, road[0], road[1], env)
        fiber = self.model.fiber(params, env)
        return expected_coordinates(self.model, fiber, xi, nu, road)

    def force_slope(self, params: Params, applied: Applied, xi: PathState) -> PathState:
        """Return ∂ξ⁺/∂(relative side force) at a given control.

        A difference over the forces near that of e; at an end of E, into E. Beyond E
        the model is continued along this slope.
        """
        force = self.relative_force(applied.env)
        ends = jnp.clip(force + jnp.array([-FORCE_STEP, FORCE_STEP]), -1.0, 1.0)

        def at(end: Scalar) -> PathState:
            env = self.with_force(applied.env, end)
            return self.next_coordinates(params, applied._replace(env=env), xi)

        return (at(ends[1]) - at(ends[0])) / (ends[1] - ends[0])

    def predicted(
        self,
        params: Params,
        applied: Applied,
        xi: PathState,
        causes: Float[Array, " cause"],
    ) -> tuple[PathState, Float[Array, "coordinate vector"]]:
        """Return ξ⁺ under unmeasured causes, and its Jacobian by (ξ, causes).

        The force acts as wind within E and along `force_slope` beyond it; the e of
        `applied` is that without the causes.
        """
        at = xi.shape[0]
        road = applied.road
        env, excess = self.split_force(applied.env, side_force(causes, road))
        applied = applied._replace(env=env)
        slope = self.force_slope(params, applied, xi)

        def advance(vector: Float[Array, " vector"]) -> PathState:
            control = applied.control + input_error(vector[at:], road)
            given = applied._replace(control=control)
            return self.next_coordinates(params, given, vector[:at])

        vector = jnp.concatenate([xi, causes])
        jacobian = jax.jacfwd(advance)(vector)
        # By differences: the root in `with_force` has no derivative at 0.
        jacobian = jacobian.at[:, at + FORCE].set(slope)
        in_turns = road[0] / TIGHTEST * slope
        jacobian = jacobian.at[:, at + TURN_FORCE].set(in_turns)
        return advance(vector) + excess * slope, jacobian


class Belief(NamedTuple):
    """What is known between two control steps: arrays to save and to resume."""

    bank: Bank  # of (ξ, causes)
    applied: Applied  # what acted on the vehicle since the last step
    # Squared normalised errors of one-step predictions, with the causes and without,
    # averaged over the last seconds.
    scores: Float[Array, " 2"]


@dataclass(frozen=True)
class Estimator:
    """An extended Kalman filter for each hypothesis on friction and on jumps of f."""

    loop: Loop  # the learned closed loop
    transition: Float[Array, "filter filter"]  # of the Markov chain of the filters
    frictions: Float[Array, " filter"]  # of the filters; NaN where friction is measured
    sensors: Float[Array, " sensor"]  # variances of the measured ξ
    noise: Float[Array, "filter vector vector"]  # Q of the filters

    def follow(
        self,
        params: Params,
        belief: Belief,
        measured: PathState,
        usable: Bool[Array, ""],
    ) -> tuple[Belief, Bool[Array, ""]]:
        """Return the belief after one step and a measurement, and if it was rejected.

        A measurement that is not usable, or farther from every filter than a jump of
        the force could explain, is rejected: the causes stay as predicted, so that a
        sensor that freezes or jumps is never taken for a force. If it is usable, ξ
        starts anew from it.
        """
        size = measured.shape[0]
        expected = self._advanced(params, belief)
        # Without measurements a model may diverge in time.
        expected = _select(all_finite(expected), expected, belief.bank)
        after, explained = corrected(expected, measured, self.sensors)
        bounds = jnp.asarray(BOUNDS)
        causes = jnp.clip(after.means[:, size:], -bounds, bounds)
        after = after._replace(means=after.means.at[:, size:].set(causes))
        learned = usable & explained
        bank = _select(learned, after, expected)
        # Not explained, but usable: the car is believed to be there, without a cause.
        bank = _select(usable & ~learned, self._restarted(bank, measured), bank)
        scores = self._scores(params, belief, expected, measured)
        scores = jnp.where(learned, scores, belief.scores)
        return belief._replace(bank=bank, scores=scores), ~learned

    def causes(self, belief: Belief, shrinkage: float) -> Float[Array, " cause"]:
        """Return the estimated causes, with f̂ max(0, 1 − s var f / f̂²) of the force.

        A force that could be noise is thereby left alone (James-Stein).
        """
        size = self.sensors.shape[0]
        causes = belief.bank.mean()[size:]
        variance = belief.bank.variance()[size:]
        kept = 1.0 - shrinkage * variance[FORCE] / (causes[FORCE] ** 2 + 1e-9)
        return causes.at[FORCE].multiply(jnp.maximum(kept, 0.0))

    def _advanced(self, params: Params, belief: Belief) -> Bank:
        """The bank one step later, without a measurement."""
        bank = mixed(belief.bank, self.transition)
        size = self.sensors.shape[0]

        def one(mean: Array, friction: Array) -> tuple[Array, Array]:
            given = _assuming(belief.applied, friction)
            xi = mean[:size]
            causes = mean[size:]
            after, slope = self.loop.predicted(params, given, xi, causes)
            return jnp.concatenate([after, causes]), slope

        means, slopes = jax.vmap(one)(bank.means, self.frictions)
        stays = jnp.eye(bank.means.shape[1])[size:]
        stays = jnp.tile(stays, (means.shape[0], 1, 1))
        slopes = jnp.concatenate([slopes, stays], axis=1)
        spread = slopes @ bank.covariances @ slopes.swapaxes(1, 2) + self.noise
        # Symmetric in spite of rounding.
        spread = 0.5 * (spread + spread.swapaxes(1, 2))
        return Bank(means, spread, bank.probabilities)

    def _restarted(self, bank: Bank, measured: PathState) -> Bank:
        """The bank at a measured ξ, with the causes as they are."""
        size = measured.shape[0]
        covariances = bank.covariances.at[:, :size].set(0.0).at[:, :, :size].set(0.0)
        covariances = covariances.at[:, :size, :size].set(jnp.diag(self.sensors))
        means = bank.means.at[:, :size].set(measured)
        return bank._replace(means=means, covariances=covariances)

    def _scores(
        self, params: Params, belief: Belief, expected: Bank, measured: PathState
    ) -> Float[Array, " 2"]:
        """The scores after one more prediction."""
        size = measured.shape[0]
        mean = belief.bank.mean()
        applied = _assuming(belief.applied, expected.probabilities @ self.frictions)
        nothing = jnp.zeros_like(mean[size:])
        alone, _ = self.loop.predicted(params, applied, mean[:size], nothing)
        both = jnp.stack([expected.mean()[:size], alone])
        errors = jnp.minimum((both - measured) ** 2 / self.sensors, LARGEST_SCORE)
        return MEMORY * belief.scores + (1.0 - MEMORY) * errors.mean(axis=1)


def _assuming(applied: Applied, friction: Array) -> Applied:
    """What acts, if e is that of a filter: measured, or its own friction, no wind."""
    hypothesis = jnp.zeros_like(applied.env).at[FRICTION].set(friction)
    env = jnp.where(jnp.isnan(friction), applied.env, hypothesis)
    return applied._replace(env=env)


def _select(choice: Bool[Array, ""], first: Bank, second: Bank) -> Bank:
    """One of two banks."""
    return jax.tree.map(partial(jnp.where, choice), first, second)
