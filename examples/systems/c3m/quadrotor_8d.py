"""QUADROTOR_8D of C3M: a quadrotor that is told its attitude rates, whose mass changes.

    v̇_x = g tan θ_x / μ,   v̇_y = g tan θ_y / μ,   v̇_z = (g + a) / μ - g,   θ̇ = ω

Controls are the vertical acceleration a that is asked of the nominal mass, and the
rates ω of both angles. The reference has accelerations up to those of the source's
references. e is the mass μ, relative to the nominal one, and is 1 in the source.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric (C3M),
CoRL 2020, and its code, github.com/sundw2014/C3M.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]; 0.03 in the source
GRAVITY = 9.81  # [m/s²]
STATES = "x", "y", "z", "vx", "vy", "vz", "pitch", "roll"
STARTS = dict.fromkeys(STATES, (-0.5, 0.5))
"""Errors at the start of the source's runs, whose length is `DURATION` [s]."""
DURATION = 6.0
SETTINGS = {"rate": 0.86}
"""Of `certify_system`: the law that it takes itself brings few of these starts back."""


def rates(state, control, env):
    """Derivatives of the states."""
    _, _, _, vx, vy, vz, pitch, roll = state
    lift = GRAVITY / env[0]
    return [
        vx,
        vy,
        vz,
        lift * jnp.tan(pitch),
        lift * jnp.tan(roll),
        (GRAVITY + control[0]) / env[0] - GRAVITY,
        control[1],
        control[2],
    ]


def make():
    """Return the system, and what it follows: a position that accelerates."""
    # Standard deviations of the sensors.
    states = {f"{axis} [m]": 0.0005 for axis in ("x", "y", "z")}
    states |= {f"{speed} [m/s]": 0.005 for speed in ("vx", "vy", "vz")}
    states |= {"pitch [rad]": 0.0005, "roll [rad]": 0.0005}
    turns = {"pitching [rad/s]": (-3.0, 3.0), "rolling [rad/s]": (-3.0, 3.0)}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"lift [m/s²]": (-5.0, 5.0)} | turns,
        environment={"mass": (0.9, 1.2)},
        name="quadrotor_8d",
    )
    reference = {(axis, f"v{axis}"): (-1.0, 1.0) for axis in ("x", "y", "z")}  # [m/s²]
    return system, tracking({"position": ("x", "y", "z")}, reference=reference)
