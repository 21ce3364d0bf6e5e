"""64 vehicles plan at once, each of them around the same pillars.

One planner is mapped over the vehicles by `jax.vmap`. The vehicles do not see each
other. The program prints how far the last one ends from its goal and how near any of
them came to a pillar.

    python examples/fleet.py [figure.png]
"""

import argparse

import jax
import jax.numpy as jnp

from sfkd_jax import control

DT = 0.2  # control period [s]
HORIZON = 20
VEHICLE_RADIUS = 0.3  # [m]
PILLAR_RADIUS = 0.8  # [m]
CENTRES = [
    (-3.5, -4.5),
    (-3.5, 0.0),
    (-3.5, 4.5),
    (0.0, -2.2),
    (0.0, 2.2),
    (3.5, -4.5),
    (3.5, 0.0),
    (3.5, 4.5),
]
PILLARS = jnp.asarray([(x, y, PILLAR_RADIUS) for x, y in CENTRES])
"""x, y, radius [m]."""


def dynamics(params, x, u, env):
    """Unicycle: x, y, yaw; speed [m/s] and yaw rate [rad/s]."""
    return x + DT * jnp.stack([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]])


def stage(weights, x, u, before, goal):
    """Cost of a step."""
    return jnp.sum((x[:2] - goal) ** 2) + 0.1 * u[1] ** 2


def clear_of_the_pillars(pillars, x, u, goal, at):
    """Depth of the vehicle in each pillar [m]; a plan must keep it below 0."""
    return control.outside_circles(x[:2], pillars, VEHICLE_RADIUS)


def draw(path, states):
    """The paths of all vehicles."""
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(figsize=(5, 5))
    for x, y, radius in PILLARS:
        axes.add_patch(plt.Circle((x, y), radius, color="0.6"))
    axes.plot(states[..., 0], states[..., 1], linewidth=0.7)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    plt.savefig(path, dpi=120, bbox_inches="tight")


def main(count=64, samples=256, seconds=16.0, figure=None):
    """Return the largest distance to a goal at the end and the smallest gap [m]."""
    task = control.free_task(
        dynamics, stage, control_low=(0.0, -1.5), control_high=(1.5, 1.5)
    )
    planner = control.mppi(
        control.constrained(task, clear_of_the_pillars, PILLARS),
        num_samples=samples,
        horizon=HORIZON,
        noise_std=(0.5, 0.8),
        effective_samples=20.0,
    )
    # They start in a row on the left; their order on the right is reversed.
    along = jnp.linspace(-6.0, 6.0, count)
    edge = jnp.full(count, 7.0)
    start = jnp.stack([-edge, along, jnp.zeros(count)], axis=1)
    goals = jnp.stack([edge, -along], axis=1)

    def move(goal, x, memory):
        targets = jnp.broadcast_to(goal, (HORIZON, 2))
        u, memory, _ = planner.act({}, memory, x, None, targets)
        return dynamics({}, x, u, None), memory

    def step(carry, _):
        carry = jax.vmap(move)(goals, *carry)
        return carry, carry[0]

    memory = jax.vmap(planner.init)(jax.random.split(jax.random.key(0), count))
    steps = round(seconds / DT)
    run = jax.jit(lambda: jax.lax.scan(step, (start, memory), length=steps)[1])
    states = run()
    if figure:
        draw(figure, states)
    from_centres = states[:, :, None, :2] - PILLARS[:, :2]
    gaps = jnp.linalg.norm(from_centres, axis=-1) - PILLARS[:, 2]
    left = jnp.linalg.norm(states[-1, :, :2] - goals, axis=1)
    return float(jnp.max(left)), float(jnp.min(gaps) - VEHICLE_RADIUS)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", nargs="?", help="file that the figure goes to")
    left, gap = main(figure=parser.parse_args().figure)
    print(f"the last one {left:.2f} m from its goal, never closer than {gap:.2f} m")
