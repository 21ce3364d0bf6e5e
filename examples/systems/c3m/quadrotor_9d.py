"""QUADROTOR_9D of C3M: a quadrotor that is told the rates of its thrust and angles.

    v̇_x = -(T/μ) sin ψ,   v̇_y = (T/μ) cos ψ sin φ,   v̇_z = g - (T/μ) cos ψ cos φ

z points downwards. States are also φ, ψ and the thrust, T - g, whose rates are the
controls. e is the mass μ, relative to the nominal one, and is 1 in the source. The
reference has accelerations up to those of the source's references.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric (C3M),
CoRL 2020, and its code, github.com/sundw2014/C3M.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]; 0.03 in the source
GRAVITY = 9.81  # [m/s²]
STATES = "x", "y", "z", "vx", "vy", "vz", "thrust", "roll", "pitch"
STARTS = dict.fromkeys(STATES, (-0.5, 0.5))
"""Errors at the start of the source's runs, whose length is `DURATION` [s]."""
DURATION = 6.0


def rates(state, control, env):
    """Derivatives of the states."""
    _, _, _, vx, vy, vz, thrust, roll, pitch = state
    specific = (GRAVITY + thrust) / env[0]
    return [
        vx,
        vy,
        vz,
        -specific * jnp.sin(pitch),
        specific * jnp.cos(pitch) * jnp.sin(roll),
        GRAVITY - specific * jnp.cos(pitch) * jnp.cos(roll),
        *control,
    ]


def make():
    """Return the system, and what it follows: a position that accelerates."""
    # Standard deviations of the sensors.
    states = {f"{axis} [m]": 0.0005 for axis in ("x", "y", "z")}
    states |= {f"{speed} [m/s]": 0.005 for speed in ("vx", "vy", "vz")}
    states |= {"thrust [m/s²]": 0.01, "roll [rad]": 0.0005, "pitch [rad]": 0.0005}
    turns = {"rolling [rad/s]": (-3.0, 3.0), "pitching [rad/s]": (-3.0, 3.0)}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"thrusting [m/s³]": (-40.0, 40.0)} | turns,
        environment={"mass": (0.95, 1.05)},
        name="quadrotor_9d",
    )
    reference = {(axis, f"v{axis}"): (-1.0, 1.0) for axis in ("x", "y", "z")}  # [m/s²]
    return system, tracking({"position": ("x", "y", "z")}, reference=reference)
