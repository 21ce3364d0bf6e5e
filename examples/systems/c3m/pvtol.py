"""PVTOL of C3M: a planar aircraft with two rotors, whose mass changes.

    m v̇_x = -T sin φ,   m v̇_z = T cos φ - m g,   J φ̈ = l (u_1 - u_2),   T = u_1 + u_2

The source has the velocities along the axes of the body. Here they are along those of
the world, which is the same motion, so that a reference accelerates evenly. It has
accelerations up to those of the source's references. e is the mass, 0.486 kg there.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric (C3M),
CoRL 2020, and its code, github.com/sundw2014/C3M.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]; 0.03 in the source
ARM = 0.25  # l, from the middle to a rotor [m]
INERTIA = 0.00383  # J [kg m²]
GRAVITY = 9.81  # [m/s²]
STARTS = dict.fromkeys(("x", "z", "vx", "vz", "roll", "turn"), (-0.5, 0.5))
"""Errors at the start of the source's runs, whose length is `DURATION` [s]."""
DURATION = 6.0
SETTINGS = {"rate": 0.8}
"""Of `certify_system`: the law that it takes itself brings few of these starts back."""


def rates(state, control, env):
    """Derivatives of the states."""
    _, _, vx, vz, roll, turn = state
    first, second = control
    specific = (first + second) / env[0]
    return [
        vx,
        vz,
        -specific * jnp.sin(roll),
        specific * jnp.cos(roll) - GRAVITY,
        turn,
        ARM * (first - second) / INERTIA,
    ]


def make():
    """Return the system, and what it follows: a position that accelerates."""
    states = {"x [m]": 0.0005, "z [m]": 0.0005}  # standard deviations of the sensors
    states |= {"vx [m/s]": 0.005, "vz [m/s]": 0.005}
    states |= {"roll [rad]": 0.0005, "turn [rad/s]": 0.005}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"first [N]": (0.0, 6.0), "second [N]": (0.0, 6.0)},
        environment={"mass [kg]": (0.436, 0.586)},
        name="pvtol",
    )
    reference = {("x", "vx"): (-1.0, 1.0), ("z", "vz"): (-0.5, 0.5)}  # [m/s²]
    return system, tracking({"position": ("x", "z")}, reference=reference)
