"""A boat is driven by a nominal model, then with what a network learned of the rest.

python examples/dubins_residual.py [figure.png]
"""

import sys

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from sfkd_jax import control

DT, HORIZON, WIDE = 0.2, 20, 0.2
LOW, HIGH, GOAL = (-2.0, 0.0), (2.0, 1.2), jnp.asarray([8.0, 0.0])
ROCKS = jnp.asarray([[2.2, 0.8, 0.8], [4.6, -1.2, 0.9], [4.6, 1.7, 0.7]])
"""x, y, radius [m]."""
RESIDUAL = nn.Sequential([nn.Dense(32), nn.tanh, nn.Dense(32), nn.tanh, nn.Dense(3)])


def current(place):
    """Drift of the water [m/s]."""
    return jnp.stack([0.2 * jnp.sin(place[1]), -0.3 - 0.4 * jnp.sin(0.4 * place[0])])


def nominal(x, u):
    """Dubins car: x, y, heading; turn rate [rad/s] and speed [m/s]."""
    return x + DT * jnp.stack([u[1] * jnp.cos(x[2]), u[1] * jnp.sin(x[2]), u[0]])


def truth(x, u):
    """The current moves the boat, and it turns less than it is told."""
    return nominal(x, u * jnp.asarray([0.6, 1.0])) + DT * jnp.append(current(x[:2]), 0)


def dynamics(params, x, u, env):
    """Nominal model and network; without parameters the former alone."""
    seen = jnp.stack([*x[:2], jnp.cos(x[2]), jnp.sin(x[2]), *u])
    lacking = 0.0 if params is None else RESIDUAL.apply(params, seen)
    return nominal(x, u) + DT * lacking


def train(key, count=500, steps=1500):
    """Parameters of the network, from random transitions."""
    of_data, of_params = jax.random.split(key)
    low, high = jnp.asarray([-1, -3, -jnp.pi, *LOW]), jnp.asarray([9, 3, jnp.pi, *HIGH])
    drawn = jax.random.uniform(of_data, (count, 5), minval=low, maxval=high)
    x, u = drawn[:, :3], drawn[:, 3:]
    after = jax.vmap(truth)(x, u)
    adam = optax.adam(optax.cosine_decay_schedule(1e-2, steps))

    def loss(params):
        predicted = jax.vmap(dynamics, (None, 0, 0, None))(params, x, u, None)
        return jnp.mean(((predicted - after) / DT) ** 2)

    def step(carry, _):
        params, state = carry
        updates, state = adam.update(jax.grad(loss)(params), state)
        return (optax.apply_updates(params, updates), state), None

    params = RESIDUAL.init(of_params, jnp.zeros(6))
    return jax.lax.scan(step, (params, adam.init(params)), length=steps)[0][0]


def stage(weights, x, u, before, target):
    return jnp.sum((x[:2] - GOAL) ** 2) + 0.01 * u[0] ** 2


def clear_of_the_rocks(rocks, x, u, target, at):
    return control.outside_circles(x[:2], rocks, WIDE)


def main(samples=512, seconds=14.0, figure=None):
    """Of each model, distance to the goal at the end and smallest gap [m].

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
    of_training, of_planner = jax.random.split(jax.random.key(0))

    @jax.jit
    def run(params):
        def step(carry, _):
            x, memory = carry
            u, memory, _ = planner.act(params, memory, x, None, None)
            x = truth(x, u)
            return (x, memory), x

        start = (jnp.zeros(3), planner.init(of_planner))
        return jax.lax.scan(step, start, length=round(seconds / DT))[1]

    paths = {"nominal": run(None), "learned": run(train(of_training))}
    if figure:
        import matplotlib.pyplot as plt

        _, axis = plt.subplots(figsize=(8, 4), layout="constrained")
        at = jnp.stack(jnp.meshgrid(jnp.arange(-0.5, 9, 0.5), jnp.arange(-2.5, 3, 0.5)))
        axis.quiver(*at, *current(at), color="0.6", width=0.0022)
        [axis.add_patch(plt.Circle((x, y), r, color="0.75")) for x, y, r in ROCKS]
        for name, path in paths.items():
            axis.plot(path[:, 0], path[:, 1], label=f"{name} model")
        axis.plot(*GOAL, "k+", markersize=10)
        axis.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        axis.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
        plt.savefig(figure, dpi=120, bbox_inches="tight")
    gap = jax.vmap(lambda x: -jnp.max(control.outside_circles(x[:2], ROCKS, WIDE)))
    left = {name: jnp.linalg.norm(x[-1, :2] - GOAL) for name, x in paths.items()}
    return {name: (float(left[name]), float(gap(paths[name]).min())) for name in paths}


if __name__ == "__main__":
    for name, (left, gap) in main(figure=(*sys.argv, None)[1]).items():
        print(f"{name} model: {left:.2f} m from the goal, smallest gap {gap:.2f} m")
