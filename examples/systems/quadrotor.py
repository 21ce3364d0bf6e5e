"""A planar quadrotor with a payload, in wind.

Two rotors push along the body's axis and turn it. The payload at its middle adds to
mass and inertia; the wind is a horizontal force.

    m v̇_x = -T sin φ + w,   m v̇_z = T cos φ - m g,   J φ̈ = r (u_right - u_left)

Source of the equations: Tedrake, Underactuated Robotics, chapter 3 (planar quadrotor).
Mass, arm and inertia are those of a vehicle of 1 kg and half a metre across.
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]
MASS = 1.0  # without payload [kg]
ARM = 0.25  # from the middle to a rotor [m]
INERTIA = 0.03  # without payload [kg m²]
INERTIA_OF_PAYLOAD = 0.009  # for each kg of it [m²]
GRAVITY = 9.81  # [m/s²]


def rates(state, control, env):
    """Derivatives of the states."""
    _, _, vx, vz, roll, turn = state
    left, right = control
    payload, wind = env
    thrust = left + right
    mass = MASS + payload
    inertia = INERTIA + INERTIA_OF_PAYLOAD * payload
    return [
        vx,
        vz,
        (wind - thrust * jnp.sin(roll)) / mass,
        thrust * jnp.cos(roll) / mass - GRAVITY,
        turn,
        ARM * (right - left) / inertia,
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
        controls={"left [N]": (0.0, 14.0), "right [N]": (0.0, 14.0)},
        environment={"payload [kg]": (0.0, 0.5), "wind [N]": (-2.0, 2.0)},
        name="quadrotor",
    )
    reference = {("x", "vx"): (-1.5, 1.5), ("z", "vz"): (-1.5, 1.5)}  # [m/s²]
    return system, tracking({"position": ("x", "z")}, reference=reference)
