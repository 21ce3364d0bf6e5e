"""The inverted pendulum of brax: position of the cart, where gravity and motor change.

The states are those of the generalized physics of brax. The factors of e scale the
gravity of the Earth and the force of the motor, which has 100 N per unit of control.

Source of the simulator: brax's environment "inverted_pendulum".
"""

from brax import envs

from sfkd_jax.adapters import brax_system
from sfkd_jax.systems import tracking


def make():
    """Return the system, and what it follows: a cart that accelerates."""
    # Standard deviations of the sensors.
    states = {"cart [m]": 0.0005, "pole [rad]": 0.0005}
    states |= {"speed [m/s]": 0.002, "fall [rad/s]": 0.002}
    system = brax_system(
        envs.get_environment("inverted_pendulum", backend="generalized"),
        states=states,
        controls=("force [100 N]",),
        environment={"gravity": (0.7, 1.3), "motor": (0.8, 1.2)},
    )
    return system, tracking(
        {"cart": ("cart",)},
        reference={("cart", "speed"): (-0.5, 0.5)},  # [m/s²]
        # [m], [m/s]: the rail ends at 1 m, and the cart has friction.
        ranges={"cart": (-0.5, 0.5), "speed": (-0.7, 0.7)},
    )
