"""A planar quadrotor flies through a window in a wall.

The cost asks for the goal behind the wall; that both rotors stay clear of the wall is a
constraint of the plan. The program prints how near the quadrotor comes to the goal, and
what remains of the clearance.

    python examples/quadrotor_window.py [figure.png]
"""

import argparse

import jax
import jax.numpy as jnp

from sfkd_jax import control

DT = 0.05  # control period [s]
HORIZON = 30
MASS = 1.0  # [kg]
ARM = 0.25  # from the middle to each rotor [m]
INERTIA = 0.03  # [kg m²]
GRAVITY = 9.81  # [m/s²]
CLEARANCE = 0.1  # around each rotor [m]
GOAL = jnp.asarray([4.0, 1.0])
WALL = jnp.asarray([[2.0, -0.75, 0.0, 0.2, 3.5], [2.0, 3.75, 0.0, 0.2, 3.5]])
"""x, y, yaw, length, width of the wall below and above a window from y = 1 to 2 m."""


def dynamics(params, x, thrusts, env):
    """x, y, roll and their rates; thrust of each rotor [N]."""
    roll = x[2]
    lift = jnp.sum(thrusts) / MASS
    pull = jnp.stack([-lift * jnp.sin(roll), lift * jnp.cos(roll) - GRAVITY])
    spin = ARM * (thrusts[1] - thrusts[0]) / INERTIA
    speed = x[3:] + DT * jnp.append(pull, spin)
    return jnp.concatenate([x[:3] + DT * speed, speed])


def stage(weights, x, u, before, target):
    """Cost of a step."""
    away = jnp.sum((x[:2] - GOAL) ** 2) + 0.1 * jnp.sum(x[3:5] ** 2)
    return 3.0 * away + x[2] ** 2 + 0.05 * x[5] ** 2 + 1e-3 * jnp.sum((u - before) ** 2)


def clear_of_the_wall(data, x, u, target, at):
    """Depth of both rotors in the wall [m]; a plan must keep it below 0."""
    arm = ARM * jnp.stack([jnp.cos(x[2]), jnp.sin(x[2])])
    rotors = x[:2] + jnp.stack([arm, -arm])
    depth = jax.vmap(lambda place: control.outside_boxes(place, WALL, CLEARANCE))
    return depth(rotors).ravel()


def draw(path, states):
    """The wall, and the quadrotor at every third step."""
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(figsize=(6, 4))
    for x, y, _, length, width in WALL:
        corner = (x - length / 2, y - width / 2)
        axes.add_patch(plt.Rectangle(corner, length, width, color="0.6"))
    arm = ARM * jnp.stack([jnp.cos(states[:, 2]), jnp.sin(states[:, 2])], axis=1)
    ends = jnp.stack([states[:, :2] - arm, states[:, :2] + arm])[:, ::3]
    axes.plot(ends[..., 0], ends[..., 1], color="tab:blue")
    axes.plot(*GOAL, "k+")
    axes.set(xlabel="x [m]", ylabel="y [m]", xlim=(-0.5, 4.5), ylim=(-1, 3))
    plt.savefig(path, dpi=120, bbox_inches="tight")


def main(samples=1024, seconds=4.0, figure=None):
    """Return the distance to the goal at the end and the largest depth [m]."""
    task = control.free_task(
        dynamics, stage, control_low=(0.0, 0.0), control_high=(12.0, 12.0)
    )
    planner = control.mppi(
        control.constrained(task, clear_of_the_wall),
        num_samples=samples,
        horizon=HORIZON,
        noise_std=(0.8, 0.8),
        effective_samples=20.0,
    )

    def step(carry, _):
        x, memory = carry
        u, memory, _ = planner.act({}, memory, x, None, None)
        x = dynamics({}, x, u, None)
        return (x, memory), (x, jnp.max(clear_of_the_wall((), x, u, None, None)))

    # The first plan hovers.
    hover = jnp.full((HORIZON, 2), 0.5 * MASS * GRAVITY)
    memory = planner.init(jax.random.key(0))._replace(plan=hover)
    start = (jnp.zeros(6), memory)
    run = jax.jit(lambda: jax.lax.scan(step, start, length=round(seconds / DT)))
    _, (states, depths) = run()
    if figure:
        draw(figure, states)
    return float(jnp.linalg.norm(states[-1, :2] - GOAL)), float(jnp.max(depths))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", nargs="?", help="file that the figure goes to")
    distance, depth = main(figure=parser.parse_args().figure)
    print(f"{distance:.2f} m from the goal, clearance kept to {-depth:.3f} m")
