"""The pendulum of gymnasium near its upper position, whose mass and length change.

    d²angle/dt² = 3 g / (2 l) sin angle + 3 / (m l²) torque

The equation is not used: gymnasium simulates, on the host, and jax traces nothing. Its
motor has not the torque to swing the pendulum up at once, nor to hold it far from 0.

Source of the simulator: gymnasium's Pendulum-v1.
"""

import gymnasium

from sfkd_jax.systems import System, simulated, tracking

PENDULUM = gymnasium.make("Pendulum-v1").unwrapped
PENDULUM.reset(seed=0)


def simulate(state, control, env):
    """Return the state one sampling period later, as gymnasium computes it."""
    PENDULUM.m, PENDULUM.l = env
    PENDULUM.state = state
    PENDULUM.step(control)
    return PENDULUM.state


def make():
    """Return the system, and what it follows: an angle that accelerates."""
    system = System(
        simulated(simulate, states=2),
        dt=PENDULUM.dt,
        states={"angle [rad]": 0.001, "turn [rad/s]": 0.005},
        controls={"torque [N m]": (-2.0, 2.0)},
        environment={"mass [kg]": (0.8, 1.2), "length [m]": (0.9, 1.1)},
        name="gymnasium_pendulum",
    )
    return system, tracking(
        {"angle": ("angle",)},
        reference={("angle", "turn"): (-0.5, 0.5)},  # [rad/s²]
        ranges={"angle": (-0.15, 0.15), "turn": (-0.3, 0.3)},  # [rad], [rad/s]
    )
