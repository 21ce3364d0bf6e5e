"""Steady turns along a path: the feedback around them, near the path and far from it.

Under a law that is linear in e_y, a car a few metres beside the path would steer at
full lock, its tyres would saturate, and it would circle or spin. The feedback here
saturates the errors instead: far from the path the car approaches it at an angle that
it can drive.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sfkd_jax.driving.path_coordinates import HEADING, LATERAL, PATH_SPEED, PathState
from sfkd_jax.geometry import entrywise, wrap_angle
from sfkd_jax.types import Control, Scalar

NEAR = (0.45, 0.12, 3.0)
"""Box of |e_y| [m], |e_ψ| [rad] and |v − v_ref| [m/s] in which a law is linear. It is
larger than what any model is trained on.
"""
# The constants from here to `BRAKING` were chosen by a random search on noisy closed
# loops of both benchmark cars, with tabled gains and with gains chosen by hand. Lengths
# and times scale with the law and its grip.
ARC = 0.63
"""Share of the grip that the arc of the approach may use."""
CORNERING = 0.89
"""Share of the grip that the steering may use."""
SHARED = 0.65
"""Share of the squared grip that the tightest turn takes away from the drive."""
STEEPEST = 1.13
"""Largest angle of approach [rad]."""
DAMPING = 1.73
"""Gain on the rates of the body, relative to that of the linear law."""
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


class SteadyTurn(NamedTuple):
    """Steady driving along a circle, and the feedback gain around it.

    Attributes:
        state: ξ* = (distance left of the path, yaw relative to it, body state).
        control: u*.
        gain: K.
        grip: d steering / d curvature [rad m], and the lateral acceleration a [m/s²]
            that steering and braking may use far from the path.
    """

    state: Float[Array, "*step coordinate"]
    control: Float[Array, "*step control"]
    gain: Float[Array, "*step control coordinate"]
    grip: Float[Array, "*step 2"]

    def feedback(self, xi: PathState) -> Control:
        """Return the control of the whole plane, without the limits of the actuators.

        u = u* − K (ξ − ξ*)   near the path, elsewhere see `recovering`
        """
        # Errors are relative to ξ* and not to 0, because in side wind the heading of a
        # car on its path differs from that of the path.
        errors = entrywise(jnp.subtract, xi, self.state)
        linear = entrywise(jnp.subtract, self.control, self.gain @ errors)
        return recovering(self, errors, linear)

    def is_linear(self, xi: PathState) -> Bool[Array, ""]:
        """Whether the law is the linear one here, around which models are learned."""
        return course(self, xi - self.state).far <= 0.0

    @property
    def level(self) -> Scalar:
        """The law's steering per heading error.

        It is larger, the less the tyres give, and so are the errors of a model. It
        therefore tells how near a turn is to the limit of grip.
        """
        return jnp.abs(self.gain[0, HEADING])

    def authority(self, xi: PathState) -> Scalar:
        """Return the share of a planner's perturbation that acts, 1 near the path.

        A U-turn takes longer than the horizon of a planner, which would rather park.
        """
        approach = course(self, xi - self.state)
        return 1.0 - approach.far * approach.astray


class Approach(NamedTuple):
    """Where a vehicle is relative to its approach to the path.

    Attributes:
        turned: e_ψ − ψ*, the yaw relative to the angle of approach [rad].
        astray: share that is 1 where the vehicle has much to turn.
        far: share that is 0 in the box `NEAR`, and 1 from twice its size on.
        tightest: curvature that the grip allows [1/m].
    """

    turned: Scalar
    astray: Scalar
    far: Scalar
    tightest: Scalar


def course(turn: SteadyTurn, errors: PathState) -> Approach:
    """Return how far the vehicle is from the angle ψ* of approach, and from its path.

        ψ* = −sign(e_y) min(K_y/K_ψ |e_y|, √(2 |e_y| / R), `STEEPEST`),   R ~ v²/a

    Near the path ψ* is that of the linear law. Farther away the vehicle can turn in on
    an arc of radius R.
    """
    shares = [jnp.abs(errors[entry]) / NEAR[entry] for entry in range(len(NEAR))]
    far = reduce(jnp.maximum, shares) - 1.0
    aside = jnp.abs(errors[LATERAL])
    steering = turn.gain[0]
    # A law that does not steer has no approach.
    slope = steering[LATERAL] / jnp.maximum(steering[HEADING], 1e-6)
    speed = turn.state[PATH_SPEED] + errors[PATH_SPEED]
    tightest = turn.grip[1] / jnp.maximum(jnp.abs(speed), 1.0) ** 2
    # The small number keeps the gradient of the root finite at 0.
    arc = jnp.sqrt(2.0 * ARC * tightest * aside + 1e-9)
    angle = jnp.minimum(jnp.minimum(slope * aside, arc), STEEPEST)
    # The short way round to the approach angle, not to the heading of the path.
    turned = wrap_angle(errors[HEADING] + jnp.sign(errors[LATERAL]) * angle)
    to_turn = jnp.maximum(jnp.abs(turned), jnp.abs(wrap_angle(errors[HEADING])))
    return Approach(
        turned=turned,
        astray=_ramp(to_turn, ASTRAY),
        far=jnp.clip(far, 0.0, 1.0),
        tightest=tightest,
    )


def recovering(
    turn: SteadyTurn, errors: PathState, linear: Control, *, speed_loop: bool = False
) -> Control:
    """Return the control of the whole plane, which is `linear` in the box `NEAR`.

        δ = u*_δ − K_ψ (e_ψ − ψ*) − K_r r,   |δ| ≤ (dδ/dκ) a / v²

    This holds at twice the size of the box and beyond; in between the control is a
    mixture. The vehicle is slower, the more it has to turn, and speeds up once it
    points the right way. Steering and drive share the grip a.

    Args:
        turn: that the law is around.
        errors: ξ − ξ*.
        linear: control of the linear law.
        speed_loop: whether the second control is a speed command.
    """
    turned, astray, far, tightest = course(turn, errors)
    bend, grip = turn.grip
    speed = turn.state[PATH_SPEED]
    gain = turn.gain
    # Feed-forward helps along the path only; the rates of the body damp a slide.
    ahead = turn.control[0] * jnp.maximum(1.0 - jnp.abs(turned), 0.0)
    rates = gain[0, PATH_SPEED + 1 :] @ errors[PATH_SPEED + 1 :]
    steering = ahead - gain[0, HEADING] * turned - DAMPING * rates
    tightest_steering = bend * tightest
    largest = CORNERING * tightest_steering + 0.01
    steering = jnp.clip(steering, -largest, largest)

    # A car that has to turn is slow enough for its tightest turn. Farther away there is
    # room for a wider arc.
    aside = jnp.abs(errors[LATERAL])
    radius = CIRCLE * bend
    slow = jnp.minimum(speed, jnp.sqrt(radius * grip))
    wide = jnp.clip(jnp.sqrt(ARC * grip * aside + 1e-9), slow, speed)
    slower = jnp.maximum(
        astray * (speed - slow), _ramp(aside / radius, DISTANT) * (speed - wide)
    )
    # What cornering uses of the friction circle is missing for the drive.
    used = jnp.clip(jnp.abs(steering) / tightest_steering, 0.0, 1.0)
    left = grip * jnp.sqrt(1.0 - SHARED * used**2)
    correction = jnp.clip(
        gain[1, PATH_SPEED] * (errors[PATH_SPEED] + slower),
        -FASTER * left * (1.0 - astray),
        BRAKING * left,
    )
    drive = turn.control[1] - (slower if speed_loop else 0.0) - correction

    # A choice, not a mixture with weight 0: near the path the law is exactly the linear
    # one, around which models are learned and certified.
    def mixture(beyond: Scalar, linear: Scalar) -> Scalar:
        return jnp.where(far > 0.0, linear + far * (beyond - linear), linear)

    return entrywise(mixture, (steering, drive), linear)


def _ramp(value: Scalar, rise: tuple[float, float]) -> Scalar:
    """Return a ramp from 0 to 1.

    It begins to rise at the first number of `rise`; the second is the length of the
    rise.
    """
    return jnp.clip((value - rise[0]) / rise[1], 0.0, 1.0)
