"""An aircraft in the vertical plane: altitude and speed, with a load and gusts.

    m v̇ = T e_θ + L e_n - D e_a - m g,   J q̇ = M,   α = θ - atan2(v_z - gust, v_x)

e_a is the direction of flight through the air, e_n the one upwards from it, e_θ that of
the body. Lift, drag and pitching moment are linear in α, pitch rate and elevator. A
propeller that turns slowly brakes.

Source: Beard and McLain, Small Unmanned Aircraft, chapter 4, with the coefficients of
the Aerosonde (appendix E).
"""

import jax.numpy as jnp

from sfkd_jax.systems import System, integrated, tracking

DT = 0.05  # sampling period [s]
INERTIA = 1.135  # [kg m²]
AREA, CHORD = 0.55, 0.19  # of the wing [m²], [m]
DENSITY = 1.2682  # of the air [kg/m³]
GRAVITY = 9.81  # [m/s²]


def rates(state, control, env):
    """Derivatives of the states."""
    _, climb, speed, pitch, turn = state
    thrust, elevator = control
    mass, gust = env
    rise = climb - gust
    airspeed = jnp.hypot(speed, rise)
    attack = pitch - jnp.arctan2(rise, speed)
    pressure = 0.5 * DENSITY * airspeed**2 * AREA
    lift = pressure * (0.28 + 3.45 * attack - 0.36 * elevator) / airspeed
    drag = pressure * (0.03 + 0.30 * attack) / airspeed
    damping = -3.6 * CHORD * turn / (2.0 * airspeed)
    moment = -0.02338 - 0.38 * attack + damping - 0.5 * elevator
    upwards = thrust * jnp.sin(pitch) + lift * speed - drag * rise
    forwards = thrust * jnp.cos(pitch) - lift * rise - drag * speed
    angular = pressure * CHORD * moment / INERTIA
    return [climb, upwards / mass - GRAVITY, forwards / mass, turn, angular]


def make():
    """Return the system, and what it follows: an altitude and a speed."""
    # Standard deviations of the sensors.
    states = {"h [m]": 0.01, "climb [m/s]": 0.01, "speed [m/s]": 0.01}
    states |= {"pitch [rad]": 0.0005, "turn [rad/s]": 0.002}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"thrust [N]": (-20.0, 60.0), "elevator [rad]": (-0.5, 0.5)},
        environment={"mass [kg]": (11.0, 13.5), "gust [m/s]": (-1.0, 1.0)},
        name="fixed_wing",
    )
    return system, tracking(
        {"altitude": ("h",), "speed": ("speed",)},
        reference={("h", "climb"): (-0.5, 0.5), ("speed",): (-0.5, 0.5)},  # [m/s²]
        ranges={"climb": (-1.5, 1.5), "speed": (22.0, 28.0)},  # [m/s]
    )
