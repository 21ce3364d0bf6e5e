"""A pole on a cart swings up and is balanced.

python examples/cartpole.py [figure.png]
"""

import sys

import jax
import jax.numpy as jnp

from sfkd_jax import control

DT, HORIZON, LENGTH, CART, POLE, GRAVITY = 0.05, 30, 0.5, 1.0, 0.2, 9.81


def rates(x, force):
    """Position, angle from upright, and their rates."""
    _, angle, speed, turn = x
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    push = (force + POLE * LENGTH * turn**2 * sin) / (CART + POLE)
    inertia = LENGTH * (4 / 3 - POLE * cos**2 / (CART + POLE))
    spin = (GRAVITY * sin - cos * push) / inertia
    move = push - POLE * LENGTH * spin * cos / (CART + POLE)
    return jnp.stack([speed, turn, move, spin])


def dynamics(params, x, u, env):
    middle = x + 0.5 * DT * rates(x, u[0])
    return x + DT * rates(middle, u[0])


def stage(weights, x, u, before, target):
    place, angle, speed, turn = x
    upright = 10.0 * (1.0 - jnp.cos(angle))
    return upright + place**2 + 0.1 * speed**2 + 0.1 * turn**2 + 1e-3 * u[0] ** 2


def main(samples=512, seconds=5.0, figure=None):
    """Cosine of the angle over the last second, 1 is upright."""
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

    start = (jnp.asarray([0.0, jnp.pi, 0.0, 0.0]), planner.init(jax.random.key(0)))
    run = jax.jit(lambda: jax.lax.scan(step, start, length=round(seconds / DT)))
    _, (states, forces) = run()
    if figure:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots(2, 1, sharex=True, figsize=(7, 4), layout="constrained")
        time = DT * jnp.arange(len(states))
        axes[0].plot(time, states[:, 0], label="cart [m]")
        axes[0].plot(time, jnp.cos(states[:, 1]), label="cosine of the angle")
        axes[1].plot(time, forces, label="force [N]")
        above = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "frameon": False}
        [axis.legend(**above, ncols=2) for axis in axes]
        axes[1].set_xlabel("time [s]")
        plt.savefig(figure, dpi=120, bbox_inches="tight")
    return float(jnp.mean(jnp.cos(states[-round(1.0 / DT) :, 1])))


if __name__ == "__main__":
    print(f"mean cosine of the last second {main(figure=(*sys.argv, None)[1]):.3f}")
