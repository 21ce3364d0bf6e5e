"""A half cheetah runs, planned with the physics of brax itself.

The planner rolls out brax's simulator in place of a model: the state is a dataclass of
brax, and the control is the torque of six joints. The program prints the mean speed.
It needs the package `brax`.

    python examples/half_cheetah.py [figure.png]
"""

import argparse

import jax
import jax.numpy as jnp
from brax import envs

from sfkd_jax import control

HORIZON = 16
PITCH_WEIGHT = 3.0  # keeps the trunk level
CHEETAH = envs.get_environment("halfcheetah", backend="spring")


def dynamics(params, state, u, env):
    """The state is brax's own, a dataclass of positions, contacts and rewards."""
    return CHEETAH.step(state, u)


def stage(weights, state, u, before, target):
    """The reward of brax (forward speed and effort), and the pitch of the trunk."""
    pitch = state.pipeline_state.q[2]
    return -state.reward + PITCH_WEIGHT * jnp.abs(pitch)


def draw(path, links):
    """The skeleton at every seventh step, and the path of the trunk.

    Args:
        path: of the file.
        links: positions of the links [m], (time, link, 3).
    """
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(figsize=(9, 1.8), layout="constrained")
    shown = links[::7]
    for child, parent in enumerate(CHEETAH.sys.link_parents):
        ends = shown[:, jnp.asarray([max(parent, 0), child])]
        axes.plot(ends[..., 0].T, ends[..., 2].T, color="tab:blue")
    axes.plot(links[:, 0, 0], links[:, 0, 2], color="0.6", zorder=0)
    axes.set(xlabel="x [m]", ylabel="z [m]", aspect="equal", ylim=(0, None))
    plt.savefig(path, dpi=120, bbox_inches="tight")


def main(samples=96, seconds=4.0, figure=None):
    """Return the mean speed [m/s]."""
    full = jnp.ones(CHEETAH.action_size)
    task = control.free_task(dynamics, stage, control_low=-full, control_high=full)
    planner = control.mppi(
        task,
        num_samples=samples,
        horizon=HORIZON,
        noise_std=(0.5,) * CHEETAH.action_size,
        effective_samples=8.0,
    )

    def step(carry, _):
        state, memory = carry
        u, memory, _ = planner.act({}, memory, state, None, None)
        state = dynamics({}, state, u, None)
        return (state, memory), state.pipeline_state.x.pos

    first = jax.jit(CHEETAH.reset)(jax.random.key(0))
    start = (first, planner.init(jax.random.key(1)))
    steps = round(seconds / CHEETAH.dt)
    run = jax.jit(lambda start: jax.lax.scan(step, start, length=steps)[1])
    links = run(start)
    if figure:
        draw(figure, links)
    return float((links[-1, 0, 0] - links[0, 0, 0]) / seconds)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("figure", nargs="?", help="file that the figure goes to")
    speed = main(figure=parser.parse_args().figure)
    print(f"mean speed {speed:.1f} m/s")
