"""A whole episode as one scan of the controller and its plant, against as many single steps; prints JSON.

python -m benchmarks.timing.episode [--samples 1500 --horizon 20 --steps 200 --rounds 3]
"""

import argparse
import json
import statistics
import time

import jax
import jax.numpy as jnp

from benchmarks import harness
from benchmarks.timing import ours, problem


def episode_of(controller, w, targets, env, steps):
    """(state, z) -> the same after `steps` steps of controller and plant, which is the
    model itself.
    """

    def body(carry, _):
        state, z = carry
        u, state, _ = controller.act(w, state, z, env, targets)
        return (state, problem.advance(jnp, w, z, u)), None

    return jax.jit(lambda state, z: jax.lax.scan(body, (state, z), length=steps)[0])


def main():
    """Parse, time both in turn, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (
        ("samples", 1500),
        ("horizon", 20),
        ("steps", 200),
        ("rounds", 6),
    ):
        parser.add_argument(f"--{name}", type=int, default=value)
    args = parser.parse_args()
    controller, w = ours.planner(args.samples, args.horizon)
    w, state, z, env, targets = ours.arguments(controller, w, args.horizon)
    run, act = (
        episode_of(controller, w, targets, env, args.steps),
        jax.jit(controller.act),
    )
    jax.block_until_ready(run(state, z))
    step = lambda: jax.block_until_ready(act(w, state, z, env, targets))
    harness.timed(step, harness.WARM_UP)
    singles, episodes = [], []
    for _ in range(args.rounds):
        singles.append(statistics.median(harness.timed(step, args.steps)[0]))
        began = time.perf_counter()
        jax.block_until_ready(run(state, z))
        episodes.append(1e3 * (time.perf_counter() - began))
    single, whole = min(singles), min(episodes)
    pairs = zip(episodes, singles, strict=True)
    ratios = {
        "ratio": whole / (args.steps * single),
        "median_ratio": statistics.median(
            episode / (args.steps * step) for episode, step in pairs
        ),
    }
    print(
        json.dumps(
            {"steps": args.steps, "step_ms": single, "episode_ms": whole} | ratios
        )
    )


if __name__ == "__main__":
    main()
