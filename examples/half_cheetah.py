"""A half cheetah runs: the planner rolls out the physics of brax.

python examples/half_cheetah.py [figure.png]
"""

import sys

import jax
import jax.numpy as jnp
from brax import envs

from sfkd_jax import control

HORIZON, FLAT = 16, 3.0
CHEETAH = envs.get_environment("halfcheetah", backend="spring")


def dynamics(params, state, u, env):
    """The state is brax's own, a dataclass of positions, contacts and rewards."""
    return CHEETAH.step(state, u)


def stage(weights, state, u, before, target):
    """The reward of brax (forward speed and effort), and the pitch of the trunk."""
    return -state.reward + FLAT * jnp.abs(state.pipeline_state.q[2])


def main(samples=96, seconds=4.0, figure=None):
    """Mean speed [m/s]."""
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
    steps = round(seconds / CHEETAH.dt)
    start = first, planner.init(jax.random.key(1))
    links = jax.jit(lambda start: jax.lax.scan(step, start, length=steps)[1])(start)
    if figure:
        import matplotlib.pyplot as plt

        _, axis = plt.subplots(figsize=(9, 1.8), layout="constrained")
        every = slice(None, None, 7)
        for child, parent in enumerate(CHEETAH.sys.link_parents):
            ends = links[every, jnp.asarray([max(parent, 0), child])]
            axis.plot(ends[..., 0].T, ends[..., 2].T, color="tab:blue")
        axis.plot(links[:, 0, 0], links[:, 0, 2], color="0.6", zorder=0)
        axis.set(xlabel="x [m]", ylabel="z [m]", aspect="equal", ylim=(0, None))
        plt.savefig(figure, dpi=120, bbox_inches="tight")
    return float((links[-1, 0, 0] - links[0, 0, 0]) / seconds)


if __name__ == "__main__":
    print(f"mean speed {main(figure=(*sys.argv, None)[1]):.1f} m/s")
