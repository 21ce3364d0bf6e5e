"""Feedback laws on the errors from a reference path, made by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.control.laws._recovery import (
    GRIP,
    PathErrors,
    SteadyTurn,
    holding,
    moving,
    often,
    recovering,
)
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.types import Control, Scalar, State

FeedbackLaw: TypeAlias = Callable[[PathErrors, Scalar, Scalar], Control]
"""(path errors, curvature [1/m], reference speed [m/s]) -> control."""


def path_errors(
    state: State, point: Float[Array, " 4"], curvature: Scalar
) -> PathErrors:
    """Return the errors relative to the circle that touches the path at `point`.

    They are exact to second order in the distance along the circle, and cheaper than
    `geometry.circle_errors`: a planner needs them thousands of times a step.

    Args:
        state: p_x, p_y, yaw, v, ….
        point: x, y, yaw, speed of the reference.
        curvature: of the path at `point` [1/m].
    """
    dx, dy = state[0] - point[0], state[1] - point[1]
    c, s = jnp.cos(point[2]), jnp.sin(point[2])
    along = c * dx + s * dy
    # The path bends away from its tangent by κ/2 · along².
    lateral = c * dy - s * dx - 0.5 * curvature * along**2
    heading = wrap_angle(state[2] - point[2] - curvature * along)
    return PathErrors(lateral, heading, state[3] - point[3])


@dataclass(frozen=True, kw_only=True)
class LinearFeedback:
    """The path-following law u = u_ff(κ) + K ξ, for small errors.

        δ = atan(L κ) − k_y e_y − k_ψ e_ψ
        a = −k_v e_v,   or the speed command v_ref − k_v e_v

    Attributes:
        wheelbase: L [m].
        lateral_gain: k_y [rad/m].
        heading_gain: k_ψ [-].
        speed_gain: k_v [1/s], or [-] with a speed loop.
        speed_loop: whether the second control is a speed command.
    """

    wheelbase: float
    lateral_gain: float = 0.03
    heading_gain: float = 0.4
    speed_gain: float = 1.0
    speed_loop: bool = False

    def __call__(self, errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        """Return u, without any limit."""
        # Feed-forward of the bicycle without slip; feedback makes up for the rest.
        steering = (
            jnp.arctan(self.wheelbase * curvature)
            - self.lateral_gain * errors.lateral
            - self.heading_gain * errors.heading
        )
        correction = -self.speed_gain * errors.speed
        return jnp.stack(
            [steering, correction + speed if self.speed_loop else correction]
        )


@dataclass(frozen=True, kw_only=True)
class RecoveringFeedback(LinearFeedback):
    """`LinearFeedback` that comes back from anywhere, crawls, and stops.

    Near the path and from 5 m/s on it is that law, bit for bit, far from the path
    `recovering`. Below 5 m/s it steers over a time and not over a distance: K is scaled
    as if the car were that fast. Where the reference stands, it brakes to standstill
    and holds the steering.
    """

    def __call__(self, errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        """Return u, without any limit of the actuators."""
        turn = self._turn(errors, curvature, speed)
        (ahead, base), (lateral, heading, _) = turn.control, turn.gain[0]
        steering = ahead - lateral * errors.lateral - heading * errors.heading
        linear = jnp.stack([steering, base - self.speed_gain * errors.speed])
        steering, drive = recovering(
            turn, jnp.stack(errors), linear, speed_loop=self.speed_loop
        )
        # From lock to lock and more, but at rest none.
        room = jnp.pi * moving(errors.speed + speed, speed)
        steering = jnp.clip(steering, ahead - room, ahead + room)
        return jnp.stack([steering, drive - holding(errors.speed + speed, speed)])

    def authority(self, errors: PathErrors, speed: Scalar) -> Scalar:
        """Return the share of a perturbation that acts, see `SteadyTurn`."""
        turn = self._turn(errors, jnp.zeros_like(speed), speed)
        return turn.authority(turn.state + jnp.stack(errors))

    def _turn(self, errors: PathErrors, curvature: Scalar, speed: Scalar) -> SteadyTurn:
        """The steady turn, with the gain of this pace."""
        more = often(jnp.maximum(errors.speed + speed, speed))
        # A car that stops does not turn towards its path in its last metre.
        more = jnp.where(speed > 0.0, more, 1.0)
        zero = jnp.zeros_like(speed)
        steering = more**2 * self.lateral_gain, more * self.heading_gain, zero
        gain = jnp.stack([*steering, zero, zero, zero + self.speed_gain])
        return SteadyTurn(
            jnp.stack([zero, zero, speed]),
            jnp.stack(
                [jnp.arctan(self.wheelbase * curvature), speed * self.speed_loop]
            ),
            gain.reshape(2, 3),
            jnp.asarray([self.wheelbase, GRIP]),
        )


path_feedback = RecoveringFeedback
"""(settings of `LinearFeedback`) -> law."""


def no_feedback(*, speed_loop: bool = False) -> FeedbackLaw:
    """Return the law u = 0, or the reference speed: sampling without feedback."""

    def law(errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        del errors, curvature
        zero = jnp.zeros_like(speed)
        return jnp.stack([zero, speed if speed_loop else zero])

    return law
