"""A motor that moves a pendulum through an elastic gear: angle of the pendulum.

    (J_l + m l²) q̈ = k (θ - q) + c (θ̇ - q̇) - (m l + s) g sin q
    J_m θ̈ = τ - b θ̇ - k (θ - q) - c (θ̇ - q̇)

The load m hangs at the end of the pendulum, whose own first moment is s. The stiffness
k of the gear depends on its temperature. All is seen from the side of the pendulum.

Source of the equations: Spong, Hutchinson and Vidyasagar, Robot Modeling and Control,
section 6.5 (flexible joint).
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.02  # sampling period [s]
LENGTH = 0.5  # l, of the pendulum [m]
PENDULUM = 0.05  # J_l, inertia of the pendulum [kg m²]
MOMENT = 0.15  # s, first moment of the pendulum [kg m]
MOTOR = 0.06  # J_m, inertia of the motor [kg m²]
DAMPING = 0.3  # c, of the gear [N m s]
FRICTION = 0.4  # b, of the motor [N m s]
GRAVITY = 9.81  # [m/s²]


def rates(state, control, env):
    """Derivatives of the states."""
    angle, turn, motor, spin = state
    load, stiffness = env
    passed = stiffness * (motor - angle) + DAMPING * (spin - turn)
    weight = (load * LENGTH + MOMENT) * GRAVITY * jnp.sin(angle)
    inertia = PENDULUM + load * LENGTH**2
    return [
        turn,
        (passed - weight) / inertia,
        spin,
        (control[0] - FRICTION * spin - passed) / MOTOR,
    ]


def make():
    """Return the system, and what it follows: an angle that accelerates."""
    # Standard deviations of the sensors.
    states = {"angle [rad]": 0.0002, "turn [rad/s]": 0.002}
    states |= {"motor [rad]": 0.0002, "spin [rad/s]": 0.002}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"torque [N m]": (-20.0, 20.0)},
        environment={"load [kg]": (0.3, 0.6), "stiffness [N m]": (60.0, 90.0)},
        name="pendulum_drive",
    )
    return system, tracking(
        {"angle": ("angle",)},
        reference={("angle", "turn"): (-2.0, 2.0)},  # [rad/s²]
        ranges={"angle": (-1.0, 1.0), "turn": (-1.0, 1.0)},  # [rad], [rad/s]
    )
