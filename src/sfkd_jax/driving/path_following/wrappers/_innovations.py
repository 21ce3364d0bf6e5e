"""A statistical test whether a vehicle is the one that its nominal model describes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sfkd_jax.driving.path_coordinates import HEADING, LATERAL, PATH_SPEED, PathState
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.geometry import without_pose
from sfkd_jax.types import BODY, Control, Environment, Fiber, Model, Scalar

WINDOWS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
"""Weights of the newest score in the moving means: windows of 1 to 330 steps."""
RELEASE = 0.7
"""Statistic below which an alarm ends: at 1 it would flicker."""
MEMORY = 0.98
"""Forgetting factor of the likelihoods of the delays: about 5 s at 10 Hz."""
LARGEST = 9.0
"""Limit of a squared normalised innovation, so that one outlier decides nothing."""
EVIDENCE = 16.0
"""Difference of log-likelihoods from which on another delay is believed. Innovations of
a model are neither white nor Gaussian, so it is large.
"""

Means = Float[Array, "window chart"]
Readings = Float[Array, " chart"]  # ξ, and its heading once more


class InnovationState(NamedTuple):
    """What the test carries from one control step to the next.

    Attributes:
        expected: readings of this step under each delay, predicted from the last
            measured ones; NaN without those.
        inside: whether the model says so of each delay, see `PredictedStep`.
        level: of the prediction, see `SteadyTurn.level`.
        means: moving means of the scores.
        alarm: whether the last step raised or kept one.
        fit: log-likelihood of each delay over the last seconds.
        delay: index of the delay that is believed.
    """

    expected: Float[Array, "delay chart"]
    inside: Bool[Array, " delay"]
    level: Scalar
    means: Means
    alarm: Bool[Array, ""]
    fit: Float[Array, " delay"]
    delay: Int[Array, ""]


class InnovationTest(NamedTuple):
    """Moving means of weighted one-step innovations, against calibrated thresholds.

        r = ξ⁺ − F(ξ; u − law(ξ), κ, v_ref, e)
        s_i = r_i / σ_i(0) · min_j (σ_j(0) / σ_j(level))²
        m_w ← m_w + w (s − m_w),   statistic = max |m_w| / threshold_w

    r is from one measurement to the next, so noise telescopes in a mean over w⁻¹ steps,
    and lasting errors decide. The weight is that of the likelihood ratio of a constant
    error in noise whose size changes, 1/σ². Short windows detect a jump, long ones a
    drift (geometric moving averages; Roberts, 1959). A statistic above 1 means that the
    vehicle or its sensors are not those of the calibration. A last chart compares the
    heading with the steady turn that the law knows for the steering, which is exact
    where F is not.

    If the latency of the system may be wrong, r is computed for several delays of the
    commands. That with the largest likelihood over the last seconds is believed, and
    the others raise no alarm:

        fit_d ← λ fit_d − ½ Σ_i min((r_{d,i} / σ_i(level))², 9)

    Attributes:
        levels: rising, of `SteadyTurn.level`.
        deviation: σ of r at these levels, in units of ξ.
        threshold: of the moving means, for each of `WINDOWS`.
        later: delays that are compared, by how many periods commands act later than
            stated; see `CommandDelay.hypotheses`.
    """

    levels: Float[Array, " level"]
    deviation: Float[Array, "level chart"]
    threshold: Means
    later: tuple[float, ...] = (0.0,)

    def init(self) -> InnovationState:
        """Return the state before the first measurement."""
        size = self.deviation.shape[1]
        delays = len(self.later)
        return InnovationState(
            expected=jnp.full((delays, size), jnp.nan, dtype=float),
            inside=jnp.zeros(delays, bool),
            level=jnp.zeros(()),
            means=jnp.zeros((len(WINDOWS), size)),
            alarm=jnp.asarray(False),
            fit=jnp.zeros(delays),
            delay=jnp.argmin(jnp.abs(jnp.asarray(self.later))),
        )

    def update(
        self,
        state: InnovationState,
        xi: PathState,
        measured: Bool[Array, " coordinate"],
    ) -> tuple[InnovationState, Scalar]:
        """Return the state after a measurement, and the statistic."""
        seen = jnp.where(measured, xi, jnp.nan)
        innovations = jnp.append(seen, seen[HEADING]) - state.expected
        state = self._compared(state, innovations)
        inside = state.inside[state.delay]
        innovation = jnp.where(inside, innovations[state.delay], jnp.nan)
        means = self.moved(state.means, innovation, state.level)
        statistic = jnp.max(jnp.abs(means) / self.threshold)
        alarm = statistic > jnp.where(state.alarm, RELEASE, 1.0)
        return state._replace(means=means, alarm=alarm), statistic

    def _compared(
        self, state: InnovationState, innovations: Float[Array, "delay chart"]
    ) -> InnovationState:
        """Return the state with the delay that fits the innovations best."""
        if len(self.later) == 1:
            return state
        # The last chart is the heading once more.
        normalised = (innovations / self._deviation(state.level))[:, :-1]
        surprise = jnp.sum(jnp.minimum(normalised**2, LARGEST), axis=1)
        # A command of the wrong time is not what the law would do.
        comparable = jnp.all(jnp.isfinite(surprise)) & jnp.any(state.inside)
        fit = jnp.where(comparable, MEMORY * state.fit - 0.5 * surprise, state.fit)
        best = jnp.argmax(fit)
        changed = fit[best] - fit[state.delay] > EVIDENCE
        # The means are those of another delay.
        return state._replace(
            fit=fit,
            delay=jnp.where(changed, best, state.delay),
            means=jnp.where(changed, 0.0, state.means),
        )

    def _deviation(self, level: Scalar) -> Readings:
        """Return σ of the innovations at a level of the law."""

        def interpolate(column: Float[Array, " level"]) -> Scalar:
            return jnp.interp(level, self.levels, column)

        return jax.vmap(interpolate)(self.deviation.T)

    def moved(self, means: Means, innovation: Readings, level: Scalar) -> Means:
        """Return the moving means with one more innovation, NaN without one."""
        usual = self.deviation[0]
        # The largest ratio serves all entries: where a model errs in one of them, it
        # errs in others for a while.
        ratio = jnp.max((self._deviation(level) / usual)[:-1])
        ratio = jnp.append(jnp.full_like(usual[1:], jnp.maximum(ratio, 1.0)), 1.0)
        score = innovation / (usual * ratio**2)
        moved = means + jnp.asarray(WINDOWS)[:, None] * (score - means)
        # The means are held, not moved towards 0: a sensor that fails must not end an
        # alarm.
        return jnp.where(jnp.isnan(innovation), means, moved)


def innovation_test(
    levels: Sequence[float],
    deviation: Sequence[Sequence[float]],
    threshold: Sequence[Sequence[float]],
    later: tuple[float, ...] = (0.0,),
) -> InnovationTest:
    """Return the test of a certificate, on the device; see `InnovationTest`."""
    entries = [np.asarray(entry, float) for entry in (levels, deviation, threshold)]
    calibrated = InnovationTest(*jax.device_put(entries))
    return calibrated._replace(later=later)


def expected_coordinates(
    model: Model, fiber: Fiber, xi: PathState, nu: Control, road: Float[Array, " 2"]
) -> PathState:
    """Return the ξ that the nominal model expects one step after a measured one."""
    latent = model.encode(fiber, without_pose(xi))
    after = model.step(fiber, latent, jnp.concatenate([nu, road]))
    return model.decode(fiber, after)[BODY]


def turning_rate(
    law: PathLaw, xi: PathState, control: Control, road: Array, env: Environment
) -> Scalar:
    """Return how fast e_ψ changes in the steady turn of this steering [rad/s]."""
    # The path turns by κ a metre, counted at the foot of the car.
    path = road[0] * jnp.cos(xi[HEADING]) / (1.0 - road[0] * xi[LATERAL])
    turn = law.curvature(control[0], xi[PATH_SPEED], env)
    return xi[PATH_SPEED] * (turn - path)
