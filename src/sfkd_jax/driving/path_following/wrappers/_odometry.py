"""A test whether the measured positions move as the measured speeds say."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.path_following.wrappers._innovations import RELEASE, WINDOWS
from sfkd_jax.geometry import rotate, wrap_angle
from sfkd_jax.types import POSE, Scalar, State

TOLERANCE = (0.01, 0.002)
"""Share of the distance by which position and speed may differ, along and across the
vehicle: a worn tyre, and a sensor of the yaw that is mounted 2 mrad off.
"""
DEVIATIONS = 6.0
"""Threshold in standard deviations of the mean: a false alarm in some months."""
YAW = 2
"""Index of the yaw in a state of a vehicle."""
SPEED = 3
"""Index of the speed in a state of a vehicle."""


class OdometryState(NamedTuple):
    """What the test carries from one control step to the next.

    Attributes:
        before: last complete observation; NaN without one.
        means: moving means of the differences along and across the vehicle, and of the
            distance driven in a step [m].
        alarm: whether the last step raised or kept one.
    """

    before: State
    means: Float[Array, "window 3"]
    alarm: Bool[Array, ""]


class OdometryTest(NamedTuple):
    """Moving means of the difference between a step of the position and of the speeds.

        r = R(−ψ̄) (p⁺ − p) − Δt (v̄, v̄_y),   m_w ← m_w + w (r − m_w)

    Bars are means of both ends of the step. The noise of a position telescopes in a
    mean, so a position that stands still, is dragged away, or is scaled, contradicts
    the speeds after few steps. Neither a model nor a reference is needed. Across the
    vehicle only one that measures v_y is tested.

    Attributes:
        deviations: standard deviations of the measured states.
        dt: sampling period [s].
        sideways: index of v_y [m/s] in a state; None if it is not measured.
    """

    deviations: tuple[float, ...]
    dt: float
    sideways: int | None = None

    def init(self) -> OdometryState:
        """Return the state before the first measurement."""
        return OdometryState(
            before=jnp.full(len(self.deviations), jnp.nan, dtype=float),
            means=jnp.zeros((len(WINDOWS), 3)),
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
        yaw = before[YAW] + 0.5 * wrap_angle(step[YAW])
        forwards, left = rotate(-yaw, step[:2])
        integrals = 0.5 * self.dt * (observation + before)
        across = jnp.zeros(())
        if self.sideways is not None:
            across = left - integrals[self.sideways]
        driven = integrals[SPEED]
        now = jnp.stack([forwards - driven, across, jnp.abs(driven)])
        moved = state.means + jnp.asarray(WINDOWS)[:, None] * (now - state.means)
        # In the frame of the vehicle its pose is 0, and no position is measured.
        in_the_world = jnp.any(observation[POSE] != 0.0)
        compared = used & in_the_world & jnp.all(jnp.isfinite(now))
        means = jnp.where(compared, moved, state.means)
        distance = means[:, 2:]
        tolerated = distance * jnp.asarray(TOLERANCE)
        allowed = DEVIATIONS * self._spread(distance) + tolerated
        statistic = jnp.max(jnp.abs(means[:, :2]) / allowed)
        after = OdometryState(
            before=jnp.where(used, observation, jnp.nan),
            means=means,
            alarm=statistic > jnp.where(state.alarm, RELEASE, 1.0),
        )
        return after, statistic

    def _spread(self, distance: Float[Array, "window 1"]) -> Float[Array, "window 2"]:
        """Return the standard deviations of the means, along and across [m].

        Args:
            distance: driven in a step [m].
        """
        noise = np.asarray(self.deviations)
        w = np.asarray(WINDOWS)[:, None]
        share = w / (2.0 - w)
        # White noise of the position enters a step twice, with both signs.
        position = max(noise[:2]) ** 2 * 2.0 * w * share
        across = 0.0 if self.sideways is None else noise[self.sideways]
        speeds = (self.dt * np.stack([noise[SPEED], across])) ** 2 * share
        turned = noise[YAW] * distance
        yaw = jnp.concatenate([jnp.zeros_like(turned), turned], axis=1)
        return jnp.sqrt(position + speeds + share * yaw**2)
