"""A boat is driven by a nominal model, and then by one that a network has corrected.

The nominal model knows neither the current nor that the boat turns less than it is
commanded. A small network learns the difference from random transitions. The same
planner drives the boat between rocks with each of the two models; the program prints
how far from the goal each ends and how near it came to a rock.

    python examples/dubins_residual.py [figure.png]
"""

import argparse

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from sfkd_jax import control

DT = 0.2  # control period [s]
HORIZON = 20
BOAT_RADIUS = 0.2  # [m]
LOW = (-2.0, 0.0)  # turn rate [rad/s], speed [m/s]
HIGH = (2.0, 1.2)
GOAL = jnp.asarray([8.0, 0.0])
ROCKS = jnp.asarray([[2.2, 0.8, 0.8], [4.6, -1.2, 0.9], [4.6, 1.7, 0.7]])
"""x, y, radius [m]."""
RESIDUAL = nn.Sequential([nn.Dense(32), nn.tanh, nn.Dense(32), nn.tanh, nn.Dense(3)])
"""The network: position, cosine and sine of the heading, control -> missing rates."""


def current(place):
    """Drift of the water [m/s]."""
    return jnp.stack([0.2 * jnp.sin(place[1]), -0.3 - 0.4 * jnp.sin(0.4 * place[0])])


def nominal(x, u):
    """Dubins car: x, y, heading; turn rate [rad/s] and speed [m/s]."""
    return x + DT * jnp.stack([u[1] * jnp.cos(x[2]), u[1] * jnp.sin(x[2]), u[0]])


def truth(x, u):
    """The current moves the boat, and it turns less than it is commanded."""
    weakened = u * jnp.asarray([0.6, 1.0])
    return nominal(x, weakened) + DT * jnp.append(current(x[:2]), 0)


def dynamics(params, x, u, env):
    """Nominal model and network; without parameters the former alone."""
    if params is None:
        return nominal(x, u)
    inputs = jnp.stack([*x[:2], jnp.cos(x[2]), jnp.sin(x[2]), *u])
    return nominal(x, u) + DT * RESIDUAL.apply(params, inputs)


def train(key, count=500, steps=1500):
    """Return parameters of the network, trained on random transitions."""
    data_key, params_key = jax.random.split(key)
    low = jnp.asarray([-1, -3, -jnp.pi, *LOW])
    high = jnp.asarray([9, 3, jnp.pi, *HIGH])
    drawn = jax.random.uniform(data_key, (count, 5), minval=low, maxval=high)
    x = drawn[:, :3]
    u = drawn[:, 3:]
    after = jax.vmap(truth)(x, u)
    adam = optax.adam(optax.cosine_decay_schedule(1e-2, steps))

    def loss(params):
        predicted = jax.vmap(dynamics, (None, 0, 0, None))(params, x, u, None)
        return jnp.mean(((predicted - after) / DT) ** 2)

    def step(carry, _):
        params, state = carry
        updates, state = adam.update(jax.grad(loss)(params), state)
        return (optax.apply_updates(params, updates), state), None

    params = RESIDUAL.init(params_key, jnp.zeros(6))
    (params, _), _ = jax.lax.scan(step, (params, adam.init(params)), length=steps)
    return params


def stage(weights, x, u, before, target):
    """Cost of a step."""
    return jnp.sum((x[:2] - GOAL) ** 2) + 0.01 * u[0] ** 2


def clear_of_the_rocks(rocks, x, u, target, at):
    """Depth of the boat in each rock [m]; a plan must keep it below 0."""
    return control.outside_circles(x[:2], rocks, BOAT_RADIUS)


def smallest_gap(path):
    """Smallest distance of a path from a rock [m]."""
    depth = jax.vmap(lambda x: control.outside_circles(x[:2], ROCKS, BOAT_RADIUS))
    return jnp.min(-depth(path))


def draw(path, driven):
    """Current, rocks and the paths that were driven, by the name of the model."""
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(figsize=(8, 4), layout="constrained")
    grid = jnp.stack(jnp.meshgrid(jnp.arange(-0.5, 9, 0.5), jnp.arange(-2.5, 3, 0.5)))
    axes.quiver(*grid, *current(grid), color="0.6", width=0.0022)
    for x, y, radius in ROCKS:
        axes.add_patch(plt.Circle((x, y), radius, color="0.75"))
    for name, states in driven.items():
        axes.plot(states[:, 0], states[:, 1], label=f"{name} model")
    axes.plot(*GOAL, "k+", markersize=10)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    plt.savefig(path, dpi=120, bbox_inches="tight")


def main(samples=512, seconds=14.0, figure=None):
    """Return by model the distance to the goal at the end and the smallest gap [m].

    Both runs sample with the same key, so that only the model differs.
    """
    task = control.free_task(dynamics, stage, control_low=LOW, control_high=HIGH)
    planner = control.mppi(
        control.constrained(task, clear_of_the_rocks, ROCKS),
        num_samples=samples,
        horizon=HORIZON,
        noise_std=(0.8, 0.3),
        effective_samples=20.0,
    )
    training_key, planner_key = jax.random.split(jax.random.key(0))

    @jax.jit
    def run(params):
        def step(carry, _):
            x, memory = carry
            u, memory, _ = planner.act(params, memory, x, None, None)
            x = truth(x, u)
            return (x, memory), x

        start = (jnp.zeros(3), planner.init(planner_key))
        return jax.lax.scan(step, start, length=round(seconds / DT))[1]

    driven = {"nominal": run(None), "learned": run(train(training_key))}
    if figure:
        draw(figure, driven)
    return {
        name: (
            float(jnp.linalg.norm(states[-1, :2] - GOAL)),
            float(smallest_gap(states)),
        )
        for name, states in driven.items()
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", nargs="?", help="file that the figure goes to")
    for name, (left, gap) in main(figure=parser.parse_args().figure).items():
        print(f"{name} model: {left:.2f} m from the goal, smallest gap {gap:.2f} m")
