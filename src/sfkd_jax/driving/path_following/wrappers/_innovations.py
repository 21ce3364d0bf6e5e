"""A statistical test whether a vehicle is the one that its nominal model describes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.path_coordinates import HEADING, LATERAL, PATH_SPEED, PathState
from sfkd_jax.driving.path_following.laws._path_law import PathLaw
from sfkd_jax.geometry import without_pose
from sfkd_jax.types import BODY, Control, Environment, Fiber, Model, Scalar

WINDOWS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
"""Weights of the newest score in the moving means: windows of 1 to 330 steps."""
RELEASE = 0.7
"""Statistic below which an alarm ends: at 1 it would flicker."""

Means = Float[Array, "window chart"]
Readings = Float[Array, " chart"]  # ξ, and its heading once more


class InnovationState(NamedTuple):
    """What the test carries from one control step to the next."""

    # Readings of this step, predicted from the last measured ones; NaN without those.
    expected: Readings
    level: Scalar  # of the prediction, see `SteadyTurn.level`
    means: Means  # moving means of the scores
    alarm: Bool[Array, ""]  # whether the last step raised or kept one


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

    Attributes:
        levels: rising, of `SteadyTurn.level`.
        deviation: σ of r at these levels, in units of ξ.
        threshold: of the moving means, for each of `WINDOWS`.
    """

    levels: Float[Array, " level"]
    deviation: Float[Array, "level chart"]
    threshold: Means

    def init(self) -> InnovationState:
        """Return the state before the first measurement."""
        size = self.deviation.shape[1]
        return InnovationState(
            expected=jnp.full(size, jnp.nan, dtype=float),
            level=jnp.zeros(()),
            means=jnp.zeros((len(WINDOWS), size)),
            alarm=jnp.asarray(False),
        )

    def update(
        self,
        state: InnovationState,
        xi: PathState,
        measured: Bool[Array, " coordinate"],
    ) -> tuple[InnovationState, Scalar]:
        """Return the state after a measurement, and the statistic."""
        seen = jnp.where(measured, xi, jnp.nan)
        innovation = jnp.append(seen, seen[HEADING]) - state.expected
        means = self.moved(state.means, innovation, state.level)
        statistic = jnp.max(jnp.abs(means) / self.threshold)
        alarm = statistic > jnp.where(state.alarm, RELEASE, 1.0)
        return state._replace(means=means, alarm=alarm), statistic

    def anew(self, state: InnovationState, begins: Bool[Array, ""]) -> InnovationState:
        """Return the state, as before the first measurement if the test begins anew."""
        return jax.tree.map(partial(jnp.where, begins), self.init(), state)

    def moved(self, means: Means, innovation: Readings, level: Scalar) -> Means:
        """Return the moving means with one more innovation, NaN without one."""
        usual = self.deviation[0]
        deviation = deviation_at(level, self.levels, self.deviation)
        # The largest ratio serves all entries: where a model errs in one of them, it
        # errs in others for a while.
        ratio = jnp.max((deviation / usual)[:-1])
        ratio = jnp.append(jnp.full_like(usual[1:], jnp.maximum(ratio, 1.0)), 1.0)
        score = innovation / (usual * ratio**2)
        moved = means + jnp.asarray(WINDOWS)[:, None] * (score - means)
        # The means are held, not moved towards 0: a sensor that fails must not end an
        # alarm.
        return jnp.where(jnp.isnan(innovation), means, moved)

    def largest_turn(self, level: Scalar) -> Scalar:
        """Return the largest innovation of the heading that noise explains [rad]."""
        deviation = deviation_at(level, self.levels, self.deviation)
        return self.threshold[0, HEADING] * deviation[HEADING]


def deviation_at(
    level: Scalar,
    levels: Float[Array, " level"],
    deviation: Float[Array, "level column"],
) -> Float[Array, " column"]:
    """Return the standard deviations of innovations at a level of the law.

    Args:
        level: see `SteadyTurn.level`.
        levels: at which they are known, rising.
        deviation: at these levels.
    """

    def interpolate(column: Float[Array, " level"]) -> Scalar:
        return jnp.interp(level, levels, column)

    return jax.vmap(interpolate)(deviation.T)


def innovation_test(
    levels: Sequence[float],
    deviation: Sequence[Sequence[float]],
    threshold: Sequence[Sequence[float]],
) -> InnovationTest:
    """Return the test of a certificate, on the device; see `InnovationTest`."""
    entries = [np.asarray(entry, float) for entry in (levels, deviation, threshold)]
    return InnovationTest(*jax.device_put(entries))


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
