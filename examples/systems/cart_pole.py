"""A pole on a cart, upright, with a tip of unknown mass and a length that changes.

    p̈ = (F + m sin θ (l θ̇² - g cos θ)) / (M + m sin² θ)
    θ̈ = ((M + m) g sin θ - cos θ (F + m l θ̇² sin θ)) / (l (M + m sin² θ))

The angle θ is 0 where the pole is upright, positive where its tip is ahead. The pole
has no mass of its own.

Source: Tedrake, Underactuated Robotics, chapter 3 (cart-pole), with the angle counted
from upright.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.04  # sampling period [s]
CART = 1.0  # mass of the cart [kg]
GRAVITY = 9.81  # [m/s²]


def rates(state, control, env):
    """Derivatives of the states."""
    _, speed, angle, turn = state
    force = control[0]
    tip, length = env
    sin = jnp.sin(angle)
    cos = jnp.cos(angle)
    moved = CART + tip * sin**2
    swing = tip * length * turn**2 * sin
    spin = (CART + tip) * GRAVITY * sin - cos * (force + swing)
    return [
        speed,
        (force + swing - tip * GRAVITY * sin * cos) / moved,
        turn,
        spin / (length * moved),
    ]


def make():
    """Return the system, and what it follows: a cart that accelerates."""
    states = {"p [m]": 0.0005, "v [m/s]": 0.005}  # standard deviations of the sensors
    states |= {"angle [rad]": 0.0005, "turn [rad/s]": 0.005}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"force [N]": (-20.0, 20.0)},
        environment={"tip [kg]": (0.1, 0.4), "length [m]": (0.4, 0.8)},
        name="cart_pole",
    )
    outputs = {"cart": ("p",), "angle": ("angle",)}
    return system, tracking(outputs, reference={("p", "v"): (-0.6, 0.6)})  # [m/s²]
