"""A DC motor that follows speeds, with a load torque and an inertia that change.

    J ω̇ = K i - b ω - τ,   L i̇ = u - R i - K ω

Source of the equations: Franklin, Powell and Emami-Naeini, Feedback Control of Dynamic
Systems, section 2.3. The constants are of the size of a servo motor of 200 W at 24 V.
"""

from sfkd_jax.systems import System, integrated, regulation

DT = 0.01  # sampling period [s]
TORQUE = 0.05  # K, of a current [N m/A] and voltage of a speed [V s]
FRICTION = 1e-4  # b [N m s]
RESISTANCE = 1.0  # R [Ohm]
INDUCTANCE = 0.01  # L [H]


def rates(state, control, env):
    """Derivatives of the states."""
    speed, current = state
    voltage = control[0]
    load, inertia = env
    torque = TORQUE * current - FRICTION * speed - load
    return [
        torque / (1e-3 * inertia),
        (voltage - RESISTANCE * current - TORQUE * speed) / INDUCTANCE,
    ]


def make():
    """Return the system, and what it follows: a speed that changes at limited rates."""
    # Standard deviations of the sensors.
    states = {"speed [rad/s]": 0.05, "current [A]": 0.02}
    system = System(
        integrated(rates, dt=DT, substeps=2),
        dt=DT,
        states=states,
        controls={"voltage [V]": (-24.0, 24.0)},
        environment={"load [N m]": (-0.2, 0.2), "inertia [g m²]": (0.5, 1.0)},
        name="motor",
    )
    return system, regulation(
        {"speed": ("speed",)},
        set_points={"speed": (-150.0, 150.0)},  # [rad/s]
        rates={"speed": 150.0},  # [rad/s²]
    )
