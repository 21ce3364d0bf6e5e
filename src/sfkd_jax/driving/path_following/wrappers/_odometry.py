"""A test whether the measured positions move as the measured speed says."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.path_following.wrappers._innovations import RELEASE, WINDOWS
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.types import POSE, Scalar, State

TOLERANCE = 0.01
"""Share of the way by which position and speed may differ: a worn tyre."""
DEVIATIONS = 6.0
"""Threshold in standard deviations of the mean: about one false alarm in a year."""
SPEED = 3
"""Index of the speed in a state of a vehicle."""


class OdometryState(NamedTuple):
    """What the test carries from one control step to the next.

    Attributes:
        before: last complete observation; NaN without one.
        means: moving means of the difference and of the way of a step [m].
        alarm: whether the last step raised or kept one.
    """

    before: State
    means: Float[Array, "window 2"]
    alarm: Bool[Array, ""]


class OdometryTest(NamedTuple):
    """Moving means of the difference between a step of the position and that of speed.

        r = (p⁺ − p) · (cos ψ̄, sin ψ̄) − Δt (v + v⁺) / 2,   m_w ← m_w + w (r − m_w)

    ψ̄ is the mean yaw of the step. The noise of a position telescopes in a mean, so a
    position that stands still, is dragged along the road, or is scaled, contradicts the
    speed after few steps. Neither a model nor a reference is needed.

    Attributes:
        position: standard deviation of a measured position [m].
        speed: of a measured speed [m/s].
        dt: sampling period [s].
    """

    position: float
    speed: float
    dt: float

    def init(self, states: int) -> OdometryState:
        """Return the state before the first measurement.

        Args:
            states: size of an observation.
        """
        return OdometryState(
            before=jnp.full(states, jnp.nan, dtype=float),
            means=jnp.zeros((len(WINDOWS), 2)),
            alarm=jnp.asarray(False),
        )

    def update(
        self, state: OdometryState, observation: State, used: Bool[Array, ""]
    ) -> tuple[OdometryState, Scalar]:
        """Return the state after an observation, and the statistic.

        Args:
            state: after the last step.
            observation: in the world.
            used: whether all of it is measured, one period after the last one.
        """
        before = state.before
        step = observation - before
        yaw = before[2] + 0.5 * wrap_angle(step[2])
        forwards = step[0] * jnp.cos(yaw) + step[1] * jnp.sin(yaw)
        way = 0.5 * self.dt * (observation[SPEED] + before[SPEED])
        now = jnp.stack([forwards - way, jnp.abs(way)])
        moved = state.means + jnp.asarray(WINDOWS)[:, None] * (now - state.means)
        # In the frame of the vehicle its pose is 0, and no position is measured.
        in_the_world = jnp.any(observation[POSE] != 0.0)
        compared = used & in_the_world & jnp.all(jnp.isfinite(now))
        means = jnp.where(compared, moved, state.means)
        allowed = DEVIATIONS * self._deviations() + TOLERANCE * means[:, 1]
        statistic = jnp.max(jnp.abs(means[:, 0]) / allowed)
        after = OdometryState(
            before=jnp.where(used, observation, jnp.nan),
            means=means,
            alarm=statistic > jnp.where(state.alarm, RELEASE, 1.0),
        )
        return after, statistic

    def _deviations(self) -> Float[Array, " window"]:
        """Return the standard deviations of the means [m]."""
        w = np.asarray(WINDOWS)
        share = w / (2.0 - w)
        # White noise of the position enters a step twice, with both signs.
        position = self.position**2 * 2.0 * w * share
        speed = (self.dt * self.speed) ** 2 * share
        return jnp.asarray(np.sqrt(position + speed), dtype=float)
