"""A planar quadrotor flies through a window in a wall.

python examples/quadrotor_window.py [figure.png]
"""

import sys

import jax
import jax.numpy as jnp

from sfkd_jax import control

DT, HORIZON, MASS, ARM, INERTIA, GRAVITY = 0.05, 30, 1.0, 0.25, 0.03, 9.81
GOAL = jnp.asarray([4.0, 1.0])
WALL = jnp.asarray([[2.0, -0.75, 0.0, 0.2, 3.5], [2.0, 3.75, 0.0, 0.2, 3.5]])
"""x, y, yaw, length, width of what is left and right of a window from y = 1 to 2 m."""


def dynamics(params, x, thrusts, env):
    """x, y, roll and their rates; thrust of each rotor [N]."""
    _, _, roll, _, _, _ = x
    lift = jnp.sum(thrusts) / MASS
    pull = jnp.stack([-lift * jnp.sin(roll), lift * jnp.cos(roll) - GRAVITY])
    spin = ARM * (thrusts[1] - thrusts[0]) / INERTIA
    speed = x[3:] + DT * jnp.append(pull, spin)
    return jnp.concatenate([x[:3] + DT * speed, speed])


def stage(weights, x, u, before, target):
    away = jnp.sum((x[:2] - GOAL) ** 2) + 0.1 * jnp.sum(x[3:5] ** 2)
    return 3.0 * away + x[2] ** 2 + 0.05 * x[5] ** 2 + 1e-3 * jnp.sum((u - before) ** 2)


def clear_of_the_wall(data, x, u, target, at):
    """Both rotors, as discs of 0.1 m."""
    arm = ARM * jnp.stack([jnp.cos(x[2]), jnp.sin(x[2])])
    rotors = x[:2] + jnp.stack([arm, -arm])
    depth = jax.vmap(lambda place: control.outside_boxes(place, WALL, 0.1))
    return depth(rotors).ravel()


def main(samples=1024, seconds=4.0, figure=None):
    """Distance to the goal at the end; largest violation of the clearance [m]."""
    limits = {"control_low": (0.0, 0.0), "control_high": (12.0, 12.0)}
    task = control.constrained(
        control.free_task(dynamics, stage, **limits), clear_of_the_wall
    )
    planner = control.mppi(
        task,
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

    hover = jnp.full((HORIZON, 2), 0.5 * MASS * GRAVITY)
    memory = planner.init(jax.random.key(0))._replace(plan=hover)
    start = (jnp.zeros(6), memory)
    run = jax.jit(lambda: jax.lax.scan(step, start, length=round(seconds / DT)))
    _, (states, depths) = run()
    if figure:
        import matplotlib.pyplot as plt

        _, axis = plt.subplots(figsize=(6, 4))
        for x, y, _, length, width in WALL:
            corner = (x - length / 2, y - width / 2)
            axis.add_patch(plt.Rectangle(corner, length, width, color="0.6"))
        arm = ARM * jnp.stack([jnp.cos(states[:, 2]), jnp.sin(states[:, 2])], axis=1)
        ends = jnp.stack([states[:, :2] - arm, states[:, :2] + arm])[:, ::3]
        axis.plot(ends[..., 0], ends[..., 1], color="tab:blue")
        axis.set(xlabel="x [m]", ylabel="y [m]", xlim=(-0.5, 4.5), ylim=(-1, 3))
        axis.plot(*GOAL, "k+")
        plt.savefig(figure, dpi=120, bbox_inches="tight")
    return float(jnp.linalg.norm(states[-1, :2] - GOAL)), float(jnp.max(depths))


if __name__ == "__main__":
    distance, depth = main(figure=(*sys.argv, None)[1])
    print(f"{distance:.2f} m from the goal, clearance kept to {-depth:.3f} m")
