"""64 vehicles plan at once, each around the same pillars.

python examples/fleet.py [figure.png]
"""

import sys

import jax
import jax.numpy as jnp

from sfkd_jax import control

DT, HORIZON, WIDE = 0.2, 20, 0.3


def dynamics(params, x, u, env):
    """Unicycle: x, y, yaw; speed [m/s] and yaw rate [rad/s]."""
    return x + DT * jnp.stack([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]])


def stage(weights, x, u, before, goal):
    return jnp.sum((x[:2] - goal) ** 2) + 0.1 * u[1] ** 2


def clear_of_the_pillars(pillars, x, u, goal, at):
    return control.outside_circles(x[:2], pillars, WIDE)


def main(count=64, samples=256, seconds=16.0, figure=None):
    """Largest distance to a goal at the end; smallest gap to a pillar [m]."""
    rows = [(-3.5, -4.5), (-3.5, 0.0), (-3.5, 4.5), (0.0, -2.2), (0.0, 2.2)]
    rows += [(3.5, -4.5), (3.5, 0.0), (3.5, 4.5)]
    pillars = jnp.asarray([(x, y, 0.8) for x, y in rows])
    limits = {"control_low": (0.0, -1.5), "control_high": (1.5, 1.5)}
    task = control.free_task(dynamics, stage, **limits)
    planner = control.mppi(
        control.constrained(task, clear_of_the_pillars, pillars),
        num_samples=samples,
        horizon=HORIZON,
        noise_std=(0.5, 0.8),
        effective_samples=20.0,
    )
    along = jnp.linspace(-6.0, 6.0, count)
    edge = jnp.full(count, 7.0)
    goals = jnp.stack([edge, -along], axis=1)

    def act(goal, x, memory):
        targets = jnp.broadcast_to(goal, (HORIZON, 2))
        u, memory, _ = planner.act({}, memory, x, None, targets)
        return dynamics({}, x, u, None), memory

    def step(carry, _):
        carry = jax.vmap(act)(goals, *carry)
        return carry, carry[0]

    start = jnp.stack([-edge, along, jnp.zeros(count)], axis=1)
    memory = jax.vmap(planner.init)(jax.random.split(jax.random.key(0), count))
    steps = round(seconds / DT)
    run = jax.jit(lambda: jax.lax.scan(step, (start, memory), length=steps)[1])
    states = run()
    away = states[:, :, None, :2] - pillars[:, :2]
    gap = jnp.min(jnp.linalg.norm(away, axis=-1) - pillars[:, 2]) - WIDE
    if figure:
        import matplotlib.pyplot as plt

        _, axis = plt.subplots(figsize=(5, 5))
        [axis.add_patch(plt.Circle((x, y), r, color="0.6")) for x, y, r in pillars]
        axis.plot(states[..., 0], states[..., 1], linewidth=0.7)
        axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        plt.savefig(figure, dpi=120, bbox_inches="tight")
    left = jnp.linalg.norm(states[-1, :, :2] - goals, axis=1)
    return float(jnp.max(left)), float(gap)


if __name__ == "__main__":
    left, gap = main(figure=(*sys.argv, None)[1])
    print(f"the last one {left:.2f} m from its goal, never closer than {gap:.2f} m")
