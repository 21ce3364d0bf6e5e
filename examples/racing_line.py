"""A car laps a circuit as fast as the grip of its tyres allows.

The cost rewards progress alone. Grip, the edges of the track and obstacles on it are
constraints of the plan, so that the racing line comes out by itself. The program prints
the time of the lap, the grip that was left, and the distance from edges and obstacles.

    python examples/racing_line.py [figure.png]
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from sfkd_jax import control

DT = 0.05  # control period [s]
HORIZON = 50
WHEELBASE = 2.7  # [m]
GRIP = 6.0  # largest lateral acceleration [m/s²]
HALF_WIDTH = 4.0  # of the track [m]
CAR_RADIUS = 1.0  # [m]
POINTS = 1000  # of the centre line
MARKS_X = [0, 30, 60, 88, 98, 98, 88, 70, 52, 40, 24, 10, -8, -28, -38, -26, 0]
MARKS_Y = [0, 0, 0, 0, 6, 16, 22, 22, 33, 33, 23, 24, 36, 36, 20, 4, 0]
"""Points that the centre line passes [m]."""
OBSTACLES = jnp.asarray([[47.9, -1.2, 1], [93.8, 17.7, 1], [44, 32, 1], [-31, 31, 1]])
"""x, y, radius [m]."""


def circuit():
    """Return points of a closed spline, unit tangents, and its length [m].

    The spline is a function of the length of the chords between the marks, which stands
    for its own length.
    """
    marks = np.column_stack([MARKS_X, MARKS_Y])
    chords = np.cumsum([0, *np.linalg.norm(np.diff(marks, axis=0), axis=1)])
    spline = CubicSpline(chords, marks, bc_type="periodic")
    at = np.arange(POINTS) * chords[-1] / POINTS
    tangent = spline(at, 1) / np.linalg.norm(spline(at, 1), axis=1)[:, None]
    return jnp.asarray(spline(at)), jnp.asarray(tangent), chords[-1].item()


CENTRE, TANGENT, LENGTH = circuit()


def locate(place, before):
    """Return progress along the centre line and the offset to its left [m].

    Args:
        place: position [m].
        before: progress one step earlier [m], near which it is searched for.
    """
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
    """Cost of a step: the steering shall be calm."""
    return 5.0 * (u[0] - before[0]) ** 2


def terminal(weights, x, target):
    """Cost of the last state: the progress, negative."""
    return -x[4]


def limits(obstacles, x, u, target, at):
    """Lateral acceleration less the grip, as a share of it; depth in edges, obstacles.

    A plan must keep all of them below 0.
    """
    lateral = x[3] ** 2 * jnp.abs(jnp.tan(u[0])) / WHEELBASE
    slip = lateral / GRIP - 1.0
    beyond_edge = jnp.abs(x[5]) + CAR_RADIUS - HALF_WIDTH
    touched = control.outside_circles(x[:2], obstacles, CAR_RADIUS)
    return jnp.stack([slip, beyond_edge, *touched])


def draw(path, states):
    """Track, obstacles, and a lap with its speed."""
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(figsize=(9, 3.6), layout="constrained")
    normal = jnp.stack([-TANGENT[:, 1], TANGENT[:, 0]], axis=1)
    for edge in (CENTRE - HALF_WIDTH * normal, CENTRE + HALF_WIDTH * normal):
        axes.plot(*jnp.append(edge, edge[:1], axis=0).T, color="0.4")
    axes.plot([0, 0], [-HALF_WIDTH, HALF_WIDTH], color="0.4", linestyle=":")
    for x, y, radius in OBSTACLES:
        axes.add_patch(plt.Circle((x, y), radius, color="tab:red"))
    x, y, yaw, speed, _, _ = states.T
    side = CAR_RADIUS * jnp.stack([-jnp.sin(yaw), jnp.cos(yaw)])
    left = jnp.stack([x, y]) + side
    right = jnp.stack([x, y]) - side
    axes.fill(*jnp.append(left, right[:, ::-1], axis=1), color="0.88")
    dots = axes.scatter(x, y, c=speed, s=6)
    axes.annotate("", (8, 2.5), (1, 2.5), arrowprops={"arrowstyle": "->"})
    plt.colorbar(dots, label="speed [m/s]", shrink=0.75)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    plt.savefig(path, dpi=120, bbox_inches="tight")


def main(samples=512, seconds=30.0, figure=None):
    """Return lap time [s], largest excess of the grip (share), largest depth [m]."""
    task = control.free_task(
        dynamics,
        stage,
        terminal=terminal,
        control_low=(-0.45, -6.0),  # steering [rad], acceleration [m/s²]
        control_high=(0.45, 4.0),
        control_rate=(1.0, 60.0),  # a second
        dt=DT,
    )
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
    _, (states, violations) = run()
    time = DT * jnp.arange(1, len(states) + 1)
    lap = jnp.interp(LENGTH, states[:, 4], time, right=jnp.inf)
    if figure:
        draw(figure, states[time < lap])
    return float(lap), float(violations[:, 0].max()), float(violations[:, 1:].max())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", nargs="?", help="file that the figure goes to")
    lap, slip, depth = main(figure=parser.parse_args().figure)
    print(f"lap in {lap:.2f} s, {-slip:.0%} of the grip and {-depth:.3f} m to spare")
