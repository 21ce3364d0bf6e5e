"""The floor under a control step: the products of matrices and the tanh in it, alone, on this machine; prints JSON.

python -m benchmarks.timing.floor [--samples 1500 --horizon 20 --rounds 15] Each is repeated as
often as the rollouts need it, in one jitted loop, and timed by itself, round-robin with
the step.
"""

import argparse
import json
from functools import partial

import jax
import jax.numpy as jnp

from benchmarks import harness
from benchmarks.timing import ours, problem

PRODUCTS = ("A", "B", "W1", "W2", "W3", "D1", "D2", "D3")
LARGE = 1024
TANH = 4
"""Applications of tanh to (samples, width) in a step of the rollouts: two in the
residual, two in the decoder.
"""


def product(matrix, samples, times):
    """rows @ matrix', over and over; the rows change a little each time, so that no
    compiler does it once.
    """

    def body(k, carry):
        rows, _ = carry
        rows = rows.at[0, 0].set(k.astype(rows.dtype))
        return rows, rows @ matrix.T

    after = jnp.zeros((samples, matrix.shape[0]))
    return jax.jit(lambda rows: jax.lax.fori_loop(0, times, body, (rows, after))[1])


def activation(times):
    """tanh of (samples, width), over and over."""
    return jax.jit(
        lambda rows: jax.lax.fori_loop(0, times, lambda _, rows: jnp.tanh(rows), rows)
    )


def parts(samples, horizon):
    """Label -> a function of no arguments that does one part of one control step."""
    random = jax.random.normal
    rows = lambda width: random(jax.random.key(0), (samples, width))
    result = {}
    for name in PRODUCTS:
        matrix = jnp.asarray(problem.weights()[name])
        result[name] = partial(product(matrix, samples, horizon), rows(matrix.shape[1]))
    result["tanh"] = partial(activation(TANH * horizon), rows(problem.WIDTH))
    controller, w = ours.planner(samples, horizon)
    result["step"] = partial(
        jax.jit(controller.act), *ours.arguments(controller, w, horizon)
    )
    large = random(jax.random.key(1), (LARGE, LARGE))
    result["large product"] = partial(jax.jit(lambda a: a @ a), large)
    return {name: partial(ready, run) for name, run in result.items()}


def ready(run):
    """Call and wait."""
    return jax.block_until_ready(run())


def summary(best, samples, horizon):
    """The floor, how far above it the step lies, and what the machine did a second."""
    operations = (
        2e-9
        * samples
        * horizon
        * sum(problem.weights()[name].size for name in PRODUCTS)
    )
    total = lambda names, kind: sum(best[name][kind] for name in names)
    products, step, large = (
        total(names, "best_ms") for names in (PRODUCTS, ("step",), ("large product",))
    )
    floor = total((*PRODUCTS, "tanh"), "best_ms")
    return {
        "products_ms": products,
        "tanh_ms": floor - products,
        "step_ms": step,
        "ratio": step / floor,
        "median_ratio": best["step"]["median_ms"]
        / total((*PRODUCTS, "tanh"), "median_ms"),
        "gflop": operations,
        "products_gflops": 1e3 * operations / products,
        "step_gflops": 1e3 * operations / step,
        "large_product_gflops": 2e-6 * LARGE**3 / large,
    }


def main():
    """Parse, time, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, value in (("samples", 1500), ("horizon", 20), ("rounds", 15)):
        parser.add_argument(f"--{name}", type=int, default=value)
    args = parser.parse_args()
    best = harness.in_turn(parts(args.samples, args.horizon), args.rounds)
    print(json.dumps(summary(best, args.samples, args.horizon)))


if __name__ == "__main__":
    main()
