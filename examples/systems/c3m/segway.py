"""SEGWAY of C3M: a two-wheeled balancing robot, whose battery changes.

    ẍ = (cos φ (9.8 sin φ + 11.5 v) + 68.4 v - 1.2 φ̇² sin φ - b (1.8 cos φ + 10.9) u)
        / (cos φ - 24.7)
    φ̈ = (-(58.8 cos φ + 243.5) v - sin φ (208.3 + φ̇² cos φ) + b (9.3 cos φ + 38.6) u)
        / (cos² φ - 24.7)

The source drives from its starts to rest; here a reference accelerates. e is the
voltage b of the battery, which multiplies the control u, and is 1 there.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric (C3M),
CoRL 2020, and its code, github.com/sundw2014/C3M.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]; 0.03 in the source
STARTS = {"p": (-1.0, 1.0), "v": (-0.5, 0.5)}
STARTS |= {"angle": (-1.047, 1.047), "turn": (-3.142, 3.142)}
"""Errors at the start of the source's runs, whose length is `DURATION` [s]."""
DURATION = 6.0


def rates(state, control, env):
    """Derivatives of the states."""
    _, speed, angle, turn = state
    drive = env[0] * control[0]
    sin = jnp.sin(angle)
    cos = jnp.cos(angle)
    pushed = cos * (9.8 * sin + 11.5 * speed) + 68.4 * speed - 1.2 * turn**2 * sin
    turned = -(58.8 * cos + 243.5) * speed - sin * (208.3 + turn**2 * cos)
    return [
        speed,
        (pushed - (1.8 * cos + 10.9) * drive) / (cos - 24.7),
        turn,
        (turned + (9.3 * cos + 38.6) * drive) / (cos**2 - 24.7),
    ]


def make():
    """Return the system, and what it follows: a position that accelerates."""
    states = {"p [m]": 0.0005, "v [m/s]": 0.005}  # standard deviations of the sensors
    states |= {"angle [rad]": 0.0005, "turn [rad/s]": 0.005}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"drive": (-20.0, 20.0)},
        environment={"battery": (0.8, 1.1)},
        name="segway",
    )
    return system, tracking(
        {"position": ("p",), "angle": ("angle",)},
        reference={("p", "v"): (-0.5, 0.5)},  # [m/s²]
        ranges={"v": (-1.0, 1.0)},  # of the source [m/s]
    )
