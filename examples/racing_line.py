"""A car laps a circuit against the clock, within the grip of its tyres.

python examples/racing_line.py [figure.png]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from sfkd_jax import control

DT, HORIZON, WHEELBASE, GRIP = 0.05, 50, 2.7, 6.0
HALF_WIDTH, CAR, POINTS = 4.0, 1.0, 1000
MARKS = [(0, 0), (30, 0), (60, 0), (88, 0), (98, 6), (98, 16), (88, 22), (70, 22)]
MARKS += [(52, 33), (40, 33), (24, 23), (10, 24), (-8, 36), (-28, 36), (-38, 20)]
MARKS += [(-26, 4), (0, 0)]
OBSTACLES = jnp.asarray([[47.9, -1.2, 1], [93.8, 17.7, 1], [44, 32, 1], [-31, 31, 1]])
"""x, y, radius [m]."""


def circuit():
    """Points of a closed spline, unit tangents; length of the chords [m]."""
    chords = np.cumsum([0, *np.linalg.norm(np.diff(MARKS, axis=0), axis=1)])
    spline = CubicSpline(chords, MARKS, bc_type="periodic")
    at = np.arange(POINTS) * chords[-1] / POINTS
    tangent = spline(at, 1) / np.linalg.norm(spline(at, 1), axis=1)[:, None]
    return jnp.asarray(spline(at)), jnp.asarray(tangent), chords[-1].item()


CENTRE, TANGENT, LENGTH = circuit()


def locate(place, before):
    """Progress along the centre line, searched near the one before; offset to it."""
    near = jnp.round(before * POINTS / LENGTH).astype(int) + jnp.arange(-3, 10)
    away = place - CENTRE[near % POINTS]
    nearest = jnp.argmin(jnp.sum(away**2, axis=1))
    tangent = TANGENT[near[nearest] % POINTS]
    progress = near[nearest] * LENGTH / POINTS + tangent @ away[nearest]
    return progress, away[nearest] @ jnp.stack([-tangent[1], tangent[0]])


def dynamics(params, x, u, env):
    """x, y, yaw, speed, progress and offset of a kinematic single track."""
    speed = x[3] + 0.5 * DT * u[1]
    turn = DT * speed * jnp.tan(u[0]) / WHEELBASE
    course = x[2] + 0.5 * turn
    place = x[:2] + DT * speed * jnp.stack([jnp.cos(course), jnp.sin(course)])
    return jnp.stack([*place, x[2] + turn, x[3] + DT * u[1], *locate(place, x[4])])


def stage(weights, x, u, before, target):
    return 5.0 * (u[0] - before[0]) ** 2


def terminal(weights, x, target):
    return -x[4]


def limits(obstacles, x, u, target, at):
    """Lateral acceleration, as a share of the grip; edges, obstacles [m]."""
    lateral = x[3] ** 2 * jnp.abs(jnp.tan(u[0])) / WHEELBASE
    touched = control.outside_circles(x[:2], obstacles, CAR)
    return jnp.stack([lateral / GRIP - 1.0, jnp.abs(x[5]) + CAR - HALF_WIDTH, *touched])


def main(samples=512, seconds=30.0, figure=None):
    """Lap time [s]; largest violation of the grip (share), of edges and obstacles."""
    box = {"control_low": (-0.45, -6.0), "control_high": (0.45, 4.0)}
    rate = {"control_rate": (1.0, 60.0), "dt": DT}
    task = control.free_task(dynamics, stage, terminal=terminal, **box, **rate)
    planner = control.mppi(
        control.constrained(task, limits, OBSTACLES),
        num_samples=samples,
        horizon=HORIZON,
        noise_std=(0.02, 3.0),
        noise="spline",
        effective_samples=8.0,
    )

    def step(carry, _):
        x, memory = carry
        u, memory, _ = planner.act({}, memory, x, None, None)
        x = dynamics({}, x, u, None)
        return (x, memory), (x, limits(OBSTACLES, x, u, None, None))

    start = (jnp.zeros(6), planner.init(jax.random.key(0)))
    run = jax.jit(lambda: jax.lax.scan(step, start, length=round(seconds / DT)))
    _, (states, depths) = run()
    time = DT * jnp.arange(1, len(states) + 1)
    lap = jnp.interp(LENGTH, states[:, 4], time, right=jnp.inf)
    if figure:
        import matplotlib.pyplot as plt

        _, axis = plt.subplots(figsize=(9, 3.6), layout="constrained")
        normal = jnp.stack([-TANGENT[:, 1], TANGENT[:, 0]], axis=1)
        for edge in (CENTRE - HALF_WIDTH * normal, CENTRE + HALF_WIDTH * normal):
            axis.plot(*jnp.append(edge, edge[:1], axis=0).T, color="0.4")
        axis.plot([0, 0], [-HALF_WIDTH, HALF_WIDTH], color="0.4", linestyle=":")
        for x, y, radius in OBSTACLES:
            axis.add_patch(plt.Circle((x, y), radius, color="tab:red"))
        x, y, yaw, speed, _, _ = states[time < lap].T
        side = CAR * jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)])
        left, right = jnp.stack([x, y]) + side, jnp.stack([x, y]) - side
        axis.fill(*jnp.append(left, right[:, ::-1], axis=1), color="0.88")
        dots = axis.scatter(x, y, c=speed, s=6)
        axis.annotate("", (8, 2.5), (1, 2.5), arrowprops={"arrowstyle": "->"})
        plt.colorbar(dots, label="speed [m/s]", shrink=0.75)
        axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        plt.savefig(figure, dpi=120, bbox_inches="tight")
    return float(lap), float(depths[:, 0].max()), float(depths[:, 1:].max())


if __name__ == "__main__":
    lap, slip, depth = main(figure=(*sys.argv, None)[1])
    print(f"lap in {lap:.2f} s, {-slip:.0%} of the grip and {-depth:.3f} m to spare")
