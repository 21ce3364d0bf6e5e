"""What a linear law does far from its path: approach it at an angle that it can drive.

A law that is linear in e_y asks for full lock a few metres beside the path, the tyres
saturate, and the car circles or spins. Its errors are saturated instead.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from sfkd_jax.types import Control, Scalar

LATERAL_ACCELERATION = 3.0
"""That feedback may ask for far from the path [m/s²]: the grip of a wet road."""
PLANNED = 0.4
"""Share of it in the arc on which the path is approached: the tyres understeer."""
BRAKING = 3.0
"""Largest deceleration towards the speed of the recovery [m/s²]."""
STEEPEST_APPROACH = 1.2
"""Largest angle at which the path is approached [rad]."""
MISALIGNED = 0.3
"""Up to this angle from the approach steering and speed are not limited; from twice as
much on they are, with a linear transition [rad].
"""
SLOW = 3.5
"""Speed of a car that has to turn [m/s]: a U-turn and the way back take least time."""
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


class Recovery(NamedTuple):
    """What a linear law is given in place of errors and speed.

    Attributes:
        errors: saturated; near the path bit for bit the true ones.
        speed: in place of the reference [m/s].
        curvature: limit of what feedback may add to the path's [1/m].
        authority: share of a planner's perturbation that acts, 1 near the path. A
            U-turn leads away from the path for longer than a horizon: a planner would
            rather park.
    """

    errors: PathErrors
    speed: Scalar
    curvature: Scalar
    authority: Scalar


def recovery(
    errors: PathErrors,
    speed: Scalar,
    *,
    slope: Scalar | float,
    tightest: Scalar | float,
) -> Recovery:
    """Return the errors with which a linear law returns to the path from anywhere.

        ψ_approach = min(k_y/k_ψ |e_y|, √(2 κ |e_y|), 1.2),   κ = min(0.4 a/v², κ_max)

    Args:
        errors: of the state.
        speed: of the reference [m/s].
        slope: k_y/k_ψ, the angle at which the law approaches, per distance [1/m].
        tightest: κ_max, curvature at full lock [1/m].
    """
    actual = errors.speed + speed
    grip = LATERAL_ACCELERATION / (actual**2 + 1e-6)
    curvature = jnp.minimum(tightest, grip)
    aside = jnp.abs(errors.lateral)
    # The arc of curvature κ that ends on the path begins at √(2 κ e_y). A limit of
    # e_y and not of the angle: near the path nothing is rounded.
    planned = jnp.minimum(tightest, PLANNED * grip)
    # Not the root of 0, which has no gradient.
    arc = jnp.sqrt(2.0 * planned * aside + 1e-6)
    widest = jnp.minimum(arc, STEEPEST_APPROACH) / slope
    lateral = jnp.clip(errors.lateral, -widest, widest)
    # The short way round to the approach angle, not to the heading of the path.
    off = errors.heading + slope * lateral
    turned = 2.0 * jnp.pi * jnp.round(off / (2.0 * jnp.pi))
    heading = errors.heading - turned
    away = jnp.clip(jnp.abs(off - turned) / MISALIGNED - 1.0, 0.0, 1.0)
    target = speed + away * (jnp.minimum(speed, SLOW) - speed)
    brake = jnp.clip(actual - target, -BRAKING, BRAKING)
    fast = errors.speed + away * (brake - errors.speed)
    # From lock to lock and more, so that near the path nothing is limited.
    free = curvature + 3.0 * (1.0 - away) * tightest
    return Recovery(PathErrors(lateral, heading, fast), target, free, 1.0 - away)


def moving(actual: Scalar, speed: Scalar) -> Scalar:
    """Return 0 at rest where the reference stands, and 1 from `CREEP` on."""
    return jnp.clip(jnp.maximum(actual, speed) / CREEP, 0.0, 1.0)


def admitted(nu: Control, actual: Scalar, speed: Scalar) -> Control:
    """Return what acts of a perturbation of a law, all of it unless the car stops.

    At rest samples do not differ in what they do, and their mean is noise. Where the
    reference stands, a perturbation may brake but not drive: few models are right at
    walking pace, and a planner with a wrong one creeps for ever.
    """
    nu = nu * moving(actual, speed)
    return jnp.where(speed == 0.0, nu.at[1].min(0.0), nu)


def holding(errors: PathErrors, speed: Scalar) -> Scalar:
    """Return what brakes a car to standstill, and keeps it there [m/s²].

    0 unless the reference stands. Proportional up to 0.1 m/s: a vehicle that can
    reverse does not.
    """
    brake = HOLDING * jnp.clip(10.0 * (errors.speed + speed), -1.0, 1.0)
    return jnp.where(speed == 0.0, brake, 0.0)


def often(pace: Scalar) -> Scalar:
    """Return how much more a law steers per distance at low speed; 1 from 5 m/s on.

    Below, errors decay over a time, as at 5 m/s: at 0.3 m/s a car takes 30 s for the
    9 m over which a linear law comes back. `pace` is the speed of the car, or of the
    reference if that is higher [m/s].
    """
    # 1.4/v − 0.4 instead of 1/v: the slower the car, the more it is at full lock.
    return jnp.maximum(1.4 * SLOW_STEERING / jnp.maximum(pace, CREEP) - 0.4, 1.0)
