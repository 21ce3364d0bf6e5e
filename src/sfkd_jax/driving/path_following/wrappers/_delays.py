"""By how much the commands of a vehicle act later than stated, from its innovations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.driving.path_coordinates import HEADING, PathState
from sfkd_jax.driving.path_following.wrappers._innovations import deviation_at
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.types import Scalar

GAIN = 0.3
"""Gain of the observers. With a gain of 1 a delay would be confused with the answer of
the law to the noise of a measurement.
"""
MEMORY = 0.98
"""Forgetting factor of the likelihoods: about 5 s at 10 Hz."""
LARGEST = 9.0
"""Limit of a squared normalised innovation, so that one outlier decides nothing."""
EVIDENCE = 16.0
"""Difference of log-likelihoods from which on another delay is believed. Innovations of
a model are neither white nor Gaussian, so it is large.
"""
EXPLAINED = 2.0
"""Largest mean squared normalised innovation of a delay that is believed. No delay
explains what a steering offset does.
"""


class DelayState(NamedTuple):
    """What the observers carry from one control step to the next.

    Attributes:
        expected: ξ of this step by each observer; NaN before the first measurement.
        estimate: ξ by each observer, after the measurement.
        level: of the prediction, see `SteadyTurn.level`.
        fit: log-likelihood of each delay over the last seconds.
        steps: number of steps in it, each weighted as its likelihood is.
        best: index of the delay that is believed.
    """

    expected: Float[Array, "delay coordinate"]
    estimate: Float[Array, "delay coordinate"]
    level: Scalar
    fit: Float[Array, " delay"]
    steps: Scalar
    best: Int[Array, ""]


class DelayEstimator(NamedTuple):
    """An observer for each delay of the commands; the one that predicts best is right.

        ξ̂⁻_d = F(ξ̂_d; u_d − law(ξ̂_d), κ, v_ref, e),   ξ̂_d = ξ̂⁻_d + L (ξ − ξ̂⁻_d)
        fit_d ← λ fit_d − ½ Σ_i min(((ξ − ξ̂⁻_d)_i / σ_i(level))², 9)

    u_d is what acts if the commands are late by d. Another delay is believed once its
    fit is better by `EVIDENCE`, if it explains what is seen. Where the commands hardly
    change, all observers predict the same, and the delay stays as it is.

    Attributes:
        levels: rising, of `SteadyTurn.level`.
        deviation: σ of an innovation at these levels, in units of ξ.
        later: the delays, by how many periods commands act later than stated; see
            `CommandDelay.hypotheses`.

    Source: Magill (1965), IEEE Transactions on Automatic Control 10, 434-439.
    """

    levels: Float[Array, " level"]
    deviation: Float[Array, "level coordinate"]
    later: tuple[float, ...]

    def init(self) -> DelayState:
        """Return the state before the first measurement."""
        shape = (len(self.later), self.deviation.shape[1])
        unknown = jnp.full(shape, jnp.nan, dtype=float)
        return DelayState(
            expected=unknown,
            estimate=unknown,
            level=jnp.zeros(()),
            fit=jnp.zeros(shape[0]),
            steps=jnp.zeros(()),
            best=jnp.asarray(self.later.index(0.0), jnp.int32),
        )

    def update(
        self, state: DelayState, xi: PathState, used: Bool[Array, ""]
    ) -> DelayState:
        """Return the state after a measurement.

        Args:
            state: after the last step.
            xi: measured ξ.
            used: whether all of it is measured, one period after the last one.
        """
        innovation = xi - state.expected
        turned = wrap_angle(innovation[:, HEADING])
        innovation = innovation.at[:, HEADING].set(turned)
        known = used & jnp.all(jnp.isfinite(innovation))
        corrected = state.expected + GAIN * innovation
        estimate = jnp.where(known, corrected, jnp.where(used, xi, state.expected))
        deviation = deviation_at(state.level, self.levels, self.deviation)
        surprise = (innovation / deviation) ** 2
        surprise = jnp.sum(jnp.minimum(surprise, LARGEST), axis=1)
        fit = jnp.where(known, MEMORY * state.fit - 0.5 * surprise, state.fit)
        steps = jnp.where(known, MEMORY * state.steps + 1.0, state.steps)
        best = jnp.argmax(fit)
        explained = -2.0 * fit[best] <= EXPLAINED * xi.shape[0] * steps
        changed = explained & (fit[best] - fit[state.best] > EVIDENCE)
        return state._replace(
            estimate=estimate,
            fit=fit,
            steps=steps,
            best=jnp.where(changed, best, state.best).astype(jnp.int32),
        )

    def delay(self, state: DelayState) -> Scalar:
        """Return the delay that is believed, in periods."""
        return jnp.asarray(self.later)[state.best]


def delay_estimator(
    levels: Sequence[float],
    deviation: Sequence[Sequence[float]],
    later: tuple[float, ...],
) -> DelayEstimator:
    """Return the estimator of a certificate, on the device; see `DelayEstimator`.

    Args:
        levels: of the calibrated test of the innovations.
        deviation: of the same test, whose last chart is not one of ξ.
        later: the delays.
    """
    entries = (np.asarray(levels, float), np.asarray(deviation, float)[:, :-1])
    known_levels, deviations = jax.device_put(entries)
    return DelayEstimator(known_levels, deviations, later)
