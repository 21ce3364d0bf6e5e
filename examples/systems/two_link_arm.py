"""A planar arm of two links under gravity, with a load in its hand.

    D(q) q̈ + C(q, q̇) q̇ + g(q) + d q̇ = τ

The links are uniform rods; angles count from the horizontal and from the first link.

Source: Spong, Hutchinson and Vidyasagar, Robot Modeling and Control, section 7.3
(planar elbow manipulator).
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, regulation

DT = 0.02  # sampling period [s]
LENGTH = 0.4  # of each link [m]
UPPER, LOWER = 2.0, 1.5  # masses of the links [kg]
FRICTION = 0.5  # of each joint [N m s]
GRAVITY = 9.81  # [m/s²]


def rates(state, control, env):
    """Derivatives of the states."""
    first, second, turn, bend = state
    load = env[0]
    of_upper = (UPPER / 3.0 + LOWER + load) * LENGTH**2
    of_lower = (LOWER / 3.0 + load) * LENGTH**2
    coupling = (LOWER / 2.0 + load) * LENGTH**2
    mixed = of_lower + coupling * jnp.cos(second)
    whole = of_upper + mixed + coupling * jnp.cos(second)
    spin = coupling * jnp.sin(second)
    weight = (LOWER / 2.0 + load) * LENGTH * GRAVITY * jnp.cos(first + second)
    upper_weight = (UPPER / 2.0 + LOWER + load) * LENGTH * GRAVITY * jnp.cos(first)
    shoulder = control[0] - weight - upper_weight - FRICTION * turn
    shoulder = shoulder + spin * bend * (2.0 * turn + bend)
    elbow = control[1] - weight - FRICTION * bend - spin * turn**2
    determinant = whole * of_lower - mixed**2
    turning = (of_lower * shoulder - mixed * elbow) / determinant
    bending = (whole * elbow - mixed * shoulder) / determinant
    return [turn, bend, turning, bending]


def make():
    """Return the system, and what it follows: angles that move at limited rates."""
    # Standard deviations of the sensors.
    states = {"shoulder [rad]": 0.0002, "elbow [rad]": 0.0002}
    states |= {"turn [rad/s]": 0.002, "bend [rad/s]": 0.002}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"shoulder [N m]": (-60.0, 60.0), "elbow [N m]": (-30.0, 30.0)},
        environment={"load [kg]": (0.0, 2.0)},
        name="two_link_arm",
    )
    set_points = {"shoulder": (-1.0, 1.0), "elbow": (0.3, 1.5)}  # [rad]
    rates_of = {"shoulder": 0.5, "elbow": 0.5}  # [rad/s]
    outputs = {"joints": ("shoulder", "elbow")}
    return system, regulation(outputs, set_points=set_points, rates=rates_of)
