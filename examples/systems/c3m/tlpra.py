"""TLPRA of C3M: a planar arm with two links under gravity, with a load in its hand.

    M(q) q̈ + C(q, q̇) + g(q) = τ

The masses are at the ends of the links, and the angles count from the horizontal and
from the first link. The source stands upright at the angles (π/2, 0); here the angles
move around these. e is the load, 0 there.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric (C3M),
CoRL 2020, and its code, github.com/sundw2014/C3M.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, regulation

DT = 0.04  # sampling period [s]; 0.01 in the source
LENGTH = 1.0  # of each link [m]
UPPER, LOWER = 0.8, 2.3  # masses [kg]
GRAVITY = 9.8  # [m/s²]
STARTS = dict.fromkeys(("shoulder", "elbow"), (-0.3, 0.3))
"""Errors at the start of the source's runs, whose length is `DURATION` [s]."""
DURATION = 2.0


def rates(state, control, env):
    """Derivatives of the states."""
    first, second, turn, bend = state
    lower = (LOWER + env[0]) * LENGTH**2
    both = UPPER * LENGTH**2 + lower
    coupling = lower * jnp.cos(second)
    spin = lower * jnp.sin(second)
    weight = lower * GRAVITY / LENGTH
    of_lower = weight * jnp.cos(first + second)
    of_upper = both * GRAVITY / LENGTH * jnp.cos(first)
    shoulder = control[0] + spin * (2.0 * turn + bend) * bend - of_upper - of_lower
    elbow = control[1] - spin * turn**2 - of_lower
    whole = both + lower + 2.0 * coupling
    mixed = lower + coupling
    determinant = whole * lower - mixed**2
    turning = (lower * shoulder - mixed * elbow) / determinant
    return [turn, bend, turning, (whole * elbow - mixed * shoulder) / determinant]


def make():
    """Return the system, and what it follows: angles that move at limited rates."""
    states = {"shoulder [rad]": 0.0002, "elbow [rad]": 0.0002}  # of the sensors
    states |= {"turn [rad/s]": 0.002, "bend [rad/s]": 0.002}
    system = System(
        integrated(rates, dt=DT, substeps=8),
        dt=DT,
        states=states,
        controls={"shoulder [N m]": (-150.0, 150.0), "elbow [N m]": (-80.0, 80.0)},
        environment={"load [kg]": (0.0, 0.8)},
        name="tlpra",
    )
    set_points = {"shoulder": (1.0, 2.1), "elbow": (-0.5, 0.5)}  # [rad]
    rates_of = {"shoulder": 0.5, "elbow": 0.5}  # [rad/s]
    outputs = {"joints": ("shoulder", "elbow")}
    return system, regulation(outputs, set_points=set_points, rates=rates_of)
