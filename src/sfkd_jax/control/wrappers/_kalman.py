"""Interacting multiple models: extended Kalman filters joined by a Markov chain."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

OUTLIER = -200.0
"""Log-likelihood relative to a perfect match below which no filter explains a
measurement: eight standard deviations.
"""
LEAST_LIKELIHOOD = 1e-9
"""Floor relative to the best filter, so that every filter can become likely again."""


class Bank(NamedTuple):
    """The Gaussian estimates of all filters and their probabilities.

    Attributes:
        means: of the estimated vector.
        covariances: of its errors.
        probabilities: of the filters.
    """

    means: Float[Array, "filter n"]
    covariances: Float[Array, "filter n n"]
    probabilities: Float[Array, " filter"]

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

    Args:
        bank: before the transition.
        transition: Π, rows sum to 1.
    """
    joint = transition * bank.probabilities[:, None]
    expected = joint.sum(axis=0)
    weights = joint / expected
    means = weights.T @ bank.means
    gaps = bank.means[:, None] - means[None]
    covariances = jnp.einsum("ij,iab->jab", weights, bank.covariances)
    covariances += jnp.einsum("ij,ija,ijb->jab", weights, gaps, gaps)
    return Bank(means, covariances, expected)


def propagated(
    covariances: Float[Array, "filter n n"],
    slopes: Float[Array, "filter n n"],
    noise: Float[Array, "filter n n"],
) -> Float[Array, "filter n n"]:
    """Return A P Aᵀ + Q of every filter, symmetric in spite of rounding."""
    after = slopes @ covariances @ slopes.swapaxes(1, 2) + noise
    return 0.5 * (after + after.swapaxes(1, 2))


def corrected(
    bank: Bank,
    measurement: Float[Array, " sensor"],
    variances: Float[Array, " sensor"],
) -> tuple[Bank, Bool[Array, ""]]:
    """Return the bank after a measurement of the first entries, and if it is explained.

    The sensors are independent and processed one by one, in Joseph's form, which keeps
    covariances positive in float32.

    Args:
        bank: predicted.
        measurement: of the first entries of the vector.
        variances: of the sensors.

    Returns:
        The bank, and False if every filter is farther away than `OUTLIER` or is not
        finite.
    """
    means, covariances = bank.means, bank.covariances
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
    fit = jnp.where(jnp.isfinite(surprise), fit + surprise, -jnp.inf)
    relative = jnp.exp(fit - jnp.max(fit)) + LEAST_LIKELIHOOD
    weights = bank.probabilities * relative
    explained = jnp.max(jnp.nan_to_num(surprise, nan=-math.inf)) > OUTLIER
    return Bank(means, covariances, weights / weights.sum()), explained


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
