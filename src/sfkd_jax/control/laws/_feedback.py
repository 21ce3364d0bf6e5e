"""Feedback laws on the errors from a path, and what any law does far from it.

A law that is linear in e_y asks for full lock a few metres beside the path, the tyres
saturate, and the car circles or spins. Its errors are saturated instead: it approaches
the path at an angle that it can drive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Float

from sfkd_jax.geometry import (
    HEADING,
    LATERAL,
    PATH_SPEED,
    PathState,
    entrywise,
    wrap_angle,
)
from sfkd_jax.types import Control, Scalar, State

NEAR = (0.45, 0.12, 3.0)
"""Box of |e_y| [m], |e_ψ| [rad] and |v − v_ref| [m/s] in which a law is linear: more
than any model sees.
"""
GRIP = 2.5
"""Lateral acceleration of a law that does not know its own [m/s²]: a wet road."""
# The constants from here to `BRAKING` were chosen by a random search on noisy closed
# loops of both benchmark cars, with tabled gains and with gains chosen by hand. Lengths
# and times scale with the law and its grip.
ARC = 0.63
"""Share of the grip that the arc of the approach may use."""
CORNERING = 0.89
"""Share of the grip that the steering may use."""
SHARED = 0.65
"""Share of the friction circle that is counted as used in the tightest turn."""
STEEPEST = 1.13
"""Largest angle of approach [rad]."""
DAMPING = 1.73
"""Of the rates of the body, relative to the linear law."""
CIRCLE = 2.58
"""Radius of the tightest turn, relative to d steering / d curvature."""
ASTRAY = (0.31, 1.12)
"""Angle from the approach at which the vehicle begins to slow down, and the further
angle over which it reaches its lowest speed [rad].
"""
DISTANT = (0.17, 2.1)
"""The same two numbers for |e_y|, in radii of the tightest turn."""
FASTER = 0.45
"""Largest drive that feedback requests, relative to the grip."""
BRAKING = 2.8
"""Largest braking that feedback requests, relative to the grip."""
SLOW_STEERING = 5.0
"""Below this speed a law steers over a time and not over a distance [m/s]."""
CREEP = 0.2
"""Below this speed feedback fades, so that a car at rest does not steer [m/s]."""
HOLDING = 0.5
"""Deceleration beside that of the speed error, where the reference stands [m/s²]."""


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


class SteadyTurn(NamedTuple):
    """Steady driving along a circle, and the feedback gain around it."""

    # Path coordinates ξ* = (distance left of the path, yaw relative to it, body state).
    state: Float[Array, "*step coordinate"]
    control: Float[Array, "*step control"]  # u*
    gain: Float[Array, "*step control coordinate"]  # K
    # d steering / d curvature [rad m] and the lateral acceleration a [m/s²] that
    # steering and braking may use far from the path.
    grip: Float[Array, "*step 2"]

    def feedback(self, coordinates: PathState) -> Control:
        """Return the control of the whole plane, without the limits of the actuators.

        u = u* − K (ξ − ξ*)   near the path, elsewhere see `recovering`
        """
        # Relative to ξ*, not to 0: in side wind a car on its path has a heading error.
        errors = entrywise(jnp.subtract, coordinates, self.state)
        linear = entrywise(jnp.subtract, self.control, self.gain @ errors)
        return recovering(self, errors, linear)

    @property
    def level(self) -> Scalar:
        """The law's steering per heading error: the less the tyres give, the larger.

        So are the errors of a model: it tells how near a turn is to the limit of grip.
        """
        return jnp.abs(self.gain[0, HEADING])

    def authority(self, coordinates: PathState) -> Scalar:
        """Return the share of a planner's perturbation that acts, 1 near the path.

        A U-turn takes longer than a horizon: a planner would rather park.
        """
        _, astray, far, _ = course(self, coordinates - self.state)
        return 1.0 - far * astray


def course(turn: SteadyTurn, errors: PathState) -> tuple[Scalar, ...]:
    """Return how far the vehicle is from the angle ψ* of approach, and from its path.

        ψ* = −sign(e_y) min(K_y/K_ψ |e_y|, √(2 |e_y| / R), `STEEPEST`),   R ~ v²/a

    Near the path ψ* is that of the linear law; farther away the vehicle can turn in on
    an arc of radius R. Returned are e_ψ − ψ* [rad], a share that is 1 where there is
    much to turn, one that is 0 in the box `NEAR` and 1 from twice its size on, and the
    curvature that the grip allows [1/m].
    """
    shares = [jnp.abs(errors[entry]) / NEAR[entry] for entry in range(len(NEAR))]
    far = reduce(jnp.maximum, shares) - 1.0
    aside = jnp.abs(errors[LATERAL])
    steering = turn.gain[0]
    # A law that does not steer has no approach.
    slope = steering[LATERAL] / jnp.maximum(steering[HEADING], 1e-6)
    speed = turn.state[PATH_SPEED] + errors[PATH_SPEED]
    tightest = turn.grip[1] / jnp.maximum(jnp.abs(speed), 1.0) ** 2
    # Not the root of 0, which has no gradient.
    arc = jnp.sqrt(2.0 * ARC * tightest * aside + 1e-9)
    angle = jnp.minimum(jnp.minimum(slope * aside, arc), STEEPEST)
    # The short way round to the approach angle, not to the heading of the path.
    turned = wrap_angle(errors[HEADING] + jnp.sign(errors[LATERAL]) * angle)
    off = jnp.maximum(jnp.abs(turned), jnp.abs(wrap_angle(errors[HEADING])))
    return turned, _ramp(off, ASTRAY), jnp.clip(far, 0.0, 1.0), tightest


def recovering(
    turn: SteadyTurn, errors: PathState, linear: Control, *, speed_loop: bool = False
) -> Control:
    """Return the control of the whole plane, which is `linear` in the box `NEAR`.

        δ = u*_δ − K_ψ (e_ψ − ψ*) − K_r r,   |δ| ≤ (dδ/dκ) a / v²

    That is at twice that distance and beyond; in between it is a mixture. The vehicle
    is slower, the more it has to turn, and speeds up once it points the right way;
    steering and drive share the grip a.
    """
    turned, astray, far, tightest = course(turn, errors)
    bend, grip = turn.grip
    speed = turn.state[PATH_SPEED]
    gain = turn.gain
    # Feed-forward helps along the path only; the rates of the body damp a slide.
    ahead = turn.control[0] * jnp.maximum(1.0 - jnp.abs(turned), 0.0)
    rates = gain[0, PATH_SPEED + 1 :] @ errors[PATH_SPEED + 1 :]
    wanted = ahead - gain[0, HEADING] * turned - DAMPING * rates
    held = bend * tightest
    most = CORNERING * held + 0.01
    wanted = jnp.clip(wanted, -most, most)

    aside = jnp.abs(errors[LATERAL])
    radius = CIRCLE * bend
    slow = jnp.minimum(speed, jnp.sqrt(radius * grip))
    # Farther away there is room for a wider arc.
    wide = jnp.clip(jnp.sqrt(ARC * grip * aside + 1e-9), slow, speed)
    lower = jnp.maximum(
        astray * (speed - slow), _ramp(aside / radius, DISTANT) * (speed - wide)
    )
    # What cornering uses of the friction circle is missing for the drive.
    used = jnp.clip(jnp.abs(wanted) / held, 0.0, 1.0)
    left = grip * jnp.sqrt(1.0 - SHARED * used**2)
    drive = jnp.clip(
        gain[1, PATH_SPEED] * (errors[PATH_SPEED] + lower),
        -FASTER * left * (1.0 - astray),
        BRAKING * left,
    )
    base = turn.control[1] - (lower if speed_loop else 0.0)

    # A choice, not a mixture with weight 0: near the path the law is exactly the linear
    # one, around which models are learned and certified.
    def mixture(beyond: Scalar, linear: Scalar) -> Scalar:
        return jnp.where(far > 0.0, linear + far * (beyond - linear), linear)

    return entrywise(mixture, (wanted, base - drive), linear)


def _ramp(value: Scalar, rise: tuple[float, float]) -> Scalar:
    """0 below the first number of `rise`, 1 as far beyond as the second says."""
    return jnp.clip((value - rise[0]) / rise[1], 0.0, 1.0)


def moving(actual: Scalar, speed: Scalar) -> Scalar:
    """Return 0 at rest where the reference stands, and 1 from `CREEP` on."""
    return jnp.clip(jnp.maximum(actual, speed) / CREEP, 0.0, 1.0)


def admitted(
    nu: Control, actual: Scalar, speed: Scalar, authority: Scalar | float = 1.0
) -> Control:
    """Return what acts of a perturbation of a law, all of it unless the car stops.

    At rest samples do not differ in what they do, and their mean is noise. Where the
    reference stands, a perturbation may brake but not drive: few models are right at
    walking pace, and a planner with a wrong one creeps for ever.
    """
    steering, drive = (one * moving(actual, speed) * authority for one in nu)
    drive = jnp.where(speed == 0.0, jnp.minimum(drive, 0.0), drive)
    return jnp.stack([steering, drive])


def holding(actual: Scalar, speed: Scalar) -> Scalar:
    """Return what brakes a car to standstill, and keeps it there [m/s²].

    0 unless the reference stands. Proportional up to 0.1 m/s: a vehicle that can
    reverse does not.
    """
    brake = HOLDING * jnp.clip(10.0 * actual, -1.0, 1.0)
    return jnp.where(speed == 0.0, brake, 0.0)


def often(pace: Scalar) -> Scalar:
    """Return how much more a law steers per distance at low speed; 1 from 5 m/s on.

    Below, errors decay over a time, as at 5 m/s: at 0.3 m/s a car takes 30 s for the
    9 m over which a linear law comes back. `pace` is the speed of the car, or of the
    reference if that is higher [m/s].
    """
    # 1.4/v − 0.4 instead of 1/v: the slower the car, the more it is at full lock.
    return jnp.maximum(1.4 * SLOW_STEERING / jnp.maximum(pace, CREEP) - 0.4, 1.0)


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
        correction = -self.speed_gain * errors.speed
        return jnp.stack(
            [steering, correction + speed if self.speed_loop else correction]
        )


@dataclass(frozen=True, kw_only=True)
class RecoveringFeedback(LinearFeedback):
    """`LinearFeedback` that comes back from anywhere, crawls, and stops.

    Near the path and from 5 m/s on it is that law, far from the path
    `recovering`. Below 5 m/s it steers over a time and not over a distance: K is scaled
    as if the car were that fast. Where the reference stands, it brakes to standstill
    and holds the steering.
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
