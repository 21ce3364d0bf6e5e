"""The estimator of ξ and of unmeasured causes along a path.

It consists of interacting multiple models: extended Kalman filters, on the derivatives
of the learned model, that are joined by a Markov chain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.control import all_finite
from sfkd_jax.driving.path_coordinates import PathState
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.driving.path_following.wrappers._innovations import expected_coordinates
from sfkd_jax.types import Control, Environment, Model, Params, Scalar

FRICTION = 0
"""Entry of e that is the friction."""
WIND = 1
"""Entry of e that is the wind."""
FORCE, STEERING, DRIVE, TURN_STEERING, TURN_FORCE = range(5)
"""Entries of the causes. The last two are proportional to κ."""
CAUSES = 5
"""Number of causes."""
BOUNDS = (4.0, 0.1, 3.0, 0.1, 4.0)
"""Largest causes that are believed: four times the side force of E, 6° of steering."""
FORCE_STEP = 0.25
"""Half the distance of the two relative side forces that give a slope."""
TIGHTEST = 0.02
"""Curvature [1/m] at which the causes proportional to κ have their full effect."""
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
        between_filters = (self.means - self.mean()) ** 2
        within_filters = jnp.diagonal(self.covariances, axis1=1, axis2=2)
        return self.probabilities @ (within_filters + between_filters)


def mixed(bank: Bank, transition: Float[Array, "filter filter"]) -> Bank:
    """Return the bank after a transition of the Markov chain.

        c_j = Σ_i Π_ij p_i,   x̄_j = Σ_i Π_ij p_i x_i / c_j

    P̄_j is the covariance of that mixture. Source: Blom and Bar-Shalom (1988).
    """
    joint = transition * bank.probabilities[:, None]
    expected = joint.sum(axis=0)
    # There is no division by 0: every entry of Π is positive, hence every entry of c.
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
    """Return the bank after a measurement of its first entries.

    The sensors are independent and processed one by one, in Joseph's form, which keeps
    covariances positive in float32.

    Returns:
        The bank, and whether the measurement is explained. It is not if every filter is
        farther away than `OUTLIER` or is not finite.
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
    # A filter that is NaN counts as impossible, or all probabilities would be NaN.
    fit = jnp.where(jnp.isfinite(surprise), fit + surprise, -jnp.inf)
    relative = jnp.exp(fit - jnp.max(fit)) + LEAST_LIKELIHOOD
    weights = bank.probabilities * relative
    explained = jnp.max(jnp.nan_to_num(surprise, nan=-math.inf)) > OUTLIER
    return Bank(means, covariances, weights / weights.sum()), explained


def transition_matrix(
    low: float, high: float, points: int, drift: float, dwell: float
) -> Float[Array, "m m"]:
    """Return the symmetric Π of diffusion on a grid and of jumps to any of its points.

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
    """What acts on the vehicle over a step: u, (κ [1/m], v_ref [m/s]) and e in E."""

    control: Control
    road: Float[Array, " 2"]
    env: Environment


def side_force(causes: Float[Array, " cause"], road: Float[Array, " 2"]) -> Scalar:
    """Return the relative side force of the causes on a road."""
    return causes[FORCE] + causes[TURN_FORCE] * road[0] / TIGHTEST


def input_error(causes: Float[Array, " cause"], road: Float[Array, " 2"]) -> Control:
    """Return what acts besides the control: steering [rad], drive [control unit]."""
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
        # The root has no derivative at 0, but nothing is differentiated by the force.
        root = jnp.sign(force) * jnp.abs(force) ** (1.0 / self.power)
        return env.at[WIND].set(self.high[WIND] * root)

    def split_force(
        self, env: Environment, force: Scalar
    ) -> tuple[Environment, Scalar]:
        """Return the e in E with as much of an additional force as fits, and the rest.

        Forces are relative to the largest one in E.
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

        It is a difference quotient over forces on both sides of that of e; at an end of
        E it is one-sided. Beyond E the model is continued along this slope.
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

        Within E the force acts as wind, and beyond E along `force_slope`. `applied` has
        the e without the causes.
        """
        size = xi.shape[0]
        road = applied.road
        env, excess = self.split_force(applied.env, side_force(causes, road))
        applied = applied._replace(env=env)
        slope = self.force_slope(params, applied, xi)

        def advance(vector: Float[Array, " vector"]) -> PathState:
            control = applied.control + input_error(vector[size:], road)
            acting = applied._replace(control=control)
            return self.next_coordinates(params, acting, vector[:size])

        vector = jnp.concatenate([xi, causes])
        jacobian = jax.jacfwd(advance)(vector)
        # From difference quotients: the root in `with_force` has no derivative at 0.
        jacobian = jacobian.at[:, size + FORCE].set(slope)
        in_turns = road[0] / TIGHTEST * slope
        jacobian = jacobian.at[:, size + TURN_FORCE].set(in_turns)
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
    """An extended Kalman filter for each hypothesis on friction and on force jumps."""

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

        A measurement is rejected if it is not usable, or farther from every filter than
        a jump of the force could explain. The causes then stay as predicted, so a
        sensor that freezes or jumps is never taken for a force. If a rejected
        measurement is usable, ξ starts anew from it.
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
        # Where a usable measurement is not explained, the car is believed to be there,
        # and no cause is learned.
        bank = _select(usable & ~learned, self._restarted(bank, measured), bank)
        scores = self._scores(params, belief, expected, measured)
        scores = jnp.where(learned, scores, belief.scores)
        return belief._replace(bank=bank, scores=scores), ~learned

    def causes(self, belief: Belief, shrinkage: float) -> Float[Array, " cause"]:
        """Return the estimated causes, with a force that is shrunk (James-Stein).

            f̂ max(0, 1 − s var f / f̂²)

        A force that could be noise is thereby not compensated. `shrinkage` is s.
        """
        size = self.sensors.shape[0]
        causes = belief.bank.mean()[size:]
        variance = belief.bank.variance()[size:]
        share = 1.0 - shrinkage * variance[FORCE] / (causes[FORCE] ** 2 + 1e-9)
        return causes.at[FORCE].multiply(jnp.maximum(share, 0.0))

    def _advanced(self, params: Params, belief: Belief) -> Bank:
        """Return the bank one step later, without a measurement."""
        bank = mixed(belief.bank, self.transition)
        size = self.sensors.shape[0]

        def predict(mean: Array, friction: Array) -> tuple[Array, Array]:
            applied = _assuming(belief.applied, friction)
            xi = mean[:size]
            causes = mean[size:]
            after, jacobian = self.loop.predicted(params, applied, xi, causes)
            return jnp.concatenate([after, causes]), jacobian

        means, jacobians = jax.vmap(predict)(bank.means, self.frictions)
        # The causes stay as they are.
        rows = jnp.eye(bank.means.shape[1])[size:]
        rows = jnp.tile(rows, (means.shape[0], 1, 1))
        jacobians = jnp.concatenate([jacobians, rows], axis=1)
        covariances = jacobians @ bank.covariances @ jacobians.swapaxes(1, 2)
        covariances = covariances + self.noise
        # Rounding must not make them unsymmetric.
        covariances = 0.5 * (covariances + covariances.swapaxes(1, 2))
        return Bank(means, covariances, bank.probabilities)

    def _restarted(self, bank: Bank, measured: PathState) -> Bank:
        """Return the bank at a measured ξ, with the causes as they are."""
        size = measured.shape[0]
        covariances = bank.covariances.at[:, :size].set(0.0).at[:, :, :size].set(0.0)
        covariances = covariances.at[:, :size, :size].set(jnp.diag(self.sensors))
        means = bank.means.at[:, :size].set(measured)
        return bank._replace(means=means, covariances=covariances)

    def _scores(
        self, params: Params, belief: Belief, expected: Bank, measured: PathState
    ) -> Float[Array, " 2"]:
        """Return the scores after one more prediction."""
        size = measured.shape[0]
        mean = belief.bank.mean()
        applied = _assuming(belief.applied, expected.probabilities @ self.frictions)
        no_causes = jnp.zeros_like(mean[size:])
        model_alone, _ = self.loop.predicted(params, applied, mean[:size], no_causes)
        predictions = jnp.stack([expected.mean()[:size], model_alone])
        errors = (predictions - measured) ** 2 / self.sensors
        errors = jnp.minimum(errors, LARGEST_SCORE)
        return MEMORY * belief.scores + (1.0 - MEMORY) * errors.mean(axis=1)


def _assuming(applied: Applied, friction: Array) -> Applied:
    """Return what acts if the hypothesis of a filter is true.

    With a friction of NaN, e is measured; otherwise it is that friction without wind.
    """
    hypothesis = jnp.zeros_like(applied.env).at[FRICTION].set(friction)
    env = jnp.where(jnp.isnan(friction), applied.env, hypothesis)
    return applied._replace(env=env)


def _select(choice: Bool[Array, ""], first: Bank, second: Bank) -> Bank:
    """Return the first of two banks where `choice` is true, else the second."""
    return jax.tree.map(partial(jnp.where, choice), first, second)
