"""CAR of C3M: a car in the plane, told its turn rate and its acceleration.

    ṗ = v (cos θ, sin θ),   θ̇ = e ω,   v̇ = a

The tyres give a share e of the turn rate, 1 in the source. As in the source the speed
of the reference is between 1 and 2 m/s. Its turn rate is held for some time here, and
a sum of sines there, mostly below 1.5 rad/s too.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric (C3M),
CoRL 2020, and its code, github.com/sundw2014/C3M.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]; 0.03 in the source
STARTS = dict.fromkeys(("x", "y", "heading", "speed"), (-1.0, 1.0))
"""Errors at the start of the source's runs, whose length is `DURATION` [s]."""
DURATION = 6.0


def rates(state, control, env):
    """Derivatives of the states."""
    _, _, heading, speed = state
    turn, push = control
    return [speed * jnp.cos(heading), speed * jnp.sin(heading), env[0] * turn, push]


def make():
    """Return the system, and what it follows: a position that moves where it points."""
    states = {"x [m]": 0.002, "y [m]": 0.002}  # standard deviations of the sensors
    states |= {"heading [rad]": 0.001, "speed [m/s]": 0.005}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"turn [rad/s]": (-5.0, 5.0), "push [m/s²]": (-5.0, 5.0)},
        environment={"grip": (0.8, 1.2)},
        name="car",
    )
    return system, tracking(
        {"position": ("x", "y")},
        reference={("heading",): (-1.5, 1.5), ("speed",): (-0.5, 0.5)},
        ranges={"speed": (1.0, 2.0)},  # [m/s]
        course=("x", "y", "heading", "speed"),
    )
