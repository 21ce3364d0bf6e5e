"""Feedback laws on the errors from a path, for any speed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.driving.path_following.laws._steady_turn import SteadyTurn, recovering
from sfkd_jax.geometry import wrap_angle
from sfkd_jax.types import Control, Scalar, State

GRIP = 2.5
"""Lateral acceleration that is assumed of tyres nobody knows [m/s²]: a wet road."""
SLOW_STEERING = 5.0
"""Speed below which errors decay over a time and not over a distance [m/s]."""
CREEP = 0.2
"""Speed below which feedback fades, so that a car at rest does not steer [m/s]."""
HOLDING = 0.5
"""Deceleration, besides that of the speed error, where the reference stands [m/s²]."""


class PathErrors(NamedTuple):
    """Errors of a state relative to one reference point.

    Attributes:
        lateral: distance left of the path [m].
        heading: yaw relative to the path [rad].
        speed: relative to the reference [m/s].
    """

    lateral: Scalar
    heading: Scalar
    speed: Scalar


FeedbackLaw: TypeAlias = Callable[[PathErrors, Scalar, Scalar], Control]
"""(path errors, curvature [1/m], reference speed [m/s]) -> control."""


def moving(actual: Scalar, speed: Scalar) -> Scalar:
    """Return 0 at rest where the reference stands, and 1 from `CREEP` on.

    Args:
        actual: speed of the car [m/s].
        speed: of the reference [m/s].
    """
    return jnp.clip(jnp.maximum(actual, speed) / CREEP, 0.0, 1.0)


def admitted(
    nu: Control, actual: Scalar, speed: Scalar, authority: Scalar | float = 1.0
) -> Control:
    """Return the part of a perturbation that acts; all of it unless the car stops.

    At rest all samples have the same effect, and their mean is noise. Where the
    reference stands, a perturbation may brake but not drive: few models are right at
    walking pace, and a planner with a wrong model would creep for ever.

    Args:
        nu: ν of steering and drive.
        actual: speed of the car [m/s].
        speed: of the reference [m/s].
        authority: share that acts because the vehicle is near its path.
    """
    steering, drive = nu
    steering = steering * moving(actual, speed) * authority
    drive = drive * moving(actual, speed) * authority
    drive = jnp.where(speed == 0.0, jnp.minimum(drive, 0.0), drive)
    return jnp.stack([steering, drive])


def holding(actual: Scalar, speed: Scalar) -> Scalar:
    """Return the deceleration that stops a car and keeps it at rest [m/s²].

    It is 0 unless the reference stands. Below 0.1 m/s it is proportional to the speed,
    so that a vehicle that can reverse does not.

    Args:
        actual: speed of the car [m/s].
        speed: of the reference [m/s].
    """
    brake = HOLDING * jnp.clip(10.0 * actual, -1.0, 1.0)
    return jnp.where(speed == 0.0, brake, 0.0)


def often(pace: Scalar) -> Scalar:
    """Return how much more a law steers per distance at low speed; 1 from 5 m/s on.

    Below 5 m/s errors decay over a time, as they do at 5 m/s. Otherwise a car at
    0.3 m/s would take 30 s for the 9 m over which a linear law comes back.

    Args:
        pace: speed of the car, or of the reference if that is higher [m/s].
    """
    # 1.4/v − 0.4 instead of 1/v, because a slower car is at full lock more often.
    return jnp.maximum(1.4 * SLOW_STEERING / jnp.maximum(pace, CREEP) - 0.4, 1.0)


def path_errors(
    state: State, point: Float[Array, " 4"], curvature: Scalar
) -> PathErrors:
    """Return the errors relative to the circle that touches the path at `point`.

    They are exact to second order in the distance along the circle, and cheaper than
    those of `path_coordinates.circle_errors`. A planner needs them thousands of times a
    step.

    Args:
        state: p_x, p_y, yaw, v, ….
        point: x, y, yaw, speed of the reference.
        curvature: of the path at `point` [1/m].
    """
    dx = state[0] - point[0]
    dy = state[1] - point[1]
    c = jnp.cos(point[2])
    s = jnp.sin(point[2])
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
        drive = -self.speed_gain * errors.speed
        if self.speed_loop:
            drive = drive + speed
        return jnp.stack([steering, drive])


@dataclass(frozen=True, kw_only=True)
class RecoveringFeedback(LinearFeedback):
    """`LinearFeedback` that comes back from anywhere, drives slowly, and stops.

    Near the path and from 5 m/s on it is that law; far from the path it is
    `recovering`. Below 5 m/s its gain is scaled such that errors decay over a time and
    not over a distance, see `often`. Where the reference stands, it brakes to
    standstill and holds the steering.
    """

    def __call__(self, errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        """Return u, without any limit of the actuators."""
        turn = self._turn(errors, curvature, speed)
        ahead, base = turn.control
        lateral, heading, _ = turn.gain[0]
        steering = ahead - lateral * errors.lateral - heading * errors.heading
        linear = jnp.stack([steering, base - self.speed_gain * errors.speed])
        steering, drive = recovering(
            turn, jnp.stack(errors), linear, speed_loop=self.speed_loop
        )
        # Feedback on the steering ranges from lock to lock and more, but is 0 at rest.
        actual = errors.speed + speed
        room = jnp.pi * moving(actual, speed)
        steering = jnp.clip(steering, ahead - room, ahead + room)
        return jnp.stack([steering, drive - holding(actual, speed)])

    def authority(self, errors: PathErrors, speed: Scalar) -> Scalar:
        """Return the share of a perturbation that acts, see `SteadyTurn`."""
        turn = self._turn(errors, jnp.zeros_like(speed), speed)
        return turn.authority(turn.state + jnp.stack(errors))

    def _turn(self, errors: PathErrors, curvature: Scalar, speed: Scalar) -> SteadyTurn:
        """Return the steady turn, with the gain of this pace."""
        factor = often(jnp.maximum(errors.speed + speed, speed))
        # A car that stops does not turn towards its path in its last metre.
        factor = jnp.where(speed > 0.0, factor, 1.0)
        lateral_gain = factor**2 * self.lateral_gain
        heading_gain = factor * self.heading_gain
        zero = jnp.zeros_like(speed)
        gain = jnp.stack(
            [lateral_gain, heading_gain, zero, zero, zero, zero + self.speed_gain]
        )
        steering = jnp.arctan(self.wheelbase * curvature)
        return SteadyTurn(
            state=jnp.stack([zero, zero, speed]),
            control=jnp.stack([steering, speed * self.speed_loop]),
            gain=gain.reshape(2, 3),
            grip=jnp.asarray([self.wheelbase, GRIP]),
        )


path_feedback = RecoveringFeedback
"""(settings of `LinearFeedback`) -> law."""


def no_feedback(*, speed_loop: bool = False) -> FeedbackLaw:
    """Return the law u = 0, or the reference speed, for sampling without feedback."""

    def law(errors: PathErrors, curvature: Scalar, speed: Scalar) -> Control:
        del errors, curvature
        zero = jnp.zeros_like(speed)
        return jnp.stack([zero, speed if speed_loop else zero])

    return law
