"""CARTPOLE of C3M: a load that hangs from a cart, whose mass changes.

    p̈ = (F + m sin θ (l θ̇² - g cos θ)) / (M + m sin² θ)
    θ̈ = (F cos θ + m l θ̇² sin θ cos θ - (M + m) g sin θ) / (l (M + m sin² θ))

These are the equations of the source's code, in which the load hangs where θ is 0. Of a
hanging load the terms with θ̇² would have the other sign. The source drives from its
starts to rest; here a reference accelerates. e is the mass m of the load, 1 kg there.

Source: Sun, Jha and Fan, Learning Certified Control Using Contraction Metric (C3M),
CoRL 2020, and its code, github.com/sundw2014/C3M.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]; 0.03 in the source
CART = 1.0  # M [kg]
LENGTH = 1.0  # l [m]
GRAVITY = 9.8  # [m/s²]
STARTS = dict.fromkeys(("p", "v", "angle", "turn"), (-0.3, 0.3))
"""Errors at the start of the source's runs, whose length is `DURATION` [s]."""
DURATION = 10.0


def rates(state, control, env):
    """Derivatives of the states."""
    _, speed, angle, turn = state
    force = control[0]
    load = env[0]
    sin = jnp.sin(angle)
    cos = jnp.cos(angle)
    moved = CART + load * sin**2
    swing = load * LENGTH * turn**2 * sin
    pushed = force + swing - load * GRAVITY * sin * cos
    turned = (force + swing) * cos - (CART + load) * GRAVITY * sin
    return [speed, pushed / moved, turn, turned / (LENGTH * moved)]


def make():
    """Return the system, and what it follows: a cart that accelerates."""
    states = {"p [m]": 0.0005, "v [m/s]": 0.005}  # standard deviations of the sensors
    states |= {"angle [rad]": 0.0005, "turn [rad/s]": 0.005}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"force [N]": (-30.0, 30.0)},
        environment={"load [kg]": (0.7, 1.3)},
        name="cartpole",
    )
    outputs = {"cart": ("p",), "angle": ("angle",)}
    return system, tracking(outputs, reference={("p", "v"): (-0.5, 0.5)})  # [m/s²]
