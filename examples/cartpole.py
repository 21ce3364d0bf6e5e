"""A planner swings up the pole of a cart and balances it.

The dynamics are written by hand and no model is learned. MPPI plans the force on the
cart; the cost asks for an upright pole near the middle. The program prints the mean
cosine of the pole's angle over the last second, which is 1 when it is upright.

    python examples/cartpole.py [figure.png]
"""

import argparse

import jax
import jax.numpy as jnp

from sfkd_jax import control

DT = 0.05  # control period [s]
HORIZON = 30
HALF_LENGTH = 0.5  # of the pole [m]
CART_MASS = 1.0  # [kg]
POLE_MASS = 0.2  # [kg]
GRAVITY = 9.81  # [m/s²]
START = [0.0, jnp.pi, 0.0, 0.0]  # the pole hangs


def rates(x, force):
    """Rates of position, angle from upright, and of their rates."""
    _, angle, speed, turn = x
    sin = jnp.sin(angle)
    cos = jnp.cos(angle)
    mass = CART_MASS + POLE_MASS
    push = (force + POLE_MASS * HALF_LENGTH * turn**2 * sin) / mass
    inertia = HALF_LENGTH * (4 / 3 - POLE_MASS * cos**2 / mass)
    spin = (GRAVITY * sin - cos * push) / inertia
    move = push - POLE_MASS * HALF_LENGTH * spin * cos / mass
    return jnp.stack([speed, turn, move, spin])


def dynamics(params, x, u, env):
    """One step by the midpoint rule."""
    middle = x + 0.5 * DT * rates(x, u[0])
    return x + DT * rates(middle, u[0])


def stage(weights, x, u, before, target):
    """Cost of a step."""
    place, angle, speed, turn = x
    upright = 10.0 * (1.0 - jnp.cos(angle))
    return upright + place**2 + 0.1 * speed**2 + 0.1 * turn**2 + 1e-3 * u[0] ** 2


def draw(path, states, forces):
    """Position, angle and force over time."""
    import matplotlib.pyplot as plt

    _, (motion, force) = plt.subplots(
        2, 1, sharex=True, figsize=(7, 4), layout="constrained"
    )
    time = DT * jnp.arange(len(states))
    motion.plot(time, states[:, 0], label="cart [m]")
    motion.plot(time, jnp.cos(states[:, 1]), label="cosine of the angle")
    force.plot(time, forces, label="force [N]")
    force.set_xlabel("time [s]")
    for axes in (motion, force):
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False, ncols=2)
    plt.savefig(path, dpi=120, bbox_inches="tight")


def main(samples=512, seconds=5.0, figure=None):
    """Return the mean cosine of the angle over the last second."""
    task = control.free_task(dynamics, stage, control_low=-15.0, control_high=15.0)
    planner = control.mppi(
        task,
        num_samples=samples,
        horizon=HORIZON,
        noise_std=(6.0,),
        effective_samples=20.0,
    )

    def step(carry, _):
        x, memory = carry
        u, memory, _ = planner.act({}, memory, x, None, None)
        return (dynamics({}, x, u, None), memory), (x, u)

    start = (jnp.asarray(START), planner.init(jax.random.key(0)))
    run = jax.jit(lambda: jax.lax.scan(step, start, length=round(seconds / DT)))
    _, (states, forces) = run()
    if figure:
        draw(figure, states, forces)
    return float(jnp.mean(jnp.cos(states[-round(1.0 / DT) :, 1])))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", nargs="?", help="file that the figure goes to")
    cosine = main(figure=parser.parse_args().figure)
    print(f"mean cosine of the last second {cosine:.3f}")
